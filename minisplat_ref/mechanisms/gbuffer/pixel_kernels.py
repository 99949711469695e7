"""The points of pixels as kernels: the functions of :mod:`.pixels`, which states the equations.

Each pixel is read and written once, and the arithmetic is float64 whatever the data.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.gaussian_rows import contiguous
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.mechanisms.gbuffer.formulas import load_triple, store_triple, turn, turn_back
from minisplat_ref.mechanisms.gbuffer.pixels import N_MATERIAL, Blended, Points
from minisplat_ref.mechanisms.gbuffer.shading import ShadingGradient, Surface
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.scalar.projection import dot
from minisplat_ref.types import Camera, Floats, Ints

N_CHUNKS = 32


class _Frame(NamedTuple):
    """A camera, and the places of channels."""

    R: Floats  # [3, 3] cam_from_world, float64
    slopes_x: Floats  # [W] of rays through columns, x over z
    slopes_y: Floats  # [H] of rays through rows, y over z
    normals: int
    carried: int


class _Pixels(NamedTuple):
    """The pixels that are points."""

    rows: Ints  # [P] y W + x
    alpha: Floats  # [P]
    lengths: Floats  # [P] of the summed normals


class _Fields(NamedTuple):
    """The points, or the gradient with respect to them."""

    albedo: Floats  # [P, 3]
    metallic: Floats  # [P]
    roughness: Floats  # [P]
    normals: Floats  # [P, 3]
    to_camera: Floats  # [P, 3]
    own: Floats  # [P, 3]; of the gradient [0, 3] without one, likewise below
    further: Floats  # [P, K]


@scalar
def _towards_camera(row, frame):
    """Return -u of a pixel, camera frame."""
    width = frame.slopes_x.size
    x, y = frame.slopes_x[row % width], frame.slopes_y[row // width]
    inverse = -1.0 / math.sqrt(x * x + y * y + 1.0)
    return x * inverse, y * inverse, inverse


@scalar
def _fill_point(i, sums, frame, pixels, points):
    row, first, per_alpha = pixels.rows[i], frame.carried, 1.0 / pixels.alpha[i]
    N = float(sums[row, frame.normals]), float(sums[row, frame.normals + 1]), float(sums[row, frame.normals + 2])
    length = math.sqrt(dot(N, N))
    pixels.lengths[i] = length
    store_triple(points.normals, i, turn_back(frame.R, (N[0] / length, N[1] / length, N[2] / length)))
    store_triple(points.to_camera, i, turn_back(frame.R, _towards_camera(row, frame)))
    for c in range(3):
        points.own[i, c] = per_alpha * sums[row, c]
        points.albedo[i, c] = per_alpha * sums[row, first + c]
    points.metallic[i], points.roughness[i] = per_alpha * sums[row, first + 3], per_alpha * sums[row, first + 4]
    for c in range(points.further.shape[1]):
        points.further[i, c] = per_alpha * sums[row, first + N_MATERIAL + c]


@scalar
def _chain_point(i, pixels, points, v, frame, v_sums):
    """Add the gradient of a pixel's sums; return that with respect to its alpha."""
    row, first, per_alpha, per_length = pixels.rows[i], frame.carried, 1.0 / pixels.alpha[i], 1.0 / pixels.lengths[i]
    n, v_n = load_triple(points.normals, i), load_triple(v.normals, i)
    along = dot(n, v_n)
    a = v_n[0] - along * n[0], v_n[1] - along * n[1], v_n[2] - along * n[2]
    total = dot(load_triple(v.albedo, i), load_triple(points.albedo, i))
    total += float(v.metallic[i]) * points.metallic[i] + float(v.roughness[i]) * points.roughness[i]
    v_N = turn(frame.R, (per_length * a[0], per_length * a[1], per_length * a[2]))
    for c in range(3):
        v_sums[row, frame.normals + c] += v_N[c]
        v_sums[row, first + c] += per_alpha * v.albedo[i, c]
    v_sums[row, first + 3] += per_alpha * v.metallic[i]
    v_sums[row, first + 4] += per_alpha * v.roughness[i]
    if v.own.size > 0:
        for c in range(3):
            v_sums[row, c] += per_alpha * v.own[i, c]
            total += float(v.own[i, c]) * points.own[i, c]
    if v.further.size > 0:
        for c in range(v.further.shape[1]):
            v_sums[row, first + N_MATERIAL + c] += per_alpha * v.further[i, c]
            total += float(v.further[i, c]) * points.further[i, c]
    return -total * per_alpha


@scalar
def _fill_range(begin, end, sums, frame, pixels, points):
    for i in range(begin, end):
        _fill_point(i, sums, frame, pixels, points)


@scalar
def _chain_range(span, pixels, points, v, frame, v_sums, v_alpha):
    for i in range(span[0], span[1]):
        v_alpha[pixels.rows[i]] += _chain_point(i, pixels, points, v, frame, v_sums)


@kernel()
def _fill(
    sums,  # [H W, D]
    frame,  # _Frame
    pixels,  # _Pixels
    points,  # _Fields
):
    n = pixels.rows.size
    for chunk in prange(N_CHUNKS):
        _fill_range(n * chunk // N_CHUNKS, n * (chunk + 1) // N_CHUNKS, sums, frame, pixels, points)


@kernel()
def _chain(
    pixels,  # _Pixels
    points,  # _Fields
    v,  # _Fields
    frame,  # _Frame
    v_sums,  # [H W, D]
    v_alpha,  # [H W]
):
    n = pixels.rows.size
    for chunk in prange(N_CHUNKS):
        _chain_range((n * chunk // N_CHUNKS, n * (chunk + 1) // N_CHUNKS), pixels, points, v, frame, v_sums, v_alpha)


def points_of(blended: Blended, rows: Ints, camera: Camera) -> Points:
    """Return the points of pixels ``rows`` [P]; see :func:`.pixels.points_of`."""
    sums, dtype, n = _flat(blended.sums), blended.sums.dtype, len(rows)
    a, normals, to_camera, own = np.empty((4, n, 3), dtype)
    metallic, roughness, lengths = np.empty((3, n), dtype)
    further = np.empty((n, sums.shape[1] - blended.carried - N_MATERIAL), dtype)
    alpha = blended.alpha.ravel()[rows]
    fields = _Fields(a, metallic, roughness, normals, to_camera, own, further)
    _fill(sums, _pack_frame(camera, blended), _Pixels(rows, alpha, lengths), fields)
    return Points(rows, alpha, lengths, Surface(*fields[:5]), own, further)


def points_vjp(points: Points, camera: Camera, v: ShadingGradient, v_blended: Blended) -> None:
    """Add the gradient of :func:`points_of` to ``v_blended``; see :func:`.pixels.points_vjp`.

    ::

        v_sums = v_X / A,   v_N = R (v_n - n (n.v_n)) / |N|,   v_A = -sum v_X . X / A
    """
    own = points.own[:0] if v.scattered is None else v.scattered
    further = points.further[:0] if v.around is None else v.around
    _chain(
        _Pixels(points.rows, points.alpha, points.lengths),
        _Fields(*contiguous(*points.surface, points.own, points.further)),
        _Fields(*contiguous(*v.surface, own, further)),
        _pack_frame(camera, v_blended),
        _flat(v_blended.sums),
        v_blended.alpha.reshape(-1),
    )


def _flat(sums: Floats) -> Floats:
    return sums.reshape(-1, sums.shape[2])


def _pack_frame(camera: Camera, blended: Blended) -> _Frame:
    R, (height, width) = np.ascontiguousarray(camera.cam_from_world_R, np.float64), blended.alpha.shape
    slopes_x = np.ascontiguousarray(pinhole_rays(np.arange(width) + 0.5, 0.5, camera)[:, 0])
    slopes_y = np.ascontiguousarray(pinhole_rays(0.5, np.arange(height) + 0.5, camera)[:, 1])
    return _Frame(R, slopes_x, slopes_y, blended.normals, blended.carried)
