"""Depth peeling of translucent triangles and its gradient, in NumPy: layer by layer, each of all pixels at once.

The ray of a pixel is t d, ``d = ((x - c_x) / f_x, (y - c_y) / f_y, 1)``, so that t is the depth. It meets the triangle
of the corners P_0, P_1, P_2, camera frame, with the sides ``e_i = P_i - P_0``, where (Moeller & Trumbore 1997)::

    P_0 + b_1 e_1 + b_2 e_2 = t d
    h = d x e_2,  q = e_1 x P_0,  a = e_1 . h
    b_1 = -P_0 . h / a,  b_2 = d . q / a,  t = e_2 . q / a,  b_0 = 1 - b_1 - b_2
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from minisplat_ref.mechanisms.peeling.layers import (
    ANGLE_MIN,
    Frame,
    Peeled,
    PeelGradient,
    TranslucentMesh,
    gradient_of,
)
from minisplat_ref.reference.pinhole import pinhole, pinhole_rays
from minisplat_ref.types import Bools, Floats, Ints

PAIRS_AT_ONCE = 1 << 20  # of a triangle and a pixel of its box, which are tested together


class Fragments(NamedTuple):
    """F intersections of rays and triangles, in the order of the pixels, nearest first."""

    pixels: Ints  # [F] flat index
    faces: Ints  # [F]
    places: Floats  # [F, 3] barycentric coordinates b
    depths: Floats  # [F] t
    layers: Ints  # [F] 0 for a pixel's nearest


class Tape(NamedTuple):
    """The values that the gradient needs again."""

    corners: Floats  # [T, 3, 3] camera frame
    fragments: Fragments  # of the layers that were blended
    transmittances: Floats  # [F] in front of each
    T_end: Floats  # [H W]


def peel(mesh: TranslucentMesh, frame: Frame, background: Floats) -> Peeled:
    """Render a mesh.

    Parameters
    ----------
    mesh : TranslucentMesh
        Float32 or float64, of which the image is.
    frame : Frame
        From where it is seen.
    background : ndarray of shape (3,)
        RGB behind everything.

    Returns
    -------
    Peeled
    """
    camera, dtype = frame.camera, mesh.vertices.dtype
    R, t = camera.cam_from_world_R.astype(np.float64), camera.cam_from_world_t.astype(np.float64)
    corners = (mesh.vertices.astype(np.float64) @ R.T + t)[mesh.faces]  # [T, 3, 3]
    found = meet(corners, frame)
    n_pixels = camera.width * camera.height
    n_layers = np.bincount(found.pixels, minlength=n_pixels)
    is_seen = np.bincount(found.faces, minlength=len(mesh.faces)) > 0
    found = Fragments._make(field[found.layers < frame.max_layers] for field in found)

    colors, alphas = _shade(mesh, found)
    image, T, transmittances = np.zeros((n_pixels, 3)), np.ones(n_pixels), np.ones(len(alphas))
    for layer in _layers(found):
        at = found.pixels[layer]
        transmittances[layer] = T[at]
        image[at] += (T[at] * alphas[layer])[:, None] * colors[layer]
        T[at] *= 1 - alphas[layer]
    image += T[:, None] * background
    size = camera.height, camera.width
    return Peeled(
        image.reshape(*size, 3).astype(dtype),
        (1 - T).reshape(size).astype(dtype),
        n_layers.reshape(size),
        is_seen,
        Tape(corners, found, transmittances, T),
    )


def peel_vjp(
    mesh: TranslucentMesh, frame: Frame, background: Floats, peeled: Peeled, v_image: Floats, v_alpha: Floats
) -> PeelGradient:
    """Gradient of :func:`peel`.

    A pixel of derivatives v, v_A goes through its layers from behind. The light from behind layer l is s_l, and needs
    no division by ``1 - alpha``, which is zero for an opaque one::

        s_last = v . background,           s_(l-1) = alpha_l (v . c_l + v_A) + (1 - alpha_l) s_l
        v_c_l = alpha_l T_l v,             v_alpha_l = T_l (v . c_l + v_A - s_l)

    Colour and opacity are linear in b, and b follows the corners. Differentiating ``sum_i b_i P_i = t d`` gives
    ``e_1 db_1 + e_2 db_2 - d dt = -sum_i b_i dP_i``, so that with the adjoint w of these three columns::

        v_b_i = v_c . c_i + v_alpha a_i
        e_1 . w = v_b_1 - v_b_0,   e_2 . w = v_b_2 - v_b_0,   d . w = 0
        v_P_i = -b_i w

    Parameters
    ----------
    mesh, frame, background
        As for the forward function.
    peeled : Peeled
        Its result.
    v_image : ndarray of shape (H, W, 3)
        Derivative with respect to the image.
    v_alpha : ndarray of shape (H, W)
        Derivative with respect to the accumulated opacity.

    Returns
    -------
    PeelGradient
    """
    tape: Tape = peeled.tape
    found, T = tape.fragments, tape.transmittances
    colors, alphas = _shade(mesh, found)
    v, v_A = v_image.reshape(-1, 3).astype(np.float64), v_alpha.ravel().astype(np.float64)
    v_dot_c = np.sum(v[found.pixels] * colors, axis=1) + v_A[found.pixels]  # [F] v . c + v_A
    behind = v @ background  # [H W] s
    v_rgba = np.empty((len(alphas), 4))
    v_rgba[:, :3] = (alphas * T)[:, None] * v[found.pixels]
    for layer in reversed(list(_layers(found))):
        at = found.pixels[layer]
        v_rgba[layer, 3] = T[layer] * (v_dot_c[layer] - behind[at])
        behind[at] = alphas[layer] * v_dot_c[layer] + (1 - alphas[layer]) * behind[at]

    rows = mesh.faces[found.faces]  # [F, 3] of the vertices
    v_places = np.einsum("fk,fik->fi", v_rgba, mesh.rgba[rows].astype(np.float64))  # v_b
    corners = tape.corners[found.faces]  # [F, 3, 3]
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], _rays(found.pixels, frame)], axis=1)
    v_sides = np.column_stack([v_places[:, 1:] - v_places[:, :1], np.zeros(len(rows))])
    w = np.linalg.solve(sides, v_sides[:, :, None])[:, :, 0]  # [F, 3]
    v_camera, v_vertex_rgba = np.zeros(mesh.vertices.shape), np.zeros(mesh.rgba.shape)
    np.add.at(v_camera, rows, -found.places[:, :, None] * w[:, None])
    np.add.at(v_vertex_rgba, rows, found.places[:, :, None] * v_rgba[:, None])
    return gradient_of(mesh, frame, v_camera, v_vertex_rgba, tape.T_end @ v)


def meet(corners: Floats, frame: Frame) -> Fragments:
    """Return the intersections of the rays of all pixels with triangles.

    Parameters
    ----------
    corners : ndarray of shape (T, 3, 3)
        Triangle, corner, axis; camera frame.
    frame : Frame
        Camera and near plane.
    """
    P_0, e_1, e_2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(e_1, e_2)
    with np.errstate(divide="ignore", invalid="ignore"):
        volumes = np.sum(normals * P_0, axis=1)  # [T]
        limits = ANGLE_MIN * np.linalg.norm(normals, axis=1) * np.linalg.norm(P_0, axis=1)
        is_drawn = np.abs(volumes) > limits
        # [T, 3, 3]: b_i / t is the product of row i with d. Only the sign of its slope matters, and only on an edge.
        slopes = np.stack([np.cross(*corners[:, pair].swapaxes(0, 1)) for pair in ([1, 2], [2, 0], [0, 1])], axis=1)
        slopes /= volumes[:, None, None]
    parts = []
    for faces, pixels in _candidates(corners, is_drawn, frame):
        d, sides = _rays(pixels, frame), e_2[faces]
        h, q = np.cross(d, sides), np.cross(e_1[faces], P_0[faces])
        with np.errstate(divide="ignore", invalid="ignore"):
            a = np.sum(e_1[faces] * h, axis=1)
            b_1, b_2 = -np.sum(P_0[faces] * h, axis=1) / a, np.sum(d * q, axis=1) / a
            t = np.sum(sides * q, axis=1) / a
        b = np.column_stack([1 - b_1 - b_2, b_1, b_2])
        is_inside = _is_inside(b, slopes[faces, :, :2]).all(axis=1) & (t > frame.near)
        parts.append(Fragments(pixels, faces, b, t, np.zeros_like(pixels)))
        parts[-1] = Fragments._make(field[is_inside] for field in parts[-1])
    empty = np.zeros(0, np.int64)
    parts.append(Fragments(empty, empty, np.zeros((0, 3)), np.zeros(0), empty))
    found = Fragments._make(np.concatenate(fields) for fields in zip(*parts, strict=True))
    found = Fragments._make(field[np.lexsort((found.faces, found.depths, found.pixels))] for field in found)
    first = np.searchsorted(found.pixels, found.pixels)
    return found._replace(layers=np.arange(len(first)) - first)


def _is_inside(b: Floats, slopes: Floats) -> Bools:
    """Return on which of its edges' inner sides [F, 3] a pixel lies; exactly on one, where it moves to the right."""
    moves_in = (slopes[..., 0] > 0) | ((slopes[..., 0] == 0) & (slopes[..., 1] > 0))
    inside: Bools = (b > 0) | ((b == 0) & moves_in)
    return inside


def _candidates(corners: Floats, is_drawn: Bools, frame: Frame) -> Iterator[tuple[Ints, Ints]]:
    """Yield pairs of triangles and pixels: those of its box, or all if it passes through the near plane."""
    width, height = frame.camera.width, frame.camera.height
    is_crossing = np.asarray((corners[:, :, 2] <= frame.near).any(axis=1))
    is_drawn = is_drawn & np.asarray((corners[:, :, 2] > frame.near).any(axis=1))
    in_front = np.where(is_crossing[:, None, None], [0.0, 0.0, 1.0], corners)
    with np.errstate(over="ignore", invalid="ignore"):
        uv = pinhole(in_front.reshape(-1, 3), frame.camera).reshape(-1, 3, 2)
    low = np.where(is_crossing[:, None], 0, np.clip(np.floor(uv.min(axis=1)) - 1, 0, (width, height)))
    high = np.where(is_crossing[:, None], (width, height), np.clip(np.ceil(uv.max(axis=1)) + 1, 0, (width, height)))
    low = np.nan_to_num(low).astype(np.int64)
    sizes = np.where(is_drawn[:, None], np.nan_to_num(high).astype(np.int64) - low, 0)  # [T, 2]
    n_pixels = sizes.prod(axis=1)
    ends = np.cumsum(n_pixels)
    rows = np.flatnonzero(n_pixels)
    for part in np.split(rows, np.flatnonzero(np.diff(ends[rows] // PAIRS_AT_ONCE)) + 1):
        faces = np.repeat(part, n_pixels[part])
        k = np.arange(len(faces)) - np.repeat(np.cumsum(n_pixels[part]) - n_pixels[part], n_pixels[part])
        xs, ys = low[faces, 0] + k % sizes[faces, 0], low[faces, 1] + k // sizes[faces, 0]
        yield faces, ys * width + xs


def _rays(pixels: Ints, frame: Frame) -> Floats:
    """Return the directions d [F, 3] of pixels."""
    width = frame.camera.width
    return pinhole_rays(pixels % width + 0.5, pixels // width + 0.5, frame.camera)


def _shade(mesh: TranslucentMesh, found: Fragments) -> tuple[Floats, Floats]:
    """Return colours [F, 3] and alphas [F]."""
    rgba = np.einsum("fi,fik->fk", found.places, mesh.rgba[mesh.faces[found.faces]].astype(np.float64))
    return rgba[:, :3], rgba[:, 3]


def _layers(found: Fragments) -> Iterator[Ints]:
    """Yield the fragments of the pixels' nearest layer, then of the next, until none is left."""
    by_layer = np.argsort(found.layers, kind="stable")
    yield from np.split(by_layer, np.flatnonzero(np.diff(found.layers[by_layer])) + 1)
