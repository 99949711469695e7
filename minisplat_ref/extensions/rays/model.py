"""Gaussians as rays meet them: maps to the unit ball, intersections, the tree, the renderer, and the recipe.

This is section 3 of RaySplats. The map ``M = diag(1/s) R^T`` takes the Gaussian around mu to the unit ball. On the ray
``O + t d``

    p = M (mu - O),  v = M d
    t = (v . p) / (v . v)            where the density on the ray is greatest
    e = p - t v,  q = e . e          the squared distance from the centre there, in standard deviations
    alpha = min(alpha_max, o exp(-q / 2))

Here every ray is evaluated with every Gaussian,
and ``mechanisms.rays.blending`` blends the hits; the kernels (:mod:`.kernels`) look them up in
the lists of an image's tiles, or in a tree.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.rays.kernels import (
    MAP,
    MEAN,
    N_COLUMNS,
    REACH,
    RESPONSE,
    whitening_maps,
    whitening_maps_vjp,
)
from minisplat_ref.mechanisms.rays import blending, kernels, tile_kernels
from minisplat_ref.mechanisms.rays.blending import IntersectionGradient, Meeting
from minisplat_ref.mechanisms.rays.bvh import SLACK, build
from minisplat_ref.mechanisms.rays.gradient_checks import trace_stages
from minisplat_ref.mechanisms.rays.pixel_rays import ImageTracer, Rays, Tracer
from minisplat_ref.mechanisms.rays.renderer import Traced, make_ray_renderer
from minisplat_ref.mechanisms.rays.tile_kernels import InImage
from minisplat_ref.mechanisms.rays.tile_lists import Ellipsoids, list_tiles
from minisplat_ref.mechanisms.rays.traversal import OPACITY, RayTree
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Bools, Camera, Floats, Ints, Model


class Whitened(NamedTuple):
    """Gaussians with the maps that take them to the unit ball."""

    means: Floats
    """[N, 3] world frame."""
    maps: Floats
    """[N, 3, 3] ``M = diag(1/s) R^T``; not finite where a Gaussian cannot be rendered."""
    opacities: Floats
    """[N] in [0, 1]."""


def whiten(means: Floats, quats: Floats, log_scales: Floats, opacities: Floats) -> Whitened:
    """Return the maps ``M = diag(1/s) R^T`` of Gaussians, in float64.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame.
    quats : ndarray of shape (N, 4)
        Quaternions wxyz of any length.
    log_scales : ndarray of shape (N, 3)
        Logarithms of the standard deviations, world units.
    opacities : ndarray of shape (N,)
        Activated opacities, from 0 to 1.
    """
    R = rotation_matrices(quats.astype(np.float64))
    with np.errstate(over="ignore", invalid="ignore"):
        maps = np.exp(-log_scales.astype(np.float64))[:, :, None] * np.swapaxes(R, 1, 2)
    return Whitened(means.astype(np.float64), maps, opacities.astype(np.float64))


def whiten_vjp(quats: Floats, log_scales: Floats, gaussians: Whitened, v_maps: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`whiten`: ``M_ij = R_ji / s_i``, so ``v_R_ji = v_M_ij / s_i``, ``v_log_s_i = -M_i . v_M_i``.

    Parameters
    ----------
    quats, log_scales
        As for :func:`whiten`.
    gaussians : Whitened
        The result of :func:`whiten`.
    v_maps : ndarray of shape (N, 3, 3)
        Derivative with respect to the maps.

    Returns
    -------
    v_quats : ndarray of shape (N, 4)
    v_log_scales : ndarray of shape (N, 3)
    """
    is_met: Bools = np.any(v_maps, axis=(1, 2))  # the others may have no finite map
    maps = np.where(is_met[:, None, None], gaussians.maps, 0.0)
    inverse_scales = np.exp(-np.where(is_met[:, None], log_scales, 0.0).astype(np.float64))
    v_R = np.swapaxes(inverse_scales[:, :, None] * v_maps, 1, 2)
    return rotation_matrices_vjp(quats.astype(np.float64), v_R), -np.sum(maps * v_maps, axis=2)


class Intersections(NamedTuple):
    """The intermediate values of H intersections of a ray and a Gaussian."""

    p: Floats  # [H, 3]
    v: Floats  # [H, 3]
    e: Floats  # [H, 3]
    depths: Floats  # [H] t
    unclamped: Floats  # [H] o exp(-q / 2)


def intersect(gaussians: Whitened, rays: Rays, ray_ids: Ints, gaussian_ids: Ints) -> Intersections:
    """Return the values of Gaussians at their peaks on rays, one by one.

    Parameters
    ----------
    gaussians : Whitened
        N Gaussians.
    rays : Rays
        P rays.
    ray_ids, gaussian_ids : ndarray of shape (H,)
        Indices of the ray and of the Gaussian of each intersection.

    Returns
    -------
    Intersections
        t in units of the ray's direction.
    """
    M = gaussians.maps[gaussian_ids]  # [H, 3, 3]
    p = np.einsum("hij,hj->hi", M, gaussians.means[gaussian_ids] - rays.origins[ray_ids])
    v = np.einsum("hij,hj->hi", M, rays.directions[ray_ids])
    with np.errstate(invalid="ignore", over="ignore"):  # a Gaussian that is too thin for float64 is not hit
        t = np.sum(v * p, axis=1) / np.sum(v * v, axis=1)
        e = p - t[:, None] * v
        unclamped = gaussians.opacities[gaussian_ids] * np.exp(-0.5 * np.sum(e * e, axis=1))
    return Intersections(p, v, e, t, unclamped)


def intersect_vjp(
    gaussians: Whitened, rays: Rays, ray_ids: Ints, gaussian_ids: Ints, v_unclamped: Floats, v_depths: Floats
) -> IntersectionGradient:
    """Gradient of :func:`intersect`, one by one.

    Because e is orthogonal to v, the dependence of t on p does not contribute to dq/dp::

        E = exp(-q / 2)
        v_o = E v_alpha,   v_q = -o E v_alpha / 2
        v_p = 2 v_q e + v_t v / a                            a = v . v
        v_v = -2 t v_q e + v_t (p - 2 t v) / a
        v_M = v_p (mu - O)^T + v_v d^T
        v_mu = M^T v_p,   v_O = -M^T v_p,   v_d = M^T v_v

    Parameters
    ----------
    gaussians, rays, ray_ids, gaussian_ids
        As for :func:`intersect`.
    v_unclamped, v_depths : ndarray of shape (H,)
        Derivatives with respect to its results.

    Returns
    -------
    IntersectionGradient
        Its shapes are the maps, [H, 3, 3].
    """
    found = intersect(gaussians, rays, ray_ids, gaussian_ids)
    t, e = found.depths[:, None], found.e
    a = np.sum(found.v * found.v, axis=1, keepdims=True)  # [H, 1]
    v_q = (-0.5 * found.unclamped * v_unclamped)[:, None]
    v_t = v_depths[:, None]
    v_p = 2 * v_q * e + v_t * found.v / a
    v_v = -2 * t * v_q * e + v_t * (found.p - 2 * t * found.v) / a
    M = gaussians.maps[gaussian_ids]
    offsets = gaussians.means[gaussian_ids] - rays.origins[ray_ids]
    v_maps = v_p[:, :, None] * offsets[:, None] + v_v[:, :, None] * rays.directions[ray_ids][:, None]
    v_means = np.einsum("hij,hi->hj", M, v_p)
    v_opacities = found.unclamped / gaussians.opacities[gaussian_ids] * v_unclamped
    return IntersectionGradient(v_means, v_maps, v_opacities, -v_means, np.einsum("hij,hi->hj", M, v_v))


def prepare_meeting(gaussians: Whitened) -> Meeting:
    """Return the intersection of rays with these Gaussians."""

    def alphas_and_depths(rays: Rays, ray_ids: Ints, gaussian_ids: Ints) -> tuple[Floats, Floats]:
        found = intersect(gaussians, rays, ray_ids, gaussian_ids)
        return found.unclamped, found.depths

    return Meeting(len(gaussians.means), alphas_and_depths, lambda *args: intersect_vjp(gaussians, *args))


def find_ellipsoids(gaussians: Whitened, conventions: Conventions) -> Ellipsoids:
    """Return the ellipsoids ``|M x|^2 = q`` on which alpha is ``alpha_min``; q is below 0 where none can be seen.

    ``Sigma = M^-1 M^-T``, and row i of M is ``R_i / s_i``.
    """
    least = max(conventions.alpha_min, np.finfo(np.float64).tiny)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        reaches = 2 * np.log(gaussians.opacities / least)
        inverse_variances = np.sum(gaussians.maps**2, axis=2)  # [N, 3] 1 / s^2
        axes = gaussians.maps / inverse_variances[:, :, None]  # [N, 3, 3] s_i R_i
    return Ellipsoids(gaussians.means, axes, np.where(np.isfinite(inverse_variances).all(axis=1), reaches, -np.inf))


def make_records(gaussians: Whitened, reaches: Floats) -> Floats:
    """Return the records [N, N_COLUMNS] of Gaussians and their reaches."""
    records = np.empty((len(reaches), N_COLUMNS))
    records[:, OPACITY] = gaussians.opacities
    records[:, REACH] = reaches + SLACK
    records[:, MEAN:MAP] = gaussians.means
    records[:, MAP:] = gaussians.maps.reshape(-1, 9)
    return records


def build_tree(gaussians: Whitened, conventions: Conventions) -> RayTree:
    """Return Gaussians with their tree, without those that are too faint or not finite."""
    _, axes, reaches = find_ellipsoids(gaussians, conventions)
    with np.errstate(invalid="ignore", over="ignore"):
        half = np.sqrt(reaches[:, None] * np.sum(axes**2, axis=1))  # [N, 3]
    is_finite = np.isfinite(gaussians.means).all(axis=1) & np.isfinite(half).all(axis=1)
    seen = np.flatnonzero(is_finite & (reaches >= 0))
    tree = build(gaussians.means[seen] - half[seen], gaussians.means[seen] + half[seen])
    ids = seen[tree.rows]
    records = make_records(Whitened(*(field[ids] for field in gaussians)), reaches[ids])
    return RayTree(records, ids.astype(np.int32), tree.boxes, tree.children, len(gaussians.means))


def whiten_model(model: Model) -> Whitened:
    """Return the Gaussians of a model as rays meet them."""
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-model.gaussians.opacity_logits.astype(np.float64)))
    g = model.gaussians
    return whiten(g.means, g.quats, g.log_scales, opacities)


def make_tracer(gaussians: Whitened, conventions: Conventions, backend: Backend) -> Tracer:
    """Return the tracer of a backend: every ray against every Gaussian, or kernels with a tree, which is built here."""
    if backend.is_compiled:
        return kernels.tracer_of(RESPONSE.meet, build_tree(gaussians, conventions))
    return blending.tracer_of(prepare_meeting(gaussians))


def make_image_tracer(gaussians: Whitened, camera: Camera, conventions: Conventions, backend: Backend) -> ImageTracer:
    """Return the tracer of a camera's image: every ray against every Gaussian, or kernels with lists of its tiles."""
    if backend.is_compiled:
        ellipsoids = find_ellipsoids(gaussians, conventions)
        lists = list_tiles(ellipsoids, camera, conventions)
        return tile_kernels.tracer_of(InImage(RESPONSE, lists, make_records(gaussians, ellipsoids.reaches)))
    return blending.image_tracer_of(prepare_meeting(gaussians))


def _prepare(population: Any, opacities: Floats, backend: Backend) -> Whitened:
    if backend.is_compiled:
        maps = whitening_maps(population.quats, population.log_scales)
        return Whitened(population.means.astype(np.float64), maps, opacities.astype(np.float64))
    return whiten(population.means, population.quats, population.log_scales, opacities)


def _shapes_vjp(population: Any, gaussians: Whitened, v_maps: Floats, backend: Backend) -> tuple[Floats, Floats]:
    if backend.is_compiled:
        return whitening_maps_vjp(population.quats, population.log_scales, gaussians.maps, v_maps)
    return whiten_vjp(population.quats, population.log_scales, gaussians, v_maps)


TRACED = Representation(
    "gaussians traced by rays", renderer=make_ray_renderer(Traced("rays", _prepare, make_image_tracer, _shapes_vjp))
)

RAYS = GS_ACCEL._replace(name="rays")
"""The recipe ``rays``: 3DGS with traced rays instead of footprints."""


def _prepare_meeting(fields: Mapping[str, Floats]) -> Meeting:
    opacities = 1 / (1 + np.exp(-fields["opacity_logits"]))
    return prepare_meeting(whiten(fields["means"], fields["quats"], fields["log_scales"], opacities))


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer of 3D Gaussians."""
    return trace_stages(TRACED, _prepare_meeting, backend, setting, rng)
