"""Blending along rays through Gaussians of any kind, in NumPy: every ray is tested against every Gaussian.

The extension defines where a ray meets a primitive, as a :class:`Meeting`. Hits are sorted by t, ties by row, and have
the weights ``w_i = alpha_i T_i`` of 3DGS equation (3), ``alpha = min(alpha_max, unclamped)``. What does not count:
``alpha < alpha_min``, t outside of the ray's limits, and every hit from the one on that would reduce the transmittance
to its minimum.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.mechanisms.rays.pixel_rays import BlendedRays, Hits, ImageTracer, RayGradient, Rays, Tracer
from minisplat_ref.reference.hits import is_accepted
from minisplat_ref.types import Floats, Ints

PAIRS_AT_ONCE = 1 << 18  # of rays and Gaussians: some thirty arrays of float64, 60 MB


class IntersectionGradient(NamedTuple):
    """Gradient with respect to the parameters of a Gaussian and of a ray, pair by pair."""

    means: Floats
    """[H, 3]."""
    shapes: Floats
    """[H, ...] with respect to the shapes that the extension makes of quaternions and scales."""
    opacities: Floats
    """[H]."""
    origins: Floats
    """[H, 3] of the rays."""
    directions: Floats
    """[H, 3]."""


class Meeting(NamedTuple):
    """The intersection of rays with the Gaussians of a population."""

    n: int
    """Gaussians."""
    meet: Callable[[Rays, Ints, Ints], tuple[Floats, Floats]]
    """``meet(rays, ray_ids, gaussian_ids)``: alpha before the clamp [H] and t [H]; alpha is 0, or t not a number,
    where the ray misses the Gaussian."""
    meet_vjp: Callable[..., IntersectionGradient]
    """``meet_vjp(rays, ray_ids, gaussian_ids, v_unclamped, v_depths)``: the gradient of that."""


def tracer_of(meeting: Meeting) -> Tracer:
    """Return the functions of tracing any rays."""
    return Tracer(partial(list_hits, meeting), partial(blend_rays, meeting))


def image_tracer_of(meeting: Meeting) -> ImageTracer:
    """Return the functions of tracing the rays of a camera; here it does not matter which."""
    return ImageTracer(*tracer_of(meeting), partial(blend_rays_vjp, meeting))


def list_hits(meeting: Meeting, rays: Rays, conventions: Conventions) -> Hits:
    """Return the blended hits of each ray, nearest first.

    Parameters
    ----------
    meeting : Meeting
        N Gaussians.
    rays : Rays
        P rays.
    conventions : Conventions
        Clamp, skip and stop thresholds.
    """
    n, n_rays = meeting.n, len(rays.near)
    ids, alphas, depths, weights, rows = ([np.zeros(0, kind)] for kind in (int, float, float, float, int))
    transmittances = np.ones(n_rays)
    for some in _chunks(n_rays, n):
        intersections = meeting.meet(rays, np.repeat(some, n), np.tile(np.arange(n), len(some)))
        unclamped, t = (array.reshape(len(some), n) for array in intersections)
        alpha = np.minimum(conventions.alpha_max, unclamped)
        is_hit = (alpha >= conventions.alpha_min) & (t > rays.near[some, None]) & (t < rays.far[some, None])
        order = np.argsort(np.where(is_hit, t, np.inf), axis=1, kind="stable")  # [P', N]
        alpha = np.take_along_axis(np.where(is_hit, alpha, 0.0), order, axis=1)
        after = np.cumprod(1 - alpha, axis=1)
        alpha = np.where(is_accepted(after, conventions), alpha, 0.0)  # T never rises, so only the end is cut off
        T = np.cumprod(np.column_stack([np.ones(len(some)), 1 - alpha]), axis=1)  # [P', N + 1]
        row, place = np.nonzero(alpha > 0)  # of each ray in its order
        found = order[row, place]
        transmittances[some] = T[:, -1]
        ids.append(found)
        alphas.append(unclamped[row, found])
        depths.append(t[row, found])
        weights.append((alpha * T[:, :-1])[row, place])
        rows.append(some[row])
    ray_ids = np.concatenate(rows)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(ray_ids, minlength=n_rays))])
    return Hits(
        offsets,
        ray_ids,
        np.concatenate(ids),
        np.concatenate(alphas),
        np.concatenate(depths),
        np.concatenate(weights),
        transmittances,
    )


def blend_rays(
    meeting: Meeting, colors: Floats, rays: Rays, background: Floats, conventions: Conventions
) -> BlendedRays:
    """Return the colour ``sum_i w_i c_i + T_end b`` and the accumulated depth ``sum_i w_i t_i`` of each ray.

    Parameters
    ----------
    meeting : Meeting
        N Gaussians.
    colors : ndarray of shape (N, 3)
        One colour per Gaussian.
    rays : Rays
        P rays.
    background : ndarray of shape (3,)
        b.
    conventions : Conventions
        Clamp, skip and stop thresholds.
    """
    hits = list_hits(meeting, rays, conventions)
    image, depths = np.zeros((len(rays.near), 3)), np.zeros(len(rays.near))
    np.add.at(image, hits.ray_ids, hits.weights[:, None] * colors[hits.gaussian_ids])
    np.add.at(depths, hits.ray_ids, hits.weights * hits.depths)
    is_seen = np.bincount(hits.gaussian_ids, minlength=meeting.n) > 0
    image += hits.transmittances[:, None] * background
    return BlendedRays(image, depths, hits.transmittances, np.diff(hits.offsets), is_seen, hits)


def blend_rays_vjp(
    meeting: Meeting,
    colors: Floats,
    rays: Rays,
    background: Floats,
    conventions: Conventions,
    blended: BlendedRays,
    v_blended: tuple[Floats, Floats, Floats],
) -> RayGradient:
    """Gradient of :func:`blend_rays`.

    With ``f_i = v_image . c_i + v_depth t_i`` and the sum ``B_i = sum_{j > i} w_j f_j + T_end (v_image . b + v_T)``
    over what lies behind hit i::

        v_c_i     = w_i v_image,   v_t_i = w_i v_depth,   v_b = sum T_end v_image
        v_alpha_i = T_i f_i - B_i / (1 - alpha_i)                                     0 where alpha is clamped

    Parameters
    ----------
    meeting, colors, rays, background, conventions
        As for :func:`blend_rays`.
    blended : BlendedRays
        The result of :func:`blend_rays`.
    v_blended : tuple
        Derivatives with respect to the image [P, 3], the depths [P] and the transmittances [P].
    """
    v_image, v_depths, v_transmittances = v_blended
    hits: Hits = blended.kept
    ray_ids, ids = hits.ray_ids, hits.gaussian_ids
    alphas = np.minimum(conventions.alpha_max, hits.unclamped)
    f = np.sum(v_image[ray_ids] * colors[ids], axis=1) + v_depths[ray_ids] * hits.depths
    places = np.arange(len(ids)) - hits.offsets[ray_ids]
    table = np.zeros((len(rays.near), int(places.max(initial=-1)) + 2))
    table[ray_ids, places + 1] = hits.weights * f
    table[:, 0] = blended.transmittances * (v_image @ background + v_transmittances)
    behind = np.cumsum(table[:, :0:-1], axis=1)[:, ::-1] - table[:, 1:] + table[:, :1]  # B [P, K]
    v_alphas = hits.weights / alphas * f - behind[ray_ids, places] / (1 - alphas)
    v_unclamped = np.where(hits.unclamped <= conventions.alpha_max, v_alphas, 0.0)
    by_hit = meeting.meet_vjp(rays, ray_ids, ids, v_unclamped, hits.weights * v_depths[ray_ids])
    return RayGradient(
        means=sum_by_row(by_hit.means, ids, meeting.n),
        shapes=sum_by_row(by_hit.shapes, ids, meeting.n),
        opacities=sum_by_row(by_hit.opacities, ids, meeting.n),
        colors=sum_by_row(hits.weights[:, None] * v_image[ray_ids], ids, meeting.n),
        background=np.sum(blended.transmittances[:, None] * v_image, axis=0),
        origins=sum_by_row(by_hit.origins, ray_ids, len(rays.near)),
        directions=sum_by_row(by_hit.directions, ray_ids, len(rays.near)),
    )


def sum_by_row(values: Floats, rows: Ints, n_rows: int) -> Floats:
    """Return the sums [n_rows, ...] of those values [H, ...] that belong to the same row."""
    sums = np.zeros((n_rows, *values.shape[1:]))
    np.add.at(sums, rows, values)
    return sums


def _chunks(n_rays: int, n: int) -> Iterator[Ints]:
    """Yield the rays in chunks, so that not too many intersections are in memory at once."""
    step = max(1, PAIRS_AT_ONCE // max(n, 1))
    for first in range(0, n_rays, step):
        yield np.arange(first, min(first + step, n_rays))
