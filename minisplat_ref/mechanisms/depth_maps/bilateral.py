"""A joint bilateral filter: depths are averaged over neighbours that look alike in the photograph.

    D'(p) = sum_q w_q D(q) / sum_q w_q,   w_q = exp(-|p - q|^2 / (2 s^2)) exp(-|I(p) - I(q)|^2 / (2 r^2))

over the pixels q of a square window that have a depth (after Petschnigg et al. 2004). Left out: the gradient; losses
take the result as a target.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Floats


class BilateralWidths(NamedTuple):
    """How far neighbours count."""

    radius: int = 3
    """Pixels on either side of the window's middle."""
    spatial: float = 1.5
    """s, pixels."""
    color: float = 0.08
    """r, of colours in [0, 1]; the distance is over the three channels."""


USUAL_WIDTHS = BilateralWidths()


def joint_bilateral_depth(depth: Floats, image: Floats, widths: BilateralWidths = USUAL_WIDTHS) -> Floats:
    """Return the filtered depth map.

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        Camera z, world units; 0 where there is none, which stays.
    image : ndarray of shape (H, W, 3)
        RGB in [0, 1].
    widths : BilateralWidths

    Returns
    -------
    ndarray of shape (H, W)
        In the dtype of the depth.
    """
    total, weights = np.zeros(depth.shape), np.zeros(depth.shape)
    shifts = range(-widths.radius, widths.radius + 1)
    for down, right in ((y, x) for y in shifts for x in shifts):
        here, there = _overlap(depth.shape, down, right)
        apart = np.sum((image[here] - image[there]) ** 2, axis=2)
        exponent = (down**2 + right**2) / (2 * widths.spatial**2) + apart / (2 * widths.color**2)
        w = np.exp(-exponent) * (depth[there] > 0)
        total[here] += w * depth[there]
        weights[here] += w
    has_depth = depth > 0
    return np.where(has_depth, total / np.where(has_depth, weights, 1), 0).astype(depth.dtype)


def _overlap(shape: tuple[int, ...], down: int, right: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the pixels that have a neighbour at an offset, and these neighbours."""
    here = tuple(
        slice(max(-shift, 0), max(n - max(shift, 0), 0)) for n, shift in zip(shape, (down, right), strict=True)
    )
    there = tuple(
        slice(max(shift, 0), max(n + min(shift, 0), 0)) for n, shift in zip(shape, (down, right), strict=True)
    )
    return (here[0], here[1]), (there[0], there[1])
