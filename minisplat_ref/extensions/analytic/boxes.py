"""Boxes of the pixels in which a Gaussian can be seen, so that the kernels evaluate no integral in vain.

The boxes of stage 3 follow the conventions, and may have all tiles that a Gaussian's largest extent touches. A hit of
lower alpha than ``alpha_min`` is skipped, so what lies beyond its reach may be left out without any change.

With F' = dF/dx, which falls with |x|, and ``a_k = max(|u_k| - 1/2, 0) r_k``::

    I_k   = F((u_k + 1/2) r_k) - F((u_k - 1/2) r_k) <= min(r_k F'(a_k), 1)
    alpha = o (2 pi / (r_1 r_2)) I_1 I_2            <= 2 pi o F'(a_1) m_2,   m_k = min(F'(0), 1 / r_k)

and likewise with 1 and 2 exchanged. So alpha reaches ``alpha_min`` at most where F'(a_1) >= alpha_min / (2 pi o m_2).
"""

import numpy as np

from minisplat_ref.extensions.analytic.response import axes_of, logistic_pdf
from minisplat_ref.types import Floats, Ints, Projection

_STEPS = np.linspace(0, 8, 513)  # x, 1/64 apart, which costs at most 1/64 of a standard deviation; F'(8) is 1e-20
_PDF = logistic_pdf(_STEPS)
_MARGIN = 1e-4  # of alpha, for its rounding in float32


def visible_boxes(projection: Projection, alpha_min: float) -> Ints:
    """Return the boxes cut to the pixels in which alpha may reach ``alpha_min``.

    Parameters
    ----------
    projection : Projection
        Footprints, opacities and boxes [N, 4] x0, y0, x1, y1, half-open, px.
    alpha_min : float
        In [0, 1].

    Returns
    -------
    ndarray of shape (N, 4)
        int32; of what can be seen nowhere, boxes may be empty.
    """
    axes = axes_of(projection.conics.astype(np.float64))
    most = np.minimum(_PDF[0], 1 / axes.rates)  # [N, 2] m_k
    opacities = np.maximum(
        projection.opacities.astype(np.float64), np.finfo(np.float32).tiny
    )  # not 0, to be divided by
    least = (1 - _MARGIN) * alpha_min / (2 * np.pi * opacities[:, None] * most[:, ::-1])  # [N, 2]
    reach = _largest_argument(least) / axes.rates + 0.5  # [N, 2] px along the axes
    cos, sin = np.abs(np.cos(axes.angles)), np.abs(np.sin(axes.angles))
    half = np.column_stack([cos * reach[:, 0] + sin * reach[:, 1], sin * reach[:, 0] + cos * reach[:, 1]])
    # A pixel's centre is half a pixel from its index.
    low, high = np.ceil(projection.means2d - half - 0.5), np.floor(projection.means2d + half + 0.5)
    boxes = projection.boxes
    first, end = np.maximum(boxes[:, :2], low), np.minimum(boxes[:, 2:], high)
    cut: Ints = np.column_stack([first, np.maximum(end, first)]).astype(np.int32)
    return cut


def _largest_argument(least: Floats) -> Floats:
    """Return x at least as large as any with F'(x) >= ``least``; 1e9, beyond every image, where F'(8) is as large."""
    beyond = np.searchsorted(-_PDF, -least, side="right")  # the first step at which F' is lower
    return np.append(_STEPS, 1e9)[beyond]
