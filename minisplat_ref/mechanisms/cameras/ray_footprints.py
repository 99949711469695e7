"""3D Gaussians hit by the true rays of any central camera, in NumPy: 3DGUT's response (arXiv 2412.12507).

In the camera's frame a Gaussian has the mean x and the whitening ``M = S^-1 (R_c R_g)^T``, with which its covariance is
``M^-1 M^-T``. A ray ``t d`` is nearest to it, in standard deviations, at t, and passes it at p::

    a = M d,   b = M x,   t = a . b / a . a,   p = b - t a
    alpha = o exp(-p . p / 2)   where t > 0

This is the maximum of the Gaussian along the ray, so there is no expansion to be wrong far from the axis, and no
low-pass. Lists are ordered by the depths of the means. The image's bounds of a Gaussian come from the unscented
transform; they alone are approximate: a pixel outside of them is not hit.

A Gaussian is culled unless its depth lies between the planes, its mean is seen by the lens, it is not thinner than
``1 / WHITENESS_MAX`` of its distance, and some ray of the image can reach it: seen from the camera, the ball of its
longest axis touches the cone of all rays. Beside the camera an unscented transform bounds nothing. If a sigma point is
not seen, the bounds are the whole image.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.cameras.models import model_of, ray_table
from minisplat_ref.mechanisms.cameras.unscented import unscented
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.extent import extents
from minisplat_ref.reference.hits import Hit, Response
from minisplat_ref.reference.pinhole import pose, with_principal_point
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.rendering.box_lists import list_boxes
from minisplat_ref.types import Bools, Camera, Floats, Ints, PrimitiveGradient, Primitives, TileBins

WHITENESS_MAX = 1e12  # of |x| / s: its square is far from the end of float32


class LensFootprints(NamedTuple):
    """N Gaussians as one camera's rays meet them, in its frame and in float64; zeros where culled."""

    positions: Floats
    """[N, 3] x, world units."""
    whitenings: Floats
    """[N, 3, 3] M, per world unit."""
    opacities: Floats
    """[N] o."""
    depths: Floats
    """[N] that of the camera's model, world units; lists are sorted by it."""
    means2d: Floats
    """[N, 2] the means in the image, pixels."""
    radii: Ints
    """[N, 2] int32 half-extents along x and y, pixels; 0 where culled."""
    boxes: Ints
    """[N, 4] int32 pixels x0, y0, x1, y1 (half-open, in the image); empty where culled."""
    rays: Floats
    """[3 H, W + PADDING] directions of the pixels; see ``mechanisms.cameras.models.ray_table``."""
    camera: Camera
    """The camera, with the principal point that the conventions use."""


class FootprintGradient(NamedTuple):
    """Gradient of the loss with respect to the differentiable fields of :class:`LensFootprints`."""

    positions: Floats
    """[N, 3]."""
    whitenings: Floats
    """[N, 3, 3]."""
    opacities: Floats
    """[N]."""
    depths: Floats
    """[N]."""


class Place(NamedTuple):
    """The places where P rays pass G Gaussians."""

    rays: Floats  # [P, 3] d
    depths: Floats  # [G, P] t
    points: Floats  # [G, P, 3] p, in standard deviations
    falloffs: Floats  # [G, P] exp(-p . p / 2), 0 behind the camera


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # non-finite rows are culled, not reported
def project(primitives: Primitives, camera: Camera, conventions: Conventions) -> LensFootprints:
    """Place Gaussians in the camera's frame, bound them in its image, and cull those that it cannot show.

    Parameters
    ----------
    primitives : Primitives
        N Gaussians, world frame.
    camera : Camera
        A pinhole, or a camera with ``optics`` whose rays all begin at its centre.
    conventions : Conventions
        Planes, principal point, extent and ``alpha_min``; the low-pass widens bounds only.

    Raises
    ------
    InputError
        The camera has parallel rays, its lens folds inside the image, or the conventions compensate opacities.
    """
    check_camera(camera, conventions)
    camera = with_principal_point(camera, conventions)
    model, rays = model_of(camera), ray_table(camera)
    means, quats, scales, opacities = (field.astype(np.float64) for field in primitives)
    R, t = pose(camera, means.dtype)
    x = means @ R.T + t
    axes = R @ rotation_matrices(quats)  # [N, 3, 3] in columns
    whitenings = np.swapaxes(axes, 1, 2) / scales[:, :, None]
    depths = model.depths(x)
    means2d, covariances2d, is_whole = unscented(x, axes * scales[:, None, :], model, camera)
    radii, boxes = extents(means2d, covariances2d + conventions.eps2d * np.eye(2), opacities, camera, conventions)
    size = np.array([camera.width, camera.height], float)
    boxes = np.where(is_whole[:, None], boxes, [0, 0, *size])
    radii = np.where(is_whole[:, None], radii, size)

    is_visible = (conventions.near_plane < depths) & (depths < conventions.far_plane)
    is_visible &= (opacities >= conventions.alpha_min) & model.is_seen(x, camera)
    is_visible &= (np.linalg.norm(x, axis=1)[:, None] < WHITENESS_MAX * scales).all(axis=1)
    is_visible &= are_reached(x, scales.max(axis=1), opacities / conventions.alpha_min, rays)
    is_visible &= np.isfinite(np.column_stack([x, whitenings.reshape(-1, 9), radii, boxes])).all(axis=1)
    is_visible &= (radii > 0).all(axis=1) & (boxes[:, :2] < boxes[:, 2:]).all(axis=1)
    rows = is_visible[:, None]
    pixels = model.project(x, camera)
    return LensFootprints(
        positions=np.where(rows, x, 0),
        whitenings=np.where(rows[:, :, None], whitenings, 0),
        opacities=np.where(is_visible, opacities, 0),
        depths=np.where(is_visible, depths, 0),
        means2d=np.where(rows, pixels, 0),
        radii=np.where(rows, radii, 0).astype(np.int32),
        boxes=np.where(rows, boxes, 0).astype(np.int32),
        rays=rays,
        camera=camera,
    )


def check_camera(camera: Camera, conventions: Conventions) -> None:
    """Refuse parallel rays, and conventions that compensate opacities.

    Raises
    ------
    InputError
        Either of both.
    """
    if conventions.is_antialiased:
        raise InputError("rays through lenses have no compensated opacities: leave the antialiased profile out")
    if camera.optics is not None and camera.optics.is_parallel:
        raise InputError("parallel rays do not meet in a lens: train with --recipe satellite, which has affine cameras")


def are_reached(x: Floats, scales: Floats, ratios: Floats, rays: Floats) -> Bools:
    """Return whether the balls of Gaussians touch the cone about the optical axis that holds all rays of an image, [N].

    Parameters
    ----------
    x : ndarray of shape (N, 3)
        Means, camera frame.
    scales : ndarray of shape (N,)
        Largest standard deviations; a ball has the radius ``s sqrt(2 ln(o / alpha_min))``, at which alpha is alpha_min.
    ratios : ndarray of shape (N,)
        ``o / alpha_min``.
    rays : ndarray
        Table of the unit directions of the pixels.
    """
    distances, radii = np.linalg.norm(x, axis=1), scales * np.sqrt(2 * np.log(np.maximum(ratios, 1)))
    half_angle = np.arccos(np.clip(rays[2::3].min(), -1, 1))
    beyond = np.arccos(np.clip(x[:, 2] / distances, -1, 1)) - half_angle
    reached: Bools = (radii >= distances) | (beyond <= np.arcsin(np.minimum(radii / distances, 1)))
    return reached


def project_vjp(
    primitives: Primitives, footprints: LensFootprints, v_footprints: FootprintGradient
) -> tuple[PrimitiveGradient, Floats]:
    """Gradient of :func:`project`, and the derivatives [N, 2] with respect to the means' pixels for density control.

    With ``W = R_g^T R^T`` and ``M = S^-1 W``::

        v_s_k = -sum_j (v_M)_kj W_kj / s_k^2,   v_W = S^-1 v_M
        v_R_g = R^T v_W^T,   v_R = sum v_W^T R_g^T + v_x mu^T
        v_x += depth's share,   v_mu = R^T v_x,   v_t = sum v_x

    A mean that moves by a pixel across its ray moves by the column of ``J^+ = J^T (J J^T)^-1``, so ``v_p = (J^+)^T
    v_x``.
    """
    dtype, rows = primitives.means.dtype, np.flatnonzero(footprints.radii[:, 0] > 0)
    means, quats, scales, _ = (field[rows].astype(np.float64) for field in primitives)
    camera, x = footprints.camera, footprints.positions[rows]
    R, _ = pose(camera, means.dtype)
    model = model_of(camera)
    v_response, v_M = v_footprints.positions[rows], v_footprints.whitenings[rows]
    v_x = v_response + model.depths_vjp(x, v_footprints.depths[rows])
    R_g = rotation_matrices(quats)
    W = np.swapaxes(R @ R_g, 1, 2)
    v_scales = -np.sum(v_M * W, axis=2) / (scales * scales)
    v_W = v_M / scales[:, :, None]
    v_quats = rotation_matrices_vjp(quats, R.T @ np.swapaxes(v_W, 1, 2))
    v_R = np.einsum("nki,njk->ij", v_W, R_g) + v_x.T @ means
    J = model.jacobians(x, camera)
    v_means2d = np.linalg.solve(J @ np.swapaxes(J, 1, 2), J @ v_response[:, :, None])[:, :, 0]

    def scatter(values: Floats) -> Floats:
        full = np.zeros((len(footprints.radii), *values.shape[1:]), dtype)
        full[rows] = values
        return full

    v_o = scatter(v_footprints.opacities[rows])
    v_means, v_q, v_s = scatter(v_x @ R), scatter(v_quats), scatter(v_scales)
    gradient = PrimitiveGradient(v_means, v_q, v_s, v_o, v_R.astype(dtype), v_x.sum(axis=0).astype(dtype))
    return gradient, scatter(v_means2d)


def hit(footprints: LensFootprints, ids: Ints, centers: Floats) -> Hit:
    """Return the hits of Gaussians on the rays of pixels; this is the ``hit`` of a response.

    Parameters
    ----------
    footprints : LensFootprints
        From :func:`project`.
    ids : ndarray of shape (G,)
        Rows of the Gaussians.
    centers : ndarray of shape (P, 2)
        Centres of pixels, px.
    """
    columns, lines = np.floor(centers).astype(int).T
    d = np.stack([footprints.rays[3 * lines + k, columns] for k in range(3)], axis=1)  # [P, 3]
    M = footprints.whitenings[ids]
    a = np.einsum("gij,pj->gpi", M, d)
    b = np.einsum("gij,gj->gi", M, footprints.positions[ids])[:, None]
    t = np.sum(a * b, axis=2) / np.sum(a * a, axis=2)
    p = b - t[:, :, None] * a
    falloffs = np.where(t > 0, np.exp(-np.sum(p * p, axis=2) / 2), 0)
    unclamped = footprints.opacities[ids, None] * falloffs
    return Hit(unclamped, np.broadcast_to(footprints.depths[ids, None], t.shape), Place(d, t, p, falloffs))


def hit_vjp(
    footprints: LensFootprints, ids: Ints, found: Hit, v_mean: Floats, v_shape: Floats, v_place: None
) -> tuple[Floats, Floats, Floats]:
    """Gradient of :func:`hit`, summed over the rays.

    With ``v_sigma = -alpha v_alpha`` of ``sigma = p . p / 2``; t minimises sigma, so it has no share::

        v_o = E v_alpha,   v_x = v_sigma M^T p,   v_M = v_sigma p (x - t d)^T
    """
    d, t, p, falloffs = found.place
    v_sigma = -footprints.opacities[ids, None] * falloffs
    v_b = np.einsum("gp,gpi->gi", v_sigma * v_mean, p)
    v_positions = np.einsum("gij,gi->gj", footprints.whitenings[ids], v_b)
    offsets = footprints.positions[ids, None] - t[:, :, None] * d
    v_whitenings = np.einsum("gp,gpi,gpj->gij", v_sigma * v_shape, p, offsets)
    return v_positions, v_whitenings, np.sum(falloffs * v_shape, axis=1)


def boxes_of(footprints: LensFootprints) -> Ints:
    """Return the boxes [N, 4] outside of which nothing is hit."""
    return footprints.boxes


def list_tiles(f: LensFootprints, camera: Camera, backend: Backend, conventions: Conventions) -> TileBins:
    """Return the Gaussians of each of the backend's tiles, nearest means first."""
    return list_boxes(f.depths, f.radii, f.boxes, camera, conventions, backend)


RESPONSE = Response(boxes_of, hit, hit_vjp, ("positions", "whitenings", "opacities"))
