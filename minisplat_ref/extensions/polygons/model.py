"""Flat Gaussians in polygons: intersections with rays, trees, the renderer, the start of training, and the recipe.

This is section 3 of REdiSplats. The spans ``S_a = s_a e_a`` and ``S_b = s_b e_b`` are perpendicular, and so the ray
``O + t d`` meets the plane of the Gaussian around mu at the place (u, v), in standard deviations:

    n = S_a x S_b,   t = n . (mu - O) / n . d,   x = O + t d - mu
    u = x . S_a / |S_a|^2,   v = x . S_b / |S_b|^2,   alpha = min(alpha_max, o exp(-(u^2 + v^2) / 2))

It hits the polygon of n sides and radius r if it is on the inner side of every edge:

    u cos psi_j + v sin psi_j <= r cos(pi / n),   psi_j = (2 j + 1) pi / n

A polygon of radius 0 is never hit. The edge has no gradient: at most ``o exp(-(r cos(pi / n))^2 / 2)`` of alpha ends
there, 0.008 for an octagon of opacity 1. In NumPy every ray is evaluated with every polygon, and
``mechanisms.rays.blending`` blends the hits; the kernels (:mod:`.ray_kernels`) look them up in the
lists of an image's tiles, or in a tree.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.polygons.kernels import Fans
from minisplat_ref.extensions.polygons.ray_kernels import POLYGON, make_records
from minisplat_ref.mechanisms.meshes.fans import N_SIDES, flatten, opacity_radii, plane_axes, rims, turn_balls
from minisplat_ref.mechanisms.rays import blending, kernels, tile_kernels
from minisplat_ref.mechanisms.rays.blending import IntersectionGradient, Meeting
from minisplat_ref.mechanisms.rays.bvh import build
from minisplat_ref.mechanisms.rays.gradient_checks import trace_stages
from minisplat_ref.mechanisms.rays.pixel_rays import ImageTracer, Rays, Tracer
from minisplat_ref.mechanisms.rays.renderer import Traced, make_ray_renderer
from minisplat_ref.mechanisms.rays.tile_kernels import InImage
from minisplat_ref.mechanisms.rays.tile_lists import Ellipsoids, list_tiles
from minisplat_ref.mechanisms.rays.traversal import RayTree
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.covariance import rotation_matrices_vjp
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Ints

LOG_THICKNESS = float(np.log(1e-5))  # of the axis across, as in the paper; rendering has none


class Polygons(NamedTuple):
    """Flat Gaussians, each in its polygon; float64."""

    means: Floats
    """[N, 3] world frame."""
    spans: Floats
    """[N, 3, 2] ``S = [s_a e_a, s_b e_b]``, perpendicular."""
    radii: Floats
    """[N] r in standard deviations; 0 of an empty polygon."""
    opacities: Floats
    """[N] in [0, 1]."""
    n_sides: int = N_SIDES
    """Of every polygon."""


def make_polygons(population: Any, opacities: Floats, n_sides: int = N_SIDES) -> Polygons:
    """Return the polygons of Gaussians, each flattened into the plane of its two larger axes.

    Parameters
    ----------
    population : Gaussians, or a NamedTuple with its fields
        N rows; the least scale of each does not matter.
    opacities : ndarray of shape (N,)
        Activated, and 0 where a Gaussian is not rendered.
    n_sides : int
        3 or more.
    """
    flat = flatten(population.means, population.quats, population.log_scales)
    return Polygons(flat.means, flat.spans, opacity_radii(population.opacity_logits), opacities, n_sides)


def spans_vjp(population: Any, polygons: Polygons, v_spans: Floats) -> tuple[Floats, Floats]:
    """Gradient of the spans ``S_k = s_k e_k``: ``v_e_k = s_k v_S_k``, ``v_log_s_k = S_k . v_S_k``.

    Parameters
    ----------
    population : Gaussians, or a NamedTuple with its fields
        N rows.
    polygons : Polygons
        Made of it.
    v_spans : ndarray of shape (N, 3, 2)
        Derivative with respect to the spans.

    Returns
    -------
    v_quats : ndarray of shape (N, 4)
    v_log_scales : ndarray of shape (N, 3)
        0 along the normal.
    """
    is_met = np.any(v_spans, axis=(1, 2))  # the others may have no finite spans
    spans = np.where(is_met[:, None, None], polygons.spans, 0.0)
    columns = plane_axes(population.log_scales)[:, :2]  # [N, 2]
    v_log_scales, v_R = np.zeros((len(spans), 3)), np.zeros((len(spans), 3, 3))
    np.put_along_axis(v_log_scales, columns, np.sum(spans * v_spans, axis=1), axis=1)
    scales = np.linalg.norm(spans, axis=1)  # [N, 2]
    np.put_along_axis(v_R, columns[:, None, :], scales[:, None, :] * v_spans, axis=2)
    return rotation_matrices_vjp(population.quats.astype(np.float64), v_R), v_log_scales


class Intersections(NamedTuple):
    """Rays and polygons that meet, one by one."""

    x: Floats  # [H, 3] from mu to the place
    places: Floats  # [H, 2] u, v
    depths: Floats  # [H] t; not a number or infinite for a ray in parallel to the plane
    unclamped: Floats  # [H] o exp(-(u^2 + v^2) / 2), 0 outside of the polygon


def meet(polygons: Polygons, rays: Rays, ray_ids: Ints, gaussian_ids: Ints) -> Intersections:
    """Evaluate flat Gaussians on rays, one by one.

    Parameters
    ----------
    polygons : Polygons
        N flat Gaussians.
    rays : Rays
        P rays.
    ray_ids, gaussian_ids : ndarray of shape (H,)
        The ray and the polygon that may meet.

    Returns
    -------
    Intersections
        t in units of the ray's direction.
    """
    S, d = polygons.spans[gaussian_ids], rays.directions[ray_ids]  # [H, 3, 2], [H, 3]
    offsets = polygons.means[gaussian_ids] - rays.origins[ray_ids]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # a ray in the plane; no finite size
        n = np.cross(polygons.spans[:, :, 0], polygons.spans[:, :, 1])[gaussian_ids]
        t = np.sum(n * offsets, axis=1) / np.sum(n * d, axis=1)
        x = t[:, None] * d - offsets
        places = np.einsum("hi,hik->hk", x, S) / np.sum(S * S, axis=1)
        unclamped = polygons.opacities[gaussian_ids] * np.exp(-0.5 * np.sum(places**2, axis=1))
        is_hit = is_inside(places, polygons.radii[gaussian_ids], polygons.n_sides)
    return Intersections(x, places, t, np.where(is_hit, unclamped, 0.0))


def is_inside(places: Floats, radii: Floats, n_sides: int) -> Bools:
    """Return whether places (u, v) [H, 2] lie in polygons of radii [H], their edges included."""
    psi = (2 * np.arange(n_sides) + 1) * np.pi / n_sides
    is_in: Bools = (radii > 0) & (np.abs(places) <= radii[:, None]).all(axis=1)  # few are left
    near = np.flatnonzero(is_in)
    outermost = np.max(places[near] @ np.array([np.cos(psi), np.sin(psi)]), axis=1)
    is_in[near] = outermost <= radii[near] * np.cos(np.pi / n_sides)
    return is_in


def meet_vjp(
    polygons: Polygons, rays: Rays, ray_ids: Ints, gaussian_ids: Ints, v_unclamped: Floats, v_depths: Floats
) -> IntersectionGradient:
    """Gradient of :func:`meet`, where they meet.

    With the spans S_k, k = a, b, the places u_k and the offset ``m = mu - O``::

        v_o    = exp(-(u_a^2 + u_b^2) / 2) v_alpha,   v_u_k = -alpha u_k v_alpha
        v_x    = sum_k v_u_k S_k / |S_k|^2
        w      = (v_t + v_x . d) / (n . d)                                     of the numerator of t
        v_n    = -w x
        v_S_a  = v_u_a (x - 2 u_a S_a) / |S_a|^2 + S_b x v_n,   v_S_b likewise with v_n x S_a
        v_m    = w n - v_x,   v_mu = v_m,   v_O = -v_m,   v_d = t (v_x - w n)

    Parameters
    ----------
    polygons, rays, ray_ids, gaussian_ids
        As for :func:`meet`.
    v_unclamped, v_depths : ndarray of shape (H,)
        Derivatives with respect to its results.

    Returns
    -------
    IntersectionGradient
        Its shapes are with respect to the spans, [H, 3, 2].
    """
    found = meet(polygons, rays, ray_ids, gaussian_ids)
    S, d, x, t = polygons.spans[gaussian_ids], rays.directions[ray_ids], found.x, found.depths[:, None]
    n, squares = np.cross(S[:, :, 0], S[:, :, 1]), np.sum(S * S, axis=1)  # [H, 3], [H, 2]
    v_u = -(found.unclamped * v_unclamped)[:, None] * found.places / squares  # [H, 2] over |S_k|^2
    v_x = np.einsum("hik,hk->hi", S, v_u)
    w = ((v_depths + np.sum(v_x * d, axis=1)) / np.sum(n * d, axis=1))[:, None]
    v_n = -w * x
    v_S = v_u[:, None, :] * (x[:, :, None] - 2 * found.places[:, None, :] * S)
    v_S += np.stack([np.cross(S[:, :, 1], v_n), np.cross(v_n, S[:, :, 0])], axis=2)
    v_m = w * n - v_x
    v_opacities = found.unclamped / polygons.opacities[gaussian_ids] * v_unclamped
    return IntersectionGradient(v_m, v_S, v_opacities, -v_m, -t * v_m)


def prepare_meeting(polygons: Polygons) -> Meeting:
    """Return the intersection of rays with these polygons."""

    def alphas_and_depths(rays: Rays, ray_ids: Ints, gaussian_ids: Ints) -> tuple[Floats, Floats]:
        found = meet(polygons, rays, ray_ids, gaussian_ids)
        return found.unclamped, found.depths

    return Meeting(len(polygons.means), alphas_and_depths, lambda *args: meet_vjp(polygons, *args))


def make_fans(polygons: Polygons) -> Fans:
    """Return the fans of regular polygons."""
    with np.errstate(invalid="ignore"):
        spokes = rims(np.zeros_like(polygons.means), polygons.spans, polygons.radii, polygons.n_sides)
    return Fans(polygons.means, spokes, polygons.radii, polygons.opacities)


def find_ellipsoids(polygons: Polygons, conventions: Conventions) -> Ellipsoids:
    """Return the ellipses around polygons, of a smaller reach q where alpha falls below ``alpha_min`` inside.

    The reach of polygons that are too faint, empty or not finite is below 0.
    """
    least = max(conventions.alpha_min, np.finfo(np.float64).tiny)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        reaches = np.minimum(2 * np.log(polygons.opacities / least), polygons.radii**2)
        squares = np.sum(polygons.spans**2, axis=1)  # [N, 2]
    is_seen = (polygons.radii > 0) & (squares > 0).all(axis=1) & np.isfinite(squares).all(axis=1)
    axes = np.ascontiguousarray(np.swapaxes(polygons.spans, 1, 2))
    return Ellipsoids(polygons.means, axes, np.where(is_seen, reaches, -np.inf))


def build_tree(polygons: Polygons, conventions: Conventions) -> RayTree:
    """Return the polygons with their tree; those that are too faint, empty or not finite are left out."""
    fans = make_fans(polygons)
    corners = fans.centres[:, None] + fans.spokes  # [N, n, 3]
    is_seen = find_ellipsoids(polygons, conventions).reaches >= 0
    seen = np.flatnonzero(is_seen & np.isfinite(corners).all(axis=(1, 2)))
    tree = build(corners[seen].min(axis=1), corners[seen].max(axis=1))
    ids = seen[tree.rows]
    means, spans, radii, opacities = (field[ids] for field in polygons[:4])
    records = make_records(means, spans, radii, opacities, polygons.n_sides)
    return RayTree(records, ids.astype(np.int32), tree.boxes, tree.children, len(polygons.means))


def make_tracer(polygons: Polygons, conventions: Conventions, backend: Backend) -> Tracer:
    """Return the tracer of a backend: every ray against every polygon, or kernels with a tree of polygons."""
    if backend.is_compiled:
        return kernels.tracer_of(POLYGON.meet, build_tree(polygons, conventions))
    return blending.tracer_of(prepare_meeting(polygons))


def make_image_tracer(polygons: Polygons, camera: Camera, conventions: Conventions, backend: Backend) -> ImageTracer:
    """Return the tracer of a camera's image: every ray against every polygon, or kernels with lists of its tiles."""
    if backend.is_compiled:
        lists = list_tiles(find_ellipsoids(polygons, conventions), camera, conventions)
        return tile_kernels.tracer_of(InImage(POLYGON, lists, make_records(*polygons)))
    return blending.image_tracer_of(prepare_meeting(polygons))


def press_flat(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return the Gaussians with a thickness of 1e-5 along their thinnest axes; balls are rotated at random first."""
    turned = turn_balls(gaussians, rng)
    log_scales, rows = turned.log_scales.copy(), np.arange(len(turned.log_scales))
    log_scales[rows, np.argmin(log_scales, axis=1)] = LOG_THICKNESS
    return turned._replace(log_scales=log_scales)


def _prepare(population: Any, opacities: Floats, backend: Backend) -> Polygons:
    return make_polygons(population, opacities)


def _shapes_vjp(population: Any, polygons: Polygons, v_spans: Floats, backend: Backend) -> tuple[Floats, Floats]:
    return spans_vjp(population, polygons, v_spans)


TRACED = Representation(
    "flat Gaussians in polygons",
    extend=press_flat,
    renderer=make_ray_renderer(Traced("polygons", _prepare, make_image_tracer, _shapes_vjp)),
)

POLYGONS = GS_ACCEL._replace(name="polygons")
"""``polygons``: 3DGS of flat Gaussians, whose pixels are rays."""


def _prepare_meeting(fields: Mapping[str, Floats]) -> Meeting:
    population = Gaussians(*(fields[name] for name in Gaussians._fields))
    return prepare_meeting(make_polygons(population, 1 / (1 + np.exp(-population.opacity_logits))))


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer of polygons."""
    return trace_stages(TRACED, _prepare_meeting, backend, setting, rng)
