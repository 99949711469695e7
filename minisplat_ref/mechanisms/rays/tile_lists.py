"""Lists of the primitives that the rays of each tile of an image may meet, by exact bounds of ellipsoids on the image.

A primitive is met only inside an ellipsoid ``(x - m)^T Sigma^-1 (x - m) <= q``, with its centre m in the camera frame.
The plane ``a = u z`` through the camera, for a = x or y, touches it where

    (m_a - u m_z)^2 = q (Sigma_aa - 2 u Sigma_az + u^2 Sigma_zz)

a quadratic in u, whose roots are the ellipsoid's bounds on the image. If it reaches behind the camera, it has one
bound, or none where it surrounds the axis. Its smallest z is ``m_z - sqrt(q Sigma_zz)``: since t on a pixel's ray is
z, that is a lower bound of t for all rays. A list is sorted by m_z, which is nearly the order of each ray's hits.

Bounds are slightly enlarged, so that rounding never excludes a ray that grazes the ellipsoid.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.jit.compile import kernel, scalar
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.types import Camera, Floats, Ints

TILE = 8  # pixels, both ways
SLACK = 1e-6  # of a bound, relative to 1 + |u|
BLOAT = 1e-9  # of m_z^2, added to q Sigma_zz: more than rounding changes there


class Ellipsoids(NamedTuple):
    """The regions in which N primitives are met, ``Sigma = A^T A``."""

    means: Floats
    """[N, 3] world frame."""
    axes: Floats
    """[N, K, 3] A, world frame: K is 3, or 2 of flat ones."""
    reaches: Floats
    """[N] q; below 0, or not a number, if the primitive is not met at all."""


class TileLists(NamedTuple):
    """The primitives of each tile, by the depths of their centres; T tiles, M pairs of a tile and a primitive."""

    offsets: Ints
    """[T + 1] where the list of each tile begins, tile rows from the top."""
    rows: Ints
    """[M] int32 primitives."""
    boxes: Ints
    """[N, 4] int32 first and one past the last pixel, x and y: x0, y0, x1, y1."""
    nearest: Floats
    """[N] lower bound of t."""
    row_offsets: Ints
    """[N + 1] where the pairs of each primitive begin in ``pairs``."""
    pairs: Ints
    """[M] int32 primitive by primitive, the places in ``rows`` that it has."""
    width: int
    """px."""
    height: int
    """px."""

    @property
    def n_pixels(self) -> int:
        """Pixels in all boxes: a ray through each pixel has no more hits than these together."""
        sides = self.boxes[:, 2:] - self.boxes[:, :2]
        return int(np.sum(sides[:, 0].astype(np.int64) * sides[:, 1]))


class _Frame(NamedTuple):
    R: Floats  # [3, 3]
    t: Floats  # [3]
    fx: float
    fy: float
    cx: float
    cy: float
    near: float
    far: float
    width: int
    height: int


def list_tiles(ellipsoids: Ellipsoids, camera: Camera, conventions: Conventions) -> TileLists:
    """Return the lists of the tiles of a camera's image.

    Parameters
    ----------
    ellipsoids : Ellipsoids
        N of them, float64.
    camera : Camera
        A pinhole.
    conventions : Conventions
        Near and far plane, and which principal point.
    """
    seen, n = with_principal_point(camera, conventions).astype(np.float64), len(ellipsoids.means)
    frame = _Frame(
        np.ascontiguousarray(seen.cam_from_world_R),
        np.ascontiguousarray(seen.cam_from_world_t),
        float(seen.fx),
        float(seen.fy),
        float(seen.cx),
        float(seen.cy),
        float(conventions.near_plane),
        float(conventions.far_plane),
        seen.width,
        seen.height,
    )
    boxes, depths, nearest = np.empty((n, 4), np.int32), np.empty(n), np.empty(n)
    offsets = np.zeros(-(-seen.width // TILE) * -(-seen.height // TILE) + 1, np.int64)
    row_offsets = np.zeros(n + 1, np.int64)
    _bound_all(ellipsoids, frame, boxes, (depths, nearest), offsets, row_offsets)
    order = np.argsort(depths, kind="stable")
    rows, pairs = np.empty((2, int(offsets[-1])), np.int32)
    _fill(order, boxes, -(-seen.width // TILE), offsets, row_offsets, rows, pairs)
    return TileLists(offsets, rows, boxes, nearest, row_offsets, pairs, seen.width, seen.height)


@scalar
def slopes(a, z, q_aa, q_az, q_zz):
    """Return the least and the greatest u = a / z of an ellipsoid's points in front of the camera, and slack.

    The three last arguments are ``q Sigma`` between the axes a and z.
    """
    A, B, C = z * z - q_zz, a * z - q_az, a * a - q_aa
    D = B * B - A * C
    root = math.sqrt(max(D, 0.0))
    low, high = -np.inf, np.inf
    if A > 0.0:
        low, high = (B - root) / A, (B + root) / A
    elif D > 0.0 and A < 0.0:  # at z = 0 its points have a on one side of the axis, that of the conditional mean
        if a * q_zz > q_az * z:
            low = (B - root) / A
        else:
            high = (B + root) / A
    return low - SLACK * (1.0 + abs(low)), high + SLACK * (1.0 + abs(high))


@scalar
def pixel_range(low, high, focal, center, n):
    """Return the first and one past the last of n pixels whose centres have slopes between two."""
    first = math.ceil(min(max(focal * low + center - 0.5, 0.0), float(n)))
    return first, math.floor(min(max(focal * high + center + 0.5, 0.0), float(n)))


@kernel(parallel=False)
def _bound_all(ellipsoids, frame, boxes, along, offsets, row_offsets):
    """Write boxes, depths and lower bounds of t, and where the pairs of each tile and of each primitive begin."""
    (means, axes, reaches), (depths, nearest) = ellipsoids, along
    R, t, n_columns = frame.R, frame.t, (frame.width + TILE - 1) // TILE
    for n in range(len(means)):
        boxes[n, 0] = boxes[n, 1] = boxes[n, 2] = boxes[n, 3] = 0
        depths[n] = np.inf
        q, mx, my, mz = reaches[n], means[n, 0], means[n, 1], means[n, 2]
        x = R[0, 0] * mx + R[0, 1] * my + R[0, 2] * mz + t[0]
        y = R[1, 0] * mx + R[1, 1] * my + R[1, 2] * mz + t[1]
        z = R[2, 0] * mx + R[2, 1] * my + R[2, 2] * mz + t[2]
        xx, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(axes.shape[1]):
            ax, ay, az = axes[n, k, 0], axes[n, k, 1], axes[n, k, 2]
            u = R[0, 0] * ax + R[0, 1] * ay + R[0, 2] * az
            v = R[1, 0] * ax + R[1, 1] * ay + R[1, 2] * az
            w = R[2, 0] * ax + R[2, 1] * ay + R[2, 2] * az
            xx, xz, yy, yz, zz = xx + u * u, xz + u * w, yy + v * v, yz + v * w, zz + w * w
        q_zz = q * zz + BLOAT * z * z
        depth = math.sqrt(max(q_zz, 0.0))
        if not (q >= 0.0 and np.isfinite(x + y + z) and np.isfinite(q * (xx + yy + zz))):
            continue
        if z + depth < frame.near or z - depth > frame.far:
            continue
        low, high = slopes(x, z, q * xx, q * xz, q_zz)
        x0, x1 = pixel_range(low, high, frame.fx, frame.cx, frame.width)
        low, high = slopes(y, z, q * yy, q * yz, q_zz)
        y0, y1 = pixel_range(low, high, frame.fy, frame.cy, frame.height)
        if x0 >= x1 or y0 >= y1:
            continue
        boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3] = x0, y0, x1, y1
        depths[n], nearest[n] = z, z - depth
        for row in range(y0 // TILE, (y1 - 1) // TILE + 1):
            for column in range(x0 // TILE, (x1 - 1) // TILE + 1):
                offsets[row * n_columns + column + 1] += 1
                row_offsets[n + 1] += 1
    for tile in range(len(offsets) - 1):
        offsets[tile + 1] += offsets[tile]
    for n in range(len(means)):
        row_offsets[n + 1] += row_offsets[n]


@kernel(parallel=False)
def _fill(order, boxes, n_columns, offsets, row_offsets, rows, pairs):
    """Write the lists, and where each primitive is in them."""
    places = offsets[:-1].copy()
    for n in order:
        x0, y0, x1, y1 = boxes[n]
        if x0 >= x1:
            continue
        i = row_offsets[n]
        for row in range(y0 // TILE, (y1 - 1) // TILE + 1):
            for column in range(x0 // TILE, (x1 - 1) // TILE + 1):
                tile = row * n_columns + column
                rows[places[tile]], pairs[i] = n, places[tile]
                places[tile] += 1
                i += 1
