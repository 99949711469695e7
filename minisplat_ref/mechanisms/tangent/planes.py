"""Footprints on tangent planes of the unit sphere, in NumPy: Optimal Projection (Huang et al. 2024, arXiv 2402.00752).

EWA expands the perspective map on the image plane, where footprints are stretched more and more towards the edges. Here
each Gaussian is projected onto the plane tangent to the unit sphere in the direction of its mean. With x the mean and C
the covariance in the camera's frame::

    r = |x|,  n = x / r,  P = I - n n^T
    G = P C P / r^2 + e P,   K = G^+                (the pseudo-inverse: both vanish along n)
    m = d / (n . d) - n                             the ray d meets the plane n . y = 1 at n + m
    alpha = o exp(-m^T K m / 2)   where n . d > 0

The low-pass e is ``eps2d / (fx fy)``, which is that of 3DGS on the optical axis, and the same on every tangent plane.
So a footprint depends on rays alone, and a camera that turns sees the same colours.

Hits are ordered by where on its ray a Gaussian is densest (StopThePop, Radl et al. 2024, arXiv 2402.00525, equation
(9)). With the whitening M, for which ``C^-1 = M^T M``::

    t = (M d . M x) / (M d . M d)

It has no derivative, since only the order counts. In it, flat Gaussians count as at least a thousandth of their longest
axis thick.

Left out are conventions that compensate opacities (``is_antialiased``), the clamp of EWA's Jacobian, which nothing here
needs, and INRIA's extent. A Gaussian is culled by its distance, not by its camera z, or turning the camera would cull.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.reference.antialiasing import adjugates, determinants
from minisplat_ref.reference.covariance import covariances, covariances_vjp, rotation_matrices
from minisplat_ref.reference.hits import Hit
from minisplat_ref.reference.pinhole import pinhole_rays, pose, with_principal_point
from minisplat_ref.types import Camera, Floats, Ints, PrimitiveGradient, Primitives

COSINE_MIN = 1e-6  # of n . d: rays further from the mean than 90 degrees less this miss the plane
THICKNESS_MIN = 1e-3  # of an axis, relative to the longest, where depths are compared


class TangentFootprints(NamedTuple):
    """The footprints of N Gaussians for one camera, in its frame and in float64; zeros where culled."""

    normals: Floats
    """[N, 3] n."""
    conics: Floats
    """[N, 3, 3] K."""
    opacities: Floats
    """[N] o."""
    distances: Floats
    """[N] r, world units; lists are sorted by it."""
    depths: Floats
    """[N] camera z of the means, world units."""
    whitenings: Floats
    """[N, 3, 3] M, up to a factor for each Gaussian."""
    centers: Floats
    """[N, 3] M x."""
    radii: Ints
    """[N, 2] int32 half-extents along x and y, pixels; 0 where culled."""
    boxes: Ints
    """[N, 4] int32 pixels x0, y0, x1, y1 (half-open, in the image); empty where culled."""
    camera: Camera
    """The camera, with the principal point that the conventions use."""


class FootprintGradient(NamedTuple):
    """Gradient of the loss with respect to the differentiable fields of :class:`TangentFootprints`."""

    normals: Floats
    """[N, 3] along the tangent plane."""
    conics: Floats
    """[N, 3, 3] along the tangent plane, symmetric."""
    opacities: Floats
    """[N]."""
    depths: Floats
    """[N]."""


class Place(NamedTuple):
    """The intersections of P rays with the tangent planes of G Gaussians."""

    points: Floats  # [G, P, 3] m
    falloffs: Floats  # [G, P] exp(-m^T K m / 2), 0 where the ray misses the plane


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # non-finite rows are culled, not reported
def project(primitives: Primitives, camera: Camera, conventions: Conventions) -> TangentFootprints:
    """Project Gaussians onto their tangent planes, and cull those that the camera cannot show.

    A Gaussian is culled unless ``near < r < far``, if its opacity is below ``alpha_min``, if G is not finite or not
    invertible, or if it lies outside the image.

    Parameters
    ----------
    primitives : Primitives
        N Gaussians, world frame.
    camera : Camera
        The view.
    conventions : Conventions
        Near and far planes, low-pass, principal point and ``alpha_min`` are used.

    Raises
    ------
    InputError
        The conventions require compensated opacities.
    """
    if conventions.is_antialiased:
        raise InputError("tangent planes have no compensated opacities: leave the antialiased profile out")
    camera = with_principal_point(camera, conventions)
    means, quats, scales, opacities = (field.astype(np.float64) for field in primitives)
    x, r, n, C = _change_frame(means, quats, scales, camera)
    B = tangent_bases(n)  # [N, 2, 3]
    S = B @ C @ np.swapaxes(B, 1, 2) / (r * r)[:, None, None] + _low_pass(camera, conventions) * np.eye(2)
    det = determinants(S)
    conics = np.swapaxes(B, 1, 2) @ (adjugates(S) / det[:, None, None]) @ B
    boxes = _boxes(n, np.swapaxes(B, 1, 2) @ S @ B, opacities, camera, conventions)
    R, _ = pose(camera, means.dtype)
    longest = scales.max(axis=1, keepdims=True, initial=0)
    thicknesses = np.maximum(scales / longest, THICKNESS_MIN)
    whitenings = np.swapaxes(R @ rotation_matrices(quats), 1, 2) / thicknesses[:, :, None]

    is_visible = (conventions.near_plane < r) & (r < conventions.far_plane) & (opacities >= conventions.alpha_min)
    is_visible &= (det > 0) & (boxes[:, :2] < boxes[:, 2:]).all(axis=1)
    is_visible &= np.isfinite(np.column_stack([det, conics.reshape(-1, 9), whitenings.reshape(-1, 9)])).all(axis=1)
    row, square = is_visible[:, None], is_visible[:, None, None]
    return TangentFootprints(
        normals=np.where(row, n, 0),
        conics=np.where(square, conics, 0),
        opacities=np.where(is_visible, opacities, 0),
        distances=np.where(is_visible, r, 0),
        depths=np.where(is_visible, x[:, 2], 0),
        whitenings=np.where(square, whitenings, 0),
        centers=np.where(row, np.einsum("nij,nj->ni", whitenings, x), 0),
        radii=np.where(row, (boxes[:, 2:] - boxes[:, :2] + 1) // 2, 0).astype(np.int32),
        boxes=np.where(row, boxes, 0).astype(np.int32),
        camera=camera,
    )


def project_vjp(
    primitives: Primitives,
    camera: Camera,
    conventions: Conventions,
    footprints: TangentFootprints,
    v_footprints: FootprintGradient,
) -> tuple[PrimitiveGradient, Floats]:
    """Gradient of :func:`project`; culled Gaussians get zeros.

    A response reads K in the tangent plane only, where ``dK = -K dG K``. With ``P dP P = 0`` and, for ``dn`` in the
    plane, ``P dP C P = -dn (P C n)^T``::

        v_G  = -K v_K K
        v_C  = v_G / r^2
        v_n += -2 v_G C n / r^2,   v_r = -2 <v_G, C> / r^3
        v_x  = P v_n / r + n v_r + (0, 0, v_depth)
        v_Sigma = R^T v_C R,       v_R = sum_n 2 v_C R Sigma + v_x mu^T,   v_t = sum_n v_x

    Parameters
    ----------
    primitives, camera, conventions
        As for :func:`project`.
    footprints : TangentFootprints
        The result of :func:`project`.
    v_footprints : FootprintGradient
        Derivative with respect to the footprints.

    Returns
    -------
    v_primitives : PrimitiveGradient
        In the dtype of the primitives.
    v_means2d : ndarray of shape (N, 2)
        Derivative per pixel by which a footprint moves in the image, its shape on the sphere fixed; 0 where its
        direction does not meet the image plane.
    """
    dtype, rows = primitives.means.dtype, np.flatnonzero(footprints.radii[:, 0] > 0)  # [V] visible
    camera = with_principal_point(camera, conventions)
    means, quats, scales, _ = (field[rows].astype(np.float64) for field in primitives)
    v_n, v_K, v_o, v_z = (field[rows] for field in v_footprints)
    _, r, n, C = _change_frame(means, quats, scales, camera)
    K = footprints.conics[rows]

    v_G = -K @ v_K @ K
    v_C = v_G / (r * r)[:, None, None]
    v_n = v_n - 2 * (v_C @ C @ n[:, :, None])[:, :, 0]
    v_r = -2 * np.einsum("nij,nij->n", v_C, C) / r
    v_n = v_n - n * np.sum(n * v_n, axis=1, keepdims=True)
    v_x = v_n / r[:, None] + n * v_r[:, None]
    v_x[:, 2] += v_z
    R, _ = pose(camera, np.dtype(np.float64))
    v_quats, v_scales = covariances_vjp(quats, scales, R.T @ v_C @ R)
    v_R = 2 * (v_C @ R @ covariances(quats, scales)).sum(axis=0) + v_x.T @ means
    v_means2d = _compute_pixel_gradient(v_footprints.normals[rows], n, camera)
    parts = v_x @ R, v_quats, v_scales, v_o, v_means2d
    v_means, v_quats, v_scales, v_o, v_means2d = (_scatter(v, rows, len(footprints.radii), dtype) for v in parts)
    v_t = v_x.sum(axis=0).astype(dtype)
    return PrimitiveGradient(v_means, v_quats, v_scales, v_o, v_R.astype(dtype), v_t), v_means2d


def hit(footprints: TangentFootprints, ids: Ints, centers: Floats) -> Hit:
    """Return the hits of Gaussians on the rays through image positions; this is the ``hit`` of a response.

    Parameters
    ----------
    footprints : TangentFootprints
        From :func:`project`.
    ids : ndarray of shape (G,)
        Rows of the Gaussians.
    centers : ndarray of shape (P, 2)
        Image positions, px.
    """
    d = pinhole_rays(centers[:, 0], centers[:, 1], footprints.camera)  # [P, 3]
    n, M = footprints.normals[ids], footprints.whitenings[ids]
    cosines = n @ d.T  # [G, P] n . d
    is_met = cosines > COSINE_MIN
    points = d / np.where(is_met, cosines, 1)[:, :, None] - n[:, None]  # [G, P, 3] m
    squares = np.einsum("gpi,gij,gpj->gp", points, footprints.conics[ids], points)
    falloffs = np.where(is_met, np.exp(-np.maximum(squares, 0) / 2), 0)
    white = np.einsum("gij,pj->gpi", M, d)  # [G, P, 3] M d
    squared = np.maximum(np.sum(white * white, axis=2), np.finfo(float).tiny)
    depths = np.einsum("gpi,gi->gp", white, footprints.centers[ids]) / squared
    return Hit(footprints.opacities[ids, None] * falloffs, depths, Place(points, falloffs))


def hit_vjp(
    footprints: TangentFootprints, ids: Ints, found: Hit, v_mean: Floats, v_shape: Floats, v_place: None
) -> tuple[Floats, Floats, Floats]:
    """Gradient of :func:`hit`, summed over the rays.

    With ``sigma = m^T K m / 2``, ``v_sigma = -alpha v_alpha`` and, for ``dn`` in the plane, ``dm = -dn - (n + m) (m .
    dn)``, of which K does not see the part along n::

        v_o = E v_alpha
        v_K = v_sigma m m^T / 2
        v_n = -v_sigma (K m + (m^T K m) m)

    Returns
    -------
    tuple
        Gradients with respect to normals [G, 3], conics [G, 3, 3] and opacities [G].
    """
    m, falloffs = found.place
    v_sigma = -footprints.opacities[ids, None] * falloffs
    Km = np.einsum("gij,gpj->gpi", footprints.conics[ids], m)
    squares = np.sum(m * Km, axis=2, keepdims=True)
    v_normals = -np.einsum("gp,gpi->gi", v_sigma * v_mean, Km + squares * m)
    v_conics = np.einsum("gp,gpi,gpj->gij", v_sigma * v_shape / 2, m, m)
    return v_normals, v_conics, np.sum(falloffs * v_shape, axis=1)


def tangent_bases(normals: Floats) -> Floats:
    """Return two orthonormal rows [N, 2, 3] that span the plane perpendicular to each unit vector [N, 3]."""
    axes = np.eye(3)[np.argmin(np.abs(normals), axis=1)] if len(normals) else normals
    first = np.cross(axes, normals)
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], axis=1)


def _change_frame(
    means: Floats, quats: Floats, scales: Floats, camera: Camera
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return x [N, 3], r [N], n [N, 3] and C [N, 3, 3]."""
    R, t = pose(camera, means.dtype)
    x = means @ R.T + t
    r = np.linalg.norm(x, axis=1)
    return x, r, x / r[:, None], R @ covariances(quats, scales) @ R.T


def _low_pass(camera: Camera, conventions: Conventions) -> float:
    return conventions.eps2d / (camera.fx * camera.fy)


def _boxes(n: Floats, G: Floats, opacities: Floats, camera: Camera, conventions: Conventions) -> Floats:
    """Return boxes [N, 4] of the pixels whose rays lie in the cone of ``alpha >= alpha_min``.

    The cone's rays are n + e G^(1/2) times unit vectors, ``e^2 = 2 ln(o / alpha_min)``; a plane l . d = 0 is tangent to
    it where ``(l . n)^2 = e^2 l^T G l``. For the planes d_x = c d_z this is a quadratic in c. A cone that reaches
    across the plane z = 0 has no such bounds: it gets the whole image, unless it lies beyond one of its edges.
    """
    ee = 2 * np.log(np.maximum(opacities / conventions.alpha_min, 1))  # [N] e^2
    size, focal = np.array([camera.width, camera.height]), np.array([camera.fx, camera.fy])
    center = np.array([camera.cx, camera.cy])
    leading = n[:, 2] ** 2 - ee * G[:, 2, 2]
    is_in_front = (n[:, 2] > 0) & (leading > 0)
    low, high, is_seen = np.zeros((len(n), 2)), np.tile(size, (len(n), 1)).astype(float), ee >= 0
    for k in (0, 1):
        middle = n[:, k] * n[:, 2] - ee * G[:, k, 2]
        spread = n[:, k] ** 2 * G[:, 2, 2] - 2 * n[:, k] * n[:, 2] * G[:, k, 2] + n[:, 2] ** 2 * G[:, k, k]
        spread = ee * spread - ee * ee * (G[:, k, k] * G[:, 2, 2] - G[:, k, 2] ** 2)
        root = np.sqrt(np.maximum(spread, 0))
        slopes = np.stack([middle - root, middle + root]) / np.where(is_in_front, leading, 1)  # [2, N]
        first, last = focal[k] * slopes + center[k]
        low[:, k] = np.where(is_in_front, np.clip(np.floor(first), 0, size[k]), low[:, k])
        high[:, k] = np.where(is_in_front, np.clip(np.ceil(last), 0, size[k]), high[:, k])
        for sign, edge in ((1, -center[k]), (-1, size[k] - center[k])):
            side = np.zeros(3)
            side[k], side[2] = sign, -sign * edge / focal[k]
            is_seen &= n @ side + np.sqrt(ee * ((G @ side) @ side)) > 0
    is_seen &= n[:, 2] + np.sqrt(ee * G[:, 2, 2]) > 0
    return np.where(is_seen[:, None], np.hstack([low, high]), 0)


def _compute_pixel_gradient(v_normals: Floats, normals: Floats, camera: Camera) -> Floats:
    """Return the derivative with respect to the pixel at which a direction is seen: ``dn = (n_z / f) P e_k dp_k``."""
    focal = np.array([camera.fx, camera.fy])
    along = v_normals - normals * np.sum(normals * v_normals, axis=1, keepdims=True)
    return along[:, :2] * np.maximum(normals[:, 2:], 0) / focal


def _scatter(values: Floats, rows: Ints, n: int, dtype: np.dtype) -> Floats:
    """Return an array of n rows with ``values`` at ``rows`` and zeros elsewhere."""
    full = np.zeros((n, *values.shape[1:]), dtype)
    full[rows] = values
    return full
