"""Surfels in the frame of an image: 2D Gaussian Splatting (Huang et al. 2024, arXiv 2403.17888), sections 4.1 and 4.2.

A surfel is a Gaussian on a disc. With the centre mu, the axes r_0 and r_1, and the standard deviations s_0 and s_1, its
points are ``X(u, v) = mu + s_0 u r_0 + s_1 v r_1``, and a camera with the matrix K of its intrinsics sees them at::

    T = K [s_0 R r_0, s_1 R r_1, R mu + t],   T (u, v, 1)^T = z (x, y, 1)^T         equations (5) and (7)

The rows of T are M_u, M_v and M_w. The box of the disc ``u^2 + v^2 <= e^2`` in the image has the centre and the squared
half-extents (with ``k = (e^2, e^2, -1)``; * and / element by element)::

    d = sum(k M_w^2),   c_x = sum(k M_u M_w) / d,   h_x^2 = c_x^2 - sum(k M_u^2) / d,   likewise y from M_v

The centre of the low-pass is c for an e of its own, a little off the projected centre, which is that of e = 0: the
paper's text has the latter, the paper's code e = 3 and gsplat e = 1 (:class:`SurfelRules`).

The third scale has no meaning and gets no gradient. Left out: the packed and sparse outputs of gsplat, which hold the
same numbers.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import RADIUS_MAX, Conventions
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.pinhole import pose, with_principal_point
from minisplat_ref.types import Camera, Floats, Ints, PrimitiveGradient, Primitives

LOW_PASS = 2.0  # px^-2: the low-pass is exp(-LOW_PASS |x - c|^2 / 2), a standard deviation of 0.71 pixels
GSPLAT_CUTOFF = 3.33  # standard deviations to which gsplat renders a disc
EXTENT_MIN = 1e-4  # px^2: least squared half-extent, gsplat's


class SurfelRules(NamedTuple):
    """Differences between renderers of surfels."""

    has_hit_depths: bool
    """Whether the depth of a hit is that of the point hit, or that of the centre."""
    drops_near_hits: bool
    """Whether points before the near plane are not hit, those behind the camera among them."""
    tile_size: int
    """Side of the square tiles, px, to which gsplat extends the reach of a surfel of ``GSPLAT_CUTOFF``; 0: a surfel
    reaches exactly as far as its alpha can be ``alpha_min``, where hits before the near plane are dropped."""
    low_pass_cutoff: float
    """e, standard deviations: the low-pass is around the middle of the box of the disc of this radius."""


PAPER = SurfelRules(has_hit_depths=True, drops_near_hits=True, tile_size=0, low_pass_cutoff=0.0)
"""Those of the paper's text: the low-pass is around the projected centre."""
RELEASED = PAPER._replace(low_pass_cutoff=3.0)
"""Those of its code, without the cut at three standard deviations. A disc that reaches behind the camera has no box,
and a low-pass around its projected centre. Where the low-pass is hit, the code takes the depth at which the ray meets
the plane, which has no bound where a disc is seen from its edge; here it is the depth of the centre."""
GSPLAT = SurfelRules(has_hit_depths=False, drops_near_hits=False, tile_size=16, low_pass_cutoff=1.0)
"""gsplat's ``rasterization_2dgs``."""


class Surfels(NamedTuple):
    """N surfels projected by a camera, in float64; zeros where culled."""

    transforms: Floats
    """[N, 3, 3] T, whose rows are M_u, M_v and M_w."""
    means2d: Floats
    """[N, 2] c, px: centres of the low-pass."""
    opacities: Floats
    """[N] o."""
    depths: Floats
    """[N] of the centres, camera z, world units; the order of the lists. Where ``rules.has_hit_depths`` is false this
    is also the depth of every hit; a caller may replace it by other values to be measured along the rays."""
    normals: Floats
    """[N, 3] unit, camera frame, towards the camera."""
    radii: Ints
    """[N, 2] int32 half-extents along x and y, px; 0 where culled."""
    boxes: Ints
    """[N, 4] int32 pixels x0, y0, x1, y1 (half-open, in the image); empty where culled."""
    rules: SurfelRules
    near_plane: float
    pivot: float
    """q_0, an inverse depth of the view; see :class:`minisplat_ref.mechanisms.surfels.response.Layout`."""


class SurfelGradient(NamedTuple):
    """Gradient of the loss with respect to the differentiable fields of :class:`Surfels`."""

    transforms: Floats
    """[N, 3, 3]."""
    means2d: Floats
    """[N, 2]."""
    opacities: Floats
    """[N]."""
    depths: Floats
    """[N]."""
    normals: Floats
    """[N, 3]."""


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # non-finite rows are culled, not reported
def project(
    primitives: Primitives,
    camera: Camera,
    conventions: Conventions,
    rules: SurfelRules = RELEASED,
    radius_clip: float = 0.0,
) -> Surfels:
    """Project surfels into the image, and cull those that it cannot show.

    A surfel is culled unless ``near < z < far`` at its centre; if d is 0 or anything is not finite; if its box lies
    outside the image; by the exact rule, if its opacity is below ``alpha_min``; by gsplat's, if its radii are at most
    ``radius_clip``.

    Parameters
    ----------
    primitives : Primitives
        N surfels: the first two columns of the rotations and of the scales are the axes of the disc; world frame.
    camera : Camera
        The view.
    conventions : Conventions
        Near and far planes, principal point and ``alpha_min`` are used.
    rules : SurfelRules
        ``PAPER``, ``RELEASED`` or ``GSPLAT``.
    radius_clip : float
        px.
    """
    camera = with_principal_point(camera, conventions)
    means, quats, scales, opacities = (field.astype(np.float64) for field in primitives)
    x, T = _transforms(means, quats, scales, camera)
    c, h2, d = disc_boxes(T, _low_pass_squares(T, rules))
    R, _ = pose(camera, means.dtype)
    n = rotation_matrices(quats)[:, :, 2] @ R.T
    n = np.where(np.sum(n * x, axis=1, keepdims=True) < 0, n, -n)
    if rules.tile_size:
        radii = np.ceil(GSPLAT_CUTOFF * np.sqrt(np.maximum(h2, EXTENT_MIN)))
        tile = rules.tile_size
        low, high = np.floor((c - radii) / tile) * tile, np.ceil((c + radii) / tile) * tile
        is_reached = (c + radii > 0).all(axis=1) & (c - radii < (camera.width, camera.height)).all(axis=1)
        is_reached &= (radii > radius_clip).any(axis=1)
    else:
        low, high = _visible_boxes(T, c, opacities, camera, conventions)
        radii, is_reached = np.ceil((high - low) / 2), opacities >= conventions.alpha_min

    size = np.array([camera.width, camera.height])
    boxes = np.hstack([np.clip(low, 0, size), np.clip(high, 0, size)])
    is_visible = (conventions.near_plane < x[:, 2]) & (x[:, 2] < conventions.far_plane) & (d != 0) & is_reached
    numbers = np.column_stack([T.reshape(-1, 9), c, opacities, n, radii, boxes])
    is_visible &= np.isfinite(numbers).all(axis=1) & (boxes[:, :2] < boxes[:, 2:]).all(axis=1)
    row = is_visible[:, None]
    return Surfels(
        transforms=np.where(row[:, :, None], T, 0),
        means2d=np.where(row, c, 0),
        opacities=np.where(is_visible, opacities, 0),
        depths=np.where(is_visible, x[:, 2], 0),
        normals=np.where(row, n, 0),
        radii=np.where(row, np.minimum(radii, RADIUS_MAX), 0).astype(np.int32),
        boxes=np.where(row, boxes, 0).astype(np.int32),
        rules=rules,
        near_plane=conventions.near_plane,
        pivot=choose_pivot(x[is_visible, 2]),
    )


def project_vjp(
    primitives: Primitives, camera: Camera, conventions: Conventions, surfels: Surfels, v_surfels: SurfelGradient
) -> PrimitiveGradient:
    """Gradient of :func:`project`; culled surfels get zeros.

    With the k of the low-pass, ``v_d = -(v_cx c_x + v_cy c_y) / d`` and A = [s_0 R r_0, s_1 R r_1, x]::

        v_M_u += v_cx k M_w / d                              likewise v_M_v
        v_M_w += k (v_cx M_u + v_cy M_v) / d + 2 v_d k M_w
        v_A    = K^T v_T,  v_x = the last column of v_A, and v_depth on its z
        v_B    = R^T v_A,  v_r_k = s_k (v_B)_k,  v_s_k = r_k . (v_B)_k       k = 0, 1
        v_r_2  = R^T (+-v_n)
        v_R    = v_A [s_0 r_0, s_1 r_1, mu]^T +- v_n r_2^T + v_z e_z mu^T,   v_mu = R^T v_x,   v_t = v_x

    Parameters
    ----------
    primitives, camera, conventions
        As for :func:`project`.
    surfels : Surfels
        The result of :func:`project`.
    v_surfels : SurfelGradient
        Derivative with respect to it.

    Returns
    -------
    PrimitiveGradient
        In the dtype of the primitives.
    """
    dtype, rows = primitives.means.dtype, np.flatnonzero(surfels.radii[:, 0] > 0)  # [V] visible
    camera = with_principal_point(camera, conventions)
    means, quats, scales, _ = (field[rows].astype(np.float64) for field in primitives)
    R, _ = pose(camera, np.dtype(np.float64))
    rotations = rotation_matrices(quats)
    x, T = _transforms(means, quats, scales, camera)
    v_T, v_c, v_o, v_depth, v_n = (np.asarray(field[rows], np.float64) for field in v_surfels)

    v_A = np.swapaxes(_intrinsics(camera), 0, 1) @ (v_T + _centers_vjp(T, surfels, rows, v_c))
    v_A[:, 2, 2] += v_depth
    turned = rotations[:, :, 2] @ R.T
    v_turned = np.where(np.sum(turned * x, axis=1, keepdims=True) < 0, v_n, -v_n)
    v_B = R.T @ v_A
    v_rotations = np.stack([scales[:, :1] * v_B[:, :, 0], scales[:, 1:2] * v_B[:, :, 1], v_turned @ R], axis=2)
    v_scales = np.zeros_like(scales)
    v_scales[:, :2] = np.einsum("nik,nik->nk", rotations[:, :, :2], v_B[:, :, :2])
    frames = np.concatenate([rotations[:, :, :2] * scales[:, None, :2], means[:, :, None]], axis=2)
    v_R = np.einsum("nik,njk->ij", v_A, frames) + v_turned.T @ rotations[:, :, 2]

    def scatter(values: Floats) -> Floats:
        full = np.zeros((len(surfels.radii), *values.shape[1:]), dtype)
        full[rows] = values
        return full

    v_quats = rotation_matrices_vjp(quats, v_rotations)
    v_t = v_A[:, :, 2].sum(axis=0)
    return PrimitiveGradient(
        means=scatter(v_B[:, :, 2]),
        quats=scatter(v_quats),
        scales=scatter(v_scales),
        opacities=scatter(v_o),
        cam_from_world_R=v_R.astype(dtype),
        cam_from_world_t=v_t.astype(dtype),
    )


def disc_boxes(T: Floats, squares: Floats) -> tuple[Floats, Floats, Floats]:
    """Return centres [N, 2] and squared half-extents [N, 2] of discs of squared radii [N] in the image, px, and d [N].

    A disc lies in front of the camera where its d is negative; elsewhere the box means nothing.
    """
    k = np.column_stack([squares, squares, -np.ones_like(squares)])
    d = np.sum(k * T[:, 2] ** 2, axis=1)
    c = np.einsum("nj,nij,nj->ni", k, T[:, :2], T[:, 2]) / d[:, None]
    return c, c * c - np.einsum("nj,nij,nij->ni", k, T[:, :2], T[:, :2]) / d[:, None], d


def centers_moved(v_surfels: SurfelGradient, surfels: Surfels) -> Floats:
    """Return the derivative [N, 2] with respect to the projected centres, per pixel: input of density control.

    A centre that moves by dx takes the third entry of M_u with it by z dx, and the low-pass by dx.
    """
    return v_surfels.transforms[:, :2, 2] * surfels.depths[:, None] + v_surfels.means2d


def _low_pass_squares(T: Floats, rules: SurfelRules) -> Floats:
    """Return e^2 [N] of the discs around whose boxes the low-pass is; 0 of one that would reach behind the camera.

    gsplat has the same for all.
    """
    square = rules.low_pass_cutoff**2
    is_in_front = square * np.sum(T[:, 2, :2] ** 2, axis=1) < T[:, 2, 2] ** 2
    return np.where(is_in_front | (rules.tile_size > 0), square, 0.0)


def _centers_vjp(T: Floats, surfels: Surfels, rows: Ints, v_c: Floats) -> Floats:
    """Return the gradient [V, 3, 3] with respect to T of the visible rows, via the centres c of the low-pass."""
    c, squares = surfels.means2d[rows], _low_pass_squares(T, surfels.rules)
    k = np.column_stack([squares, squares, -np.ones_like(squares)])
    d = np.sum(k * T[:, 2] ** 2, axis=1)[:, None]
    v_T = np.empty_like(T)
    v_T[:, :2] = v_c[:, :, None] * (k * T[:, 2] / d)[:, None]
    v_d = -np.sum(v_c * c, axis=1, keepdims=True) / d
    v_T[:, 2] = k * (np.einsum("ni,nij->nj", v_c, T[:, :2]) / d + 2 * v_d * T[:, 2])
    return v_T


def _transforms(means: Floats, quats: Floats, scales: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Return the centres in the camera's frame [N, 3] and T [N, 3, 3]."""
    R, t = pose(camera, means.dtype)
    x = means @ R.T + t
    axes = R @ (rotation_matrices(quats)[:, :, :2] * scales[:, None, :2])
    return x, _intrinsics(camera) @ np.concatenate([axes, x[:, :, None]], axis=2)


def _intrinsics(camera: Camera) -> Floats:
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def choose_pivot(depths: Floats) -> float:
    """Return the median inverse depth, rounded to three bits: a constant that does not follow the surfels."""
    if len(depths) == 0:
        return 0.0
    mantissa, exponent = np.frexp(np.median(1 / depths))
    return float(np.ldexp(np.rint(8 * mantissa) / 8, exponent))


def _visible_boxes(
    T: Floats, c: Floats, opacities: Floats, camera: Camera, conventions: Conventions
) -> tuple[Floats, Floats]:
    """Return the first and the end [N, 2] of the pixels on which alpha can be ``alpha_min``.

    Both forms of the hit reach the squared radius ``e^2 = 2 ln(o / alpha_min)``, the disc on itself, the low-pass in
    the image. Of a disc that the near plane cuts, the part beyond it counts, since hits before it are dropped; a plane
    at z = 0 bounds no part.
    """
    squares = 2 * np.log(np.maximum(opacities / conventions.alpha_min, 1))
    middle, h2, _ = disc_boxes(T, squares)
    h, low_pass = np.sqrt(np.maximum(h2, 0)), np.sqrt(squares / LOW_PASS)[:, None]
    nearest = T[:, 2, 2] - np.sqrt(squares * np.sum(T[:, 2, :2] ** 2, axis=1))
    is_cut, size = (nearest < conventions.near_plane)[:, None], np.array([camera.width, camera.height])
    first, end = np.zeros_like(c), np.broadcast_to(size, c.shape)
    if conventions.near_plane > 0:
        first, end = (np.clip(bound, 0, size) for bound in cut_disc_boxes(T, squares, conventions.near_plane))
    low = np.minimum(np.where(is_cut, first, middle - h), c - low_pass)
    high = np.maximum(np.where(is_cut, end, middle + h), c + low_pass)
    return np.floor(low), np.ceil(high)


def cut_disc_boxes(T: Floats, squares: Floats, near: float) -> tuple[Floats, Floats]:
    """Return the bounds [N, 2] in the image of those parts of discs that a near plane leaves; px.

    Where the part is widest along x or y, there is an end of the chord at z = near, or a point of the circle. At the
    latter the line ``x = X`` touches the circle: ``l = M_u - X M_w`` has ``l_2^2 = e^2 (l_0^2 + l_1^2)``, that is::

        d X^2 - 2 b X + a = 0,   d = sum(k M_w^2),  b = sum(k M_u M_w),  a = sum(k M_u^2)

    and its z tells whether it is left. With M_v in place of M_u, y is bounded.

    Parameters
    ----------
    T : ndarray of shape (N, 3, 3)
    squares : ndarray of shape (N,)
        e^2, squared radii.
    near : float
        Depth of the plane, world units; it cuts all these discs, and their centres lie beyond it.
    """
    M_w, k = T[:, None, 2], np.column_stack([squares, squares, -np.ones_like(squares)])
    slope = np.linalg.norm(T[:, 2, :2], axis=1, keepdims=True)  # of z on the disc
    uphill, distance = T[:, 2, :2] / slope, (near - T[:, 2, 2:]) / slope
    half = np.sqrt(np.maximum(squares[:, None] - distance**2, 0))
    along = np.column_stack([-uphill[:, 1], uphill[:, 0]])
    ends = np.stack([distance * uphill + half * along, distance * uphill - half * along], axis=1)  # [N, 2, 2] (u, v)
    bounds = (np.einsum("naj,nej->nea", T[:, :2, :2], ends) + T[:, None, :2, 2]) / near  # [N, 2 ends, 2 axes]

    d = np.sum(k * T[:, 2] ** 2, axis=1, keepdims=True)
    b, a = (
        np.einsum("nj,naj,naj->na", k, T[:, :2], other) for other in (np.broadcast_to(M_w, T[:, :2].shape), T[:, :2])
    )
    discriminant = b * b - a * d
    q = b + np.copysign(np.sqrt(np.where(discriminant < 0, np.nan, discriminant)), b)  # NaN: no line touches the disc
    touches = np.stack([q / d, a / q], axis=1)  # [N, 2 roots, 2 axes] X
    line = T[:, None, :2] - touches[..., None] * M_w[:, :, None]
    foot = -line[..., 2:] * line[..., :2] / np.sum(line[..., :2] ** 2, axis=-1, keepdims=True)
    is_left = np.einsum("nj,nraj->nra", T[:, 2, :2], foot) + T[:, 2, 2, None, None] >= near
    low = np.minimum(bounds.min(axis=1), np.where(is_left, touches, np.inf).min(axis=1))
    high = np.maximum(bounds.max(axis=1), np.where(is_left, touches, -np.inf).max(axis=1))
    return low, high
