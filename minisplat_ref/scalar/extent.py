"""The pixels that one projected Gaussian may touch: radii and a half-open box of pixels inside the image.

All results are whole numbers stored as floats. Boxes are clamped to the image, and radii, once the boxes are made, to
the range of int32, so that the cast to integers is defined.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref import constants
from minisplat_ref.constants import INRIA_ROOT_MIN, INRIA_TILE
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import ceil, floor, libm_log, maximum, minimum, sqrt
from minisplat_ref.jit.literals import HALF, ONE, THREE, TWO, ZERO

RADIUS_MAX = np.float32(constants.RADIUS_MAX)  # exact in float32


class Extent(NamedTuple):
    """The rule of extent, and the image to which boxes are clipped."""

    alpha_min: np.floating
    """In the data's dtype."""
    has_full_support: bool
    """Whether a Gaussian reaches as far as its alpha can be ``alpha_min``; otherwise INRIA's rule applies."""
    width: int
    """Of the image, pixels."""
    height: int


@scalar
def support_box(footprint, opacity, alpha_min, width, height):
    """Return the extent where alpha falls to alpha_min: sqrt(2 ln(opacity / alpha_min)) sigmas along x and y."""
    squared = TWO * libm_log(maximum(opacity / alpha_min, ONE))
    rx = ceil(sqrt(squared * footprint.cov_xx))
    ry = ceil(sqrt(squared * footprint.cov_yy))
    x0 = floor(minimum(maximum(footprint.x - rx, ZERO), width))
    y0 = floor(minimum(maximum(footprint.y - ry, ZERO), height))
    x1 = ceil(minimum(maximum(footprint.x + rx, ZERO), width))
    y1 = ceil(minimum(maximum(footprint.y + ry, ZERO), height))
    return minimum(rx, RADIUS_MAX), minimum(ry, RADIUS_MAX), x0, y0, x1, y1


@scalar
def inria_tiles(x, r, size):
    """Return the pixels of the tiles that INRIA counts under [x - r, x + r], with pixel centres at integer x."""
    beyond = size + INRIA_TILE - 1
    first = floor(minimum(maximum(x - r, ZERO), beyond) / INRIA_TILE)
    end = floor(minimum(maximum(x + r + (INRIA_TILE - 1), ZERO), beyond) / INRIA_TILE)
    return first * INRIA_TILE, minimum(end * INRIA_TILE, size)


@scalar
def inria_box(footprint, width, height):
    """Return the tiles under the square of half-side ceil(3 sqrt(lambda_1)), three sigmas of the longer axis."""
    middle = HALF * (footprint.cov_xx + footprint.cov_yy)
    half_difference = HALF * (footprint.cov_xx - footprint.cov_yy)  # middle^2 - det, without its cancellation
    root = half_difference * half_difference + footprint.cov_xy * footprint.cov_xy
    largest = middle + sqrt(maximum(root, INRIA_ROOT_MIN))
    r = ceil(THREE * sqrt(largest))
    x0, x1 = inria_tiles(footprint.x - HALF, r, width)
    y0, y1 = inria_tiles(footprint.y - HALF, r, height)
    r = minimum(r, RADIUS_MAX)
    return r, r, x0, y0, x1, y1


@scalar
def is_seen(z, opacity, footprint, conic, reach, alpha_min, constants):
    """Return whether a Gaussian is not culled, given conic (a, b, c) and reach (radii, box)."""
    rx, ry, x0, y0, x1, y1 = reach
    is_between = (z > constants.near) & (z < constants.far) & (opacity >= alpha_min) & (footprint.det > ZERO)
    # Finite if all of them are.
    size = footprint.det + abs(conic[0]) + abs(conic[2]) + abs(footprint.x) + abs(footprint.y)
    return is_between & (size < np.inf) & (rx > ZERO) & (ry > ZERO) & (x1 > x0) & (y1 > y0)
