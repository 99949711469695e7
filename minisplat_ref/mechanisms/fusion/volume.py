"""A grid of voxels with the fused truncated signed distances, weights and colours.

Curless & Levoy 1996, as KinectFusion has it. A view measures how far a voxel at x, of depth z, lies in front of the
surface that the view shows there, ``s = z_surface(u, v) - z``. Behind the surface by more than the truncation t it is
ignored; else, with the weight w of all views before,

    d = min(s / t, 1),   D <- (w D + d) / (w + 1),   w <- w + 1

and the surface is where D is 0. Colours are the mean of the views for which the voxel is within t of the surface.

The grid lies in the world, or, for scenes without bounds, in a world that is contracted about a centre c (Barron et
al. 2022, equation 10), in which everything is in a ball of radius 2:

    y = (x - c) / r   within the radius r,   y = (2 - r / |x - c|) (x - c) / |x - c|   beyond it

There voxels grow with the distance, and the truncation grows with them, by ``1 / (2 - |y|)``.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.memory import as_text, free_bytes
from minisplat_ref.types import Floats

BYTES_PER_VOXEL = 4 * (1 + 1 + 3 + 1)
PEAK_BYTES_PER_VOXEL = BYTES_PER_VOXEL + 8 + 8  # while the surface is extracted: copies of distances and weights
BOUND = 2.0  # of contracted coordinates


class Contraction(NamedTuple):
    """The contraction of the world."""

    center: tuple[float, float, float]
    """c, world frame."""
    radius: float
    """r, world units: within it nothing is contracted."""


class Grid(NamedTuple):
    """The places of the voxels."""

    origin: tuple[float, float, float]
    """Centre of the first voxel: world frame, or contracted."""
    voxel: float
    """Distance of neighbours, in the same unit."""
    shape: tuple[int, int, int]
    """Voxels along x, y and z."""
    contraction: Contraction | None = None
    """None for a grid in the world."""

    @property
    def n_voxels(self) -> int:
        """The number of voxels."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    def places(self, x: slice = slice(None)) -> Floats:
        """Return the centres of voxels [nx, ny, nz, 3], float64, in the grid's own coordinates; ``x``: which slabs."""
        axes = [o + self.voxel * np.arange(n) for o, n in zip(self.origin, self.shape, strict=True)]
        return np.stack(np.meshgrid(axes[0][x], axes[1], axes[2], indexing="ij"), axis=-1)

    def to_world(self, places: Floats) -> Floats:
        """Return places [..., 3] of the grid in the world; those on the bound of a contracted one are infinite."""
        if self.contraction is None:
            return places
        length = np.linalg.norm(places, axis=-1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            beyond = places / (length * np.maximum(BOUND - length, 0))
        c, r = self.contraction
        return np.array(c) + r * np.where(length <= 1, places, beyond)

    def from_world(self, points: Floats) -> Floats:
        """Return points [..., 3] of the world in the grid's coordinates."""
        if self.contraction is None:
            return points
        y = (points - np.array(self.contraction.center)) / self.contraction.radius
        length = np.maximum(np.linalg.norm(y, axis=-1, keepdims=True), np.finfo(float).tiny)
        return np.where(length <= 1, y, (BOUND - 1 / length) * y / length)


class Volume(NamedTuple):
    """The data of voxels, C-contiguous float32."""

    distances: Floats
    """[nx, ny, nz] D in [-1, 1]; 0 where nothing was seen."""
    weights: Floats
    """[nx, ny, nz] w, views."""
    colors: Floats
    """[nx, ny, nz, 3] mean RGB of the views near the surface."""
    n_near: Floats
    """[nx, ny, nz] number of these views."""


class DepthMap(NamedTuple):
    """The surface in one view."""

    depth: Floats
    """[H, W] camera z of the surface, world units; 0 where it shows none."""
    image: Floats
    """[H, W, 3] RGB."""


def empty_volume(grid: Grid) -> Volume:
    """Return a volume in which nothing has been fused.

    Raises
    ------
    InputError
        It does not fit into memory; the message suggests a voxel size that does.
    """
    needed, free = PEAK_BYTES_PER_VOXEL * grid.n_voxels, free_bytes()
    if needed > free:
        fits = grid.voxel * (needed / free) ** (1 / 3)
        size = " x ".join(map(str, grid.shape))
        raise InputError(
            f"{size} voxels of {grid.voxel:.4g} take about {as_text(needed)}, {as_text(free)} are free: --voxel"
            f" {float(f'{1.05 * fits:.2g}'):g} fits"
        )
    scalars = [np.zeros(grid.shape, np.float32) for _ in range(3)]
    return Volume(scalars[0], scalars[1], np.zeros((*grid.shape, 3), np.float32), scalars[2])
