"""From what a pixel blends to the surface point that it shows.

A pixel of the opacity A has sums over its hits: of own colours, of normals, N, and of what else surfels carry, a
material and the light from around or nothing. Its point, in the world frame, has the means of them, and::

    X = sums / A,   n = R^T N / |N|,   v = -R^T u

with the unit direction u of its ray and R of the camera. :mod:`.pixel_kernels` has the same functions as kernels.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.mechanisms.gbuffer.shading import ShadingGradient, Surface
from minisplat_ref.training.sky import unit_rays
from minisplat_ref.types import Camera, Floats, Ints

N_MATERIAL = 5  # albedo, metallic share, roughness


class Blended(NamedTuple):
    """The sums of all pixels, or the gradient with respect to them."""

    sums: Floats
    """[H, W, D]; own colours are the first three channels."""
    alpha: Floats
    """[H, W] A."""
    normals: int
    """The first of three channels of normals."""
    carried: int
    """The first channel of a material; what is carried beside it follows, up to the last channel."""


class Points(NamedTuple):
    """The points of P pixels."""

    rows: Ints
    """[P] the pixels, y W + x."""
    alpha: Floats
    """[P] A."""
    lengths: Floats
    """[P] of the summed normals."""
    surface: Surface
    own: Floats
    """[P, 3] mean own colours."""
    further: Floats
    """[P, K] means of what is carried beside a material."""


def find_rows(blended: Blended, alpha_min: float) -> Ints:
    """Return the pixels, y W + x, of an opacity above ``alpha_min`` whose normals do not cancel."""
    N = blended.sums[:, :, blended.normals : blended.normals + 3]
    return np.flatnonzero((blended.alpha > alpha_min) & (np.einsum("yxk,yxk->yx", N, N) > 0))


def points_of(blended: Blended, rows: Ints, camera: Camera) -> Points:
    """Return the points of pixels ``rows`` [P] that a camera shows."""
    R = camera.cam_from_world_R.astype(blended.sums.dtype)
    sums, alpha = blended.sums.reshape(-1, blended.sums.shape[2])[rows], blended.alpha.ravel()[rows]
    N = sums[:, blended.normals : blended.normals + 3]
    lengths, X = np.linalg.norm(N, axis=1), sums / alpha[:, None]
    material, further = np.split(X[:, blended.carried :], [N_MATERIAL], axis=1)
    v = -unit_rays(camera, rows, sums.dtype) @ R
    surface = Surface(material[:, :3], material[:, 3], material[:, 4], N / lengths[:, None] @ R, v)
    return Points(rows, alpha, lengths, surface, X[:, :3], further)


def points_vjp(points: Points, camera: Camera, v: ShadingGradient, v_blended: Blended) -> None:
    """Add the gradient of :func:`points_of` to ``v_blended``, in which own colours have none so far.

    ::

        v_sums = v_X / A,   v_N = R (v_n - n (n.v_n)) / |N|,   v_A = -sum v_X . X / A
    """
    R = camera.cam_from_world_R.astype(points.alpha.dtype)
    v_surface, n = v.surface, points.surface.normals
    v_sums = v_blended.sums.reshape(-1, v_blended.sums.shape[2])
    a, m, roughness, *_ = points.surface
    v_A = -np.sum(v_surface.albedo * a, axis=1) - v_surface.metallic * m - v_surface.roughness * roughness
    v_n = v_surface.normals - n * np.sum(n * v_surface.normals, axis=1, keepdims=True)
    v_sums[points.rows, v_blended.normals : v_blended.normals + 3] += v_n @ R.T / points.lengths[:, None]
    v_material = np.column_stack([v_surface.albedo, v_surface.metallic, v_surface.roughness])
    first, alpha = v_blended.carried, points.alpha[:, None]
    v_sums[points.rows, first : first + N_MATERIAL] += v_material / alpha
    if v.scattered is not None:
        v_A -= np.sum(v.scattered * points.own, axis=1)
        v_sums[points.rows, :3] += v.scattered / alpha
    if v.around is not None:
        v_A -= np.sum(v.around * points.further, axis=1)
        v_sums[points.rows, first + N_MATERIAL :] += v.around / alpha
    v_blended.alpha.reshape(-1)[points.rows] += v_A / points.alpha
