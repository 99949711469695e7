"""Transmittance of a scene of surfels along arbitrary rays: reflected ones, or ones to a lamp.

The ray ``O + t d`` meets the disc of the centre mu, the axes r_0 and r_1, the normal n and the deviations s at::

    t = n.(mu - O) / n.d,   u = (O + t d - mu).r_0 / s_0,   v = (O + t d - mu).r_1 / s_1
    alpha = min(alpha_max, o exp(-(u^2 + v^2) / 2))

and the transmittance is the product of all 1 - alpha, in any order. Hits of alpha below ``alpha_min`` do not count, and
no more are sought where less than ``transmittance_min`` is left. There is no low-pass: a disc is hit where it is. There
is no gradient; visibility changes in steps.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.jit.compile import n_threads
from minisplat_ref.mechanisms.gbuffer.ray_kernels import CENTRE, NORMAL, U, V, measuring_kernel, tree_of
from minisplat_ref.mechanisms.rays.pixel_rays import Rays
from minisplat_ref.mechanisms.rays.traversal import OPACITY, limits_of
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats, Primitives

RAYS_AT_ONCE = 256  # in NumPy


def transmittances(primitives: Primitives, rays: Rays, conventions: Conventions, backend: Backend) -> Floats:
    """Return the transmittance of each ray.

    Parameters
    ----------
    primitives : Primitives
        N surfels, world frame; their third scale is not read.
    rays : Rays
        P rays; only hits between near and far count.
    conventions : Conventions
        ``alpha_min``, ``alpha_max`` and ``transmittance_min`` are used.
    backend : Backend
        Compiled: by a tree of boxes. Otherwise every ray is tried against every surfel.

    Returns
    -------
    ndarray of shape (P,)
        In [0, 1], float64.
    """
    records = _records(primitives)
    if not backend.is_compiled:
        return _try_all_pairs(records, rays, conventions)
    tree = tree_of(records, conventions)
    left = np.empty(len(rays.near))
    wide = Rays(*(np.ascontiguousarray(field, np.float64) for field in rays))
    measuring_kernel()(tree, wide, limits_of(conventions, len(tree.gaussian_ids)), n_threads(), left)
    return left


def _records(primitives: Primitives) -> Floats:
    """Return the columns [N, 13] of all surfels."""
    means, quats, scales, opacities = (field.astype(np.float64) for field in primitives)
    R = rotation_matrices(quats)
    with np.errstate(divide="ignore", over="ignore"):
        axes = R[:, :, :2] / scales[:, None, :2]
    return np.column_stack([opacities, means, axes[:, :, 0], axes[:, :, 1], R[:, :, 2]])


def _try_all_pairs(records: Floats, rays: Rays, conventions: Conventions) -> Floats:
    left = np.ones(len(rays.near))
    opacities, centres, normals = records[:, OPACITY], records[:, CENTRE:U], records[:, NORMAL:]
    for first in range(0, len(left), RAYS_AT_ONCE):
        rows = slice(first, first + RAYS_AT_ONCE)
        origins, d = rays.origins[rows, None], rays.directions[rows, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.sum(normals * (centres - origins), axis=2) / np.sum(normals * d, axis=2)  # [P', N]
            p = origins + t[:, :, None] * d - centres
            q = np.sum(p * records[:, U:V], axis=2) ** 2 + np.sum(p * records[:, V:NORMAL], axis=2) ** 2
            alphas = np.minimum(conventions.alpha_max, opacities * np.exp(-q / 2))
            is_hit = (rays.near[rows, None] < t) & (t < rays.far[rows, None]) & (alphas >= conventions.alpha_min)
        left[rows] = np.prod(np.where(is_hit, 1 - alphas, 1), axis=1)
    return left
