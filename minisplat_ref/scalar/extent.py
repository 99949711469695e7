"""Which pixels one projected Gaussian may touch: radii and a half-open box of pixels inside the image.

The numbers are whole but floats. Boxes are clamped to the image, and radii, when the boxes are made, to what int32
holds, so that a cast to integers is defined.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref import constants
from minisplat_ref.constants import INRIA_ROOT_MIN, INRIA_TILE
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import ceil, floor, larger, log_of, smaller, sqrt
from minisplat_ref.jit.literals import HALF, ONE, THREE, TWO, ZERO

RADIUS_MAX = np.float32(constants.RADIUS_MAX)  # exact in float32


class Extent(NamedTuple):
    """How far Gaussians reach, and the image that their boxes are cut to."""

    alpha_min: np.floating
    """In the data's dtype."""
    has_full_support: bool
    """As far as alpha can be ``alpha_min``; otherwise by INRIA's rule."""
    width: int
    """Of the image, pixels."""
    height: int


@scalar
def support_box(footprint, opacity, alpha_min, width, height):
    """Extent at which alpha falls to alpha_min: sqrt(2 ln(opacity / alpha_min)) standard deviations along x and y."""
    squared = TWO * log_of(larger(opacity / alpha_min, ONE))
    rx = ceil(sqrt(squared * footprint.cov_xx))
    ry = ceil(sqrt(squared * footprint.cov_yy))
    x0 = floor(smaller(larger(footprint.x - rx, ZERO), width))
    y0 = floor(smaller(larger(footprint.y - ry, ZERO), height))
    x1 = ceil(smaller(larger(footprint.x + rx, ZERO), width))
    y1 = ceil(smaller(larger(footprint.y + ry, ZERO), height))
    return smaller(rx, RADIUS_MAX), smaller(ry, RADIUS_MAX), x0, y0, x1, y1


@scalar
def inria_tiles(x, r, size):
    """Pixels of the tiles that INRIA counts under [x - r, x + r], where x counts pixel centres as integers."""
    beyond = size + INRIA_TILE - 1
    first = floor(smaller(larger(x - r, ZERO), beyond) / INRIA_TILE)
    end = floor(smaller(larger(x + r + (INRIA_TILE - 1), ZERO), beyond) / INRIA_TILE)
    return first * INRIA_TILE, smaller(end * INRIA_TILE, size)


@scalar
def inria_box(footprint, width, height):
    """Tiles touched by the square of half-side ceil(3 sqrt(lambda_1)), three standard deviations of the longer axis."""
    middle = HALF * (footprint.cov_xx + footprint.cov_yy)
    half_difference = HALF * (footprint.cov_xx - footprint.cov_yy)  # middle^2 - det, without its cancellation
    root = half_difference * half_difference + footprint.cov_xy * footprint.cov_xy
    largest = middle + sqrt(larger(root, INRIA_ROOT_MIN))
    r = ceil(THREE * sqrt(largest))
    x0, x1 = inria_tiles(footprint.x - HALF, r, width)
    y0, y1 = inria_tiles(footprint.y - HALF, r, height)
    r = smaller(r, RADIUS_MAX)
    return r, r, x0, y0, x1, y1
