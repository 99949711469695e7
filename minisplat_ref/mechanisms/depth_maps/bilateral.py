"""A joint bilateral filter: depths are averaged over neighbours of similar colour in the photograph.

    D'(p) = sum_q w_pq D(q) / W_p,   W_p = sum_q w_pq
    w_pq  = exp(-|p - q|^2 / (2 s^2) - |I(p) - I(q)|^2 / (2 r^2))

over the pixels q of a square window that have a depth (after Petschnigg et al. 2004). The weights depend on the
photograph alone, so D' is linear in D, and they are symmetric, so each pair of pixels is visited once.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Floats

Window = tuple[slice, slice]


class BilateralWidths(NamedTuple):
    """Widths of the filter."""

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
    return _filter(depth, image, widths)[0]


def joint_bilateral_depth_vjp(
    depth: Floats, image: Floats, v_filtered: Floats, widths: BilateralWidths = USUAL_WIDTHS
) -> Floats:
    """Gradient [H, W] of :func:`joint_bilateral_depth` with respect to the depth.

    ::

        v_D(q) = sum_p w_pq v_D'(p) / W_p           over the pixels p that have a depth, as q has
    """
    has_depth = depth > 0
    _, W = _filter(depth, image, widths)
    share = np.where(has_depth, v_filtered / np.where(has_depth, W, 1), 0)
    v_depth = share.copy()  # q = p, of weight 1
    for here, there, w in _pairs(image.astype(depth.dtype), widths):
        v_depth[there] += w * share[here]
        v_depth[here] += w * share[there]
    return np.where(has_depth, v_depth, 0)


def _filter(depth: Floats, image: Floats, widths: BilateralWidths) -> tuple[Floats, Floats]:
    """Return D' and W."""
    has_depth = (depth > 0).astype(depth.dtype)
    known = depth * has_depth
    total, W = known.copy(), has_depth.copy()
    for here, there, w in _pairs(image.astype(depth.dtype), widths):
        for one, other in ((here, there), (there, here)):
            total[one] += w * known[other]
            W[one] += w * has_depth[other]
    return np.where(depth > 0, total / np.where(depth > 0, W, 1), 0), W


def _pairs(image: Floats, widths: BilateralWidths) -> Iterator[tuple[Window, Window, Floats]]:
    """Yield the pixels that have a neighbour at an offset, these neighbours, and w; each pair of pixels once."""
    shifts = range(-widths.radius, widths.radius + 1)
    planes = np.ascontiguousarray(np.moveaxis(image, 2, 0)) * image.dtype.type(np.sqrt(0.5) / widths.color)  # [3, H, W]
    for down, right in ((y, x) for y in range(widths.radius + 1) for x in shifts if y > 0 or x > 0):
        here, there = _overlap(image.shape, down, right)
        exponent = image.dtype.type((down**2 + right**2) / (2 * widths.spatial**2))
        w = -exponent - sum((plane[here] - plane[there]) ** 2 for plane in planes)
        yield here, there, np.exp(w, out=w)


def _overlap(shape: tuple[int, ...], down: int, right: int) -> tuple[Window, Window]:
    """Return the pixels that have a neighbour at an offset, and these neighbours."""
    here = tuple(
        slice(max(-shift, 0), max(n - max(shift, 0), 0)) for n, shift in zip(shape, (down, right), strict=False)
    )
    there = tuple(
        slice(max(shift, 0), max(n + min(shift, 0), 0)) for n, shift in zip(shape, (down, right), strict=False)
    )
    return (here[0], here[1]), (there[0], there[1])
