"""Gaussians with textures: the population, the point that a ray hits, and opacity and colour there, in NumPy.

In a Gaussian's own axes, each in units of its standard deviation, the ellipsoid of one standard deviation is the unit
sphere around the origin, and a ray from the camera is a line. With K the camera's matrix, R_c and R the rotations of
camera and Gaussian, s its standard deviations, z and p depth and pixel of its centre::

    A = z diag(1 / s) R^T R_c^T K^-1          the frame: from pixels (x, y, 1) to directions
    a = A (p, 1)                              from the camera to the centre
    b = A (x, 1) = a + e,  e = A (x - p, 0)   from the camera along the ray
    q = ((a x e) x b) / (b . b)               the point of the ray that is nearest to the centre
    n = q - sqrt(1 - q . q) b / |b|           the point where it enters the sphere

The length of b does not matter, and q needs no difference of long vectors. Where a ray misses the sphere, q lies
outside it. There n points to q, so that it does not jump at the limb. Near the limb the derivative of the root is
unbounded, so the root is kept from falling below ``LIMB``::

    g = sqrt(max(1 - q . q, LIMB^2)),  n = (q - g b / |b|) / sqrt(max(1, q . q + LIMB^2))

With the real spherical harmonics Y_k, the opacity o = sigmoid(l) of 3DGS and its colour c, which may depend on the
view::

    x(n)     = sum_k h_k Y_k(n),              opacity(n) = sigmoid(l + x)
    color(n) = max(0, c + sum_k k_k Y_k(n))   for each channel; k from 1 on, since o and c are of degree 0
    alpha    = opacity(n) exp(-d^T Q d / 2)

The squares of the harmonics of degree 1 to L add up to ``sum_k Y_k^2 = ((L + 1)^2 - 1) / (4 pi)`` for every n, so ``|x|
<= B`` with ``B = |h| sqrt(((L + 1)^2 - 1) / (4 pi))``. A footprint is as large as that of the opacity ``o_B = sigmoid(l
+ B)``, and alpha is the alpha of that one times m: with ``w = exp(-(l + B))`` and ``e = exp(x - B)``::

    alpha = o_B exp(-d^T Q d / 2) m,  m = e (1 + w) / (e + w),  1 - opacity(n) = w / (e + w)

B needs no derivative, because a change of o_B and of m by B cancel.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minisplat_ref.mechanisms.payload.footprints import Footprints, boxes_of
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.hits import CONIC, ConicPlace, Hit, Response, Shading
from minisplat_ref.reference.pinhole import pose
from minisplat_ref.reference.spherical_harmonics import sh_basis, sh_basis_jacobian
from minisplat_ref.types import Camera, Floats, Gaussians, Ints

DEGREE = 3  # of textures, as in the paper
LIMB = 0.1  # the last 5.7 degrees before the limb, which cover less than the last pixel of most Gaussians
SCALE_MIN = 1e-9  # world units: thinner Gaussians count as this thin


class TexturedGaussians(NamedTuple):
    """Gaussians with textures; the other fields are those of :class:`Gaussians`."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    """[N] coefficient l of degree 0 of the opacity's logit."""
    sh_dc: Floats
    sh_rest: Floats
    color_textures: Floats
    """[N, 3 (K-1)] coefficients k_k of degree 1 and above over the ellipsoid, those of red first."""
    opacity_textures: Floats
    """[N, K-1] coefficients h_k of degree 1 and above of the logit."""


def add_textures(gaussians: Gaussians, degree: int) -> TexturedGaussians:
    """Return Gaussians with textures of zeros up to a degree; with degree 0 they have none, and are those of 3DGS."""
    n, dtype, k = len(gaussians.means), gaussians.means.dtype, (degree + 1) ** 2 - 1
    return TexturedGaussians(
        **{name: getattr(gaussians, name) for name in Gaussians._fields},
        color_textures=np.zeros((n, 3 * k), dtype),
        opacity_textures=np.zeros((n, k), dtype),
    )


def blank(gaussians: Gaussians, rng: np.random.Generator) -> TexturedGaussians:
    """Return Gaussians with textures of zeros, of degree ``DEGREE``."""
    return add_textures(gaussians, DEGREE)


def inverse_intrinsics(camera: Camera, dtype: np.dtype) -> Floats:
    """Return ``K^-1`` [3, 3], from pixels (x, y, 1) to directions of z = 1 in the camera's frame."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    return np.array([[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]], dtype)


def frames(means: Floats, quats: Floats, scales: Floats, camera: Camera) -> Floats:
    """Return the frames ``A = (z / s) (R_c R)^T K^-1`` of Gaussians.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame.
    quats : ndarray of shape (N, 4)
        wxyz, any length.
    scales : ndarray of shape (N, 3)
        Standard deviations, world units.
    camera : Camera
        The view.

    Returns
    -------
    ndarray of shape (N, 3, 3)
        A.
    """
    U, depths, _ = _rotate_rays(means, quats, camera)
    return (depths[:, None] / np.maximum(scales, SCALE_MIN))[:, :, None] * U


class FrameGradient(NamedTuple):
    """Gradient of the loss with respect to the arguments of :func:`frames`."""

    means: Floats  # [N, 3]
    quats: Floats  # [N, 4]
    scales: Floats  # [N, 3]
    cam_from_world_R: Floats  # [3, 3]
    cam_from_world_t: Floats  # [3]


def frames_vjp(means: Floats, quats: Floats, scales: Floats, camera: Camera, v_frames: Floats) -> FrameGradient:
    """Gradient of :func:`frames`.

    With ``U = (R_c R)^T K^-1``, ``A = (z / s) U`` and ``z = (R_c mu + t)_z``::

        v_U = (z / s) v_A,  v_z = sum_ij (v_A)_ij U_ij / s_i,  v_s_i = -sum_j (v_A)_ij A_ij / s_i
        v_G = K^-T v_U^T with G = R_c R,  v_R = R_c^T v_G
        v_R_c = sum_n v_G R^T, and v_z mu in its last row;  v_mu = v_z times that row;  v_t_z = sum_n v_z

    Parameters
    ----------
    means, quats, scales, camera
        As for :func:`frames`.
    v_frames : ndarray of shape (N, 3, 3)
        Derivative with respect to the frames.
    """
    U, depths, R = _rotate_rays(means, quats, camera)
    R_c, _ = pose(camera, means.dtype)
    ratios = 1 / np.maximum(scales, SCALE_MIN)  # [N, 3]
    v_ratios = np.einsum("nij,nij->ni", v_frames, U) * depths[:, None]
    v_depths = np.einsum("nij,nij,ni->n", v_frames, U, ratios)
    v_U = (depths[:, None] * ratios)[:, :, None] * v_frames
    v_G = np.einsum("jk,nik->nji", inverse_intrinsics(camera, means.dtype), v_U)
    v_R_c = np.einsum("nij,nkj->ik", v_G, R)
    v_R_c[2] += v_depths @ means
    v_t = np.zeros(3, means.dtype)
    v_t[2] = v_depths.sum()
    return FrameGradient(
        means=v_depths[:, None] * R_c[2],
        quats=rotation_matrices_vjp(quats, R_c.T @ v_G),
        scales=np.where(scales > SCALE_MIN, -(ratios**2) * v_ratios, 0),
        cam_from_world_R=v_R_c,
        cam_from_world_t=v_t,
    )


def _rotate_rays(means: Floats, quats: Floats, camera: Camera) -> tuple[Floats, Floats, Floats]:
    """Return ``U = (R_c R)^T K^-1`` [N, 3, 3], depths z [N] and R [N, 3, 3]."""
    R_c, t = pose(camera, means.dtype)
    R = rotation_matrices(quats)
    return np.swapaxes(R_c @ R, 1, 2) @ inverse_intrinsics(camera, means.dtype), means @ R_c[2] + t[2], R


class Meeting(NamedTuple):
    """The points at which P rays hit G ellipsoids."""

    offsets: Floats  # [G, P, 2] x - p, px
    a: Floats  # [G, 1, 3]
    e: Floats  # [G, P, 3]
    q: Floats  # [G, P, 3] nearest point
    directions: Floats  # [G, P, 3] n, unit vectors


def meet(frames: Floats, means2d: Floats, centers: Floats) -> Meeting:
    """Return the points at which the rays of pixels enter ellipsoids, or the directions in which they miss them.

    Parameters
    ----------
    frames : ndarray of shape (G, 3, 3)
        A, from :func:`frames`.
    means2d : ndarray of shape (G, 2)
        p, px.
    centers : ndarray of shape (P, 2)
        x, the centres of the pixels, px.
    """
    offsets = centers.astype(means2d.dtype) - means2d[:, None]  # [G, P, 2]
    e = np.einsum("gij,gpj->gpi", frames[:, :, :2], offsets)
    a = (np.einsum("gij,gj->gi", frames[:, :, :2], means2d) + frames[:, :, 2])[:, None]  # [G, 1, 3]
    b = a + e
    q = np.cross(np.cross(a, e), b) / _dot(b, b)
    squared = _dot(q, q)
    g = np.sqrt(np.maximum(1 - squared, LIMB**2))
    length = np.sqrt(np.maximum(1, squared + LIMB**2))
    return Meeting(offsets, a, e, q, (q - g * b / np.sqrt(_dot(b, b))) / length)


def meet_vjp(frames: Floats, means2d: Floats, meeting: Meeting, v_directions: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`meet` with respect to frames and centres, summed over the pixels.

    With ``r = q - g u``, ``u = b / |b|``, ``n = r / l`` and ``h = q . q``::

        v_r = v_n / l,  v_q = v_r,  v_g = -u . v_r,  v_u = -g v_r
        v_h = -v_g / (2 g)                     where g depends on h, else
        v_h = -(n . v_n) / (2 l^2)             since l depends on it
        v_q += 2 q v_h
        v_c = b x v_q / b^2                    with c = a x e and q = c x b / b^2
        v_b = v_q x c / b^2 - 2 b (q . v_q) / b^2 + (v_u - u (u . v_u)) / |b|
        v_a = e x v_c + v_b,  v_e = v_c x a + v_b

    Parameters
    ----------
    frames, means2d
        As for :func:`meet`.
    meeting : Meeting
        The result of :func:`meet`.
    v_directions : ndarray of shape (G, P, 3)
        Derivative with respect to n.

    Returns
    -------
    v_frames : ndarray of shape (G, 3, 3)
    v_means2d : ndarray of shape (G, 2)
    """
    offsets, a, e, q, n = meeting
    b = a + e
    squared, h = _dot(b, b), _dot(q, q)
    u = b / np.sqrt(squared)
    is_round = 1 - h > LIMB**2  # [G, P, 1] where g depends on h
    g, length = np.sqrt(np.maximum(1 - h, LIMB**2)), np.sqrt(np.maximum(1, h + LIMB**2))

    v_r = v_directions / length
    v_u = -g * v_r
    v_h = np.where(is_round, _dot(u, v_r) / (2 * g), -_dot(n, v_directions) / (2 * length**2))
    v_q = v_r + 2 * q * v_h
    c = np.cross(a, e)
    v_c = np.cross(b, v_q) / squared
    v_b = (np.cross(v_q, c) - 2 * b * _dot(q, v_q)) / squared + (v_u - u * _dot(u, v_u)) / np.sqrt(squared)
    v_a = (np.cross(e, v_c) + v_b).sum(axis=1)  # [G, 3]
    v_e = np.cross(v_c, a) + v_b  # [G, P, 3]

    v_frames = np.zeros_like(frames)
    v_frames[:, :, :2] = np.einsum("gpi,gpj->gij", v_e, offsets) + v_a[:, :, None] * means2d[:, None, :]
    v_frames[:, :, 2] = v_a
    v_means2d = np.einsum("gij,gi->gj", frames[:, :, :2], v_a - v_e.sum(axis=1))
    return v_frames, v_means2d


def _dot(x: Floats, y: Floats) -> Floats:
    """Return ``x . y`` along the last axis, which stays with length 1."""
    return np.sum(x * y, axis=-1, keepdims=True)


def visible_frames(means: Floats, quats: Floats, scales: Floats, camera: Camera, radii: Ints) -> Floats:
    """Return the frames [N, 3, 3] where a radius is above 0; unit matrices elsewhere."""
    rows = np.flatnonzero(radii[:, 0] > 0)
    found = np.tile(np.eye(3, dtype=means.dtype), (len(means), 1, 1))
    found[rows] = frames(means[rows], quats[rows], scales[rows], camera)
    return found


def visible_frames_vjp(
    means: Floats, quats: Floats, scales: Floats, camera: Camera, radii: Ints, v_frames: Floats
) -> FrameGradient:
    """Gradient of :func:`visible_frames`: that of :func:`frames`, zero where nothing is seen."""
    rows = np.flatnonzero(radii[:, 0] > 0)
    v = frames_vjp(means[rows], quats[rows], scales[rows], camera, v_frames[rows])
    v_means, v_quats, v_scales = np.zeros_like(means), np.zeros_like(quats), np.zeros_like(scales)
    v_means[rows], v_quats[rows], v_scales[rows] = v.means, v.quats, v.scales
    return FrameGradient(v_means, v_quats, v_scales, v.cam_from_world_R, v.cam_from_world_t)


def find_degree(n_coefficients: int) -> int:
    """Return the degree L of ``(L + 1)^2 - 1`` coefficients."""
    return math.isqrt(n_coefficients + 1) - 1


def bounds(opacity_textures: Floats) -> Floats:
    """Return B [N], the largest value that textures [N, K-1] can add to the logit."""
    bound: Floats = np.linalg.norm(opacity_textures, axis=1)
    return bound * bound.dtype.type(math.sqrt(opacity_textures.shape[1] / (4 * math.pi)))


@dataclass(frozen=True)
class TexturedFootprints(Footprints):
    """The footprints of textured Gaussians.

    The projection is that of the opacity o_B, compensated where the conventions require it.
    """

    logits: Floats
    """[N] l."""
    opacity_textures: Floats
    """[N, K-1] h."""
    frames: Floats
    """[N, 3, 3] A."""

    @property
    def odds(self) -> Floats:
        """[N] w, which may be infinite for Gaussians that are too faint to be seen."""
        with np.errstate(over="ignore"):
            return np.exp(-(self.logits + bounds(self.opacity_textures)))


FIELDS = (*CONIC.fields, "logits", "opacity_textures", "frames")


class Place(NamedTuple):
    """The hits of P pixels on G Gaussians."""

    conic: ConicPlace
    meeting: Meeting
    basis: Floats  # [G, P, K-1] Y_k(n) from degree 1 on
    shares: Floats  # [G, P] m
    transparencies: Floats  # [G, P] 1 - opacity(n)


def hit(footprints: TexturedFootprints, ids: Ints, centers: Floats) -> Hit:
    """Return the hits of footprints at pixels; see :func:`minisplat_ref.reference.hits.conic_hit`."""
    flat = CONIC.hit(footprints.projection, ids, centers)
    h = footprints.opacity_textures[ids]  # [G, K-1]
    meeting = meet(footprints.frames[ids], footprints.means2d[ids], centers)
    n, degree = meeting.directions, find_degree(h.shape[1])
    basis = sh_basis(n.reshape(-1, 3), degree)[:, 1:].reshape(*n.shape[:2], h.shape[1])
    e = np.exp(np.einsum("gk,gpk->gp", h, basis) - bounds(h)[:, None])
    w = footprints.odds[ids, None]
    shares, transparencies = e * (1 + w) / (e + w), w / (e + w)
    return Hit(flat.unclamped * shares, flat.depths, Place(flat.place, meeting, basis, shares, transparencies))


def hit_vjp(
    footprints: TexturedFootprints, ids: Ints, hit: Hit, v_mean: Floats, v_shape: Floats, v_basis: Floats
) -> tuple[Floats, ...]:
    """Gradient of :func:`hit` with respect to ``FIELDS``; ``v_basis`` is the colours' derivative with respect to Y_k.

    ::

        v_E, v_o_B = those of the conic for m v_alpha
        v_x   = alpha (1 - opacity(n)) v_alpha,  v_l = sum v_x,  v_h_k = sum Y_k v_x
        v_Y_k = h_k v_x + the colours',  v_n = sum_k v_Y_k dY_k/dn, and from there to frames and centres
    """
    place: Place = hit.place
    flat = Hit(hit.unclamped, hit.depths, place.conic)
    v_means2d, v_conics, v_opacities = CONIC.hit_vjp(
        footprints.projection, ids, flat, v_mean * place.shares, v_shape * place.shares, None
    )
    v_x = v_shape * hit.unclamped * place.transparencies  # [G, P]
    h, n = footprints.opacity_textures[ids], place.meeting.directions
    v_Y = v_x[:, :, None] * h[:, None] + v_basis
    slopes = sh_basis_jacobian(n.reshape(-1, 3), find_degree(h.shape[1]))[:, 1:].reshape(*v_Y.shape, 3)
    v_n = np.einsum("gpk,gpki->gpi", v_Y, slopes)
    v_frames, v_centers = meet_vjp(footprints.frames[ids], footprints.means2d[ids], place.meeting, v_n)
    v_h = np.einsum("gp,gpk->gk", v_x, place.basis)
    return v_means2d + v_centers, v_conics, v_opacities, v_x.sum(axis=1), v_h, v_frames


def shade(coefficients: Floats, place: Place) -> Floats:
    """Return the channels [G, P, D] of ``coefficients`` [G, D K], which hold c and the k_k of each channel."""
    return np.maximum(0, _unclamped(coefficients, place))


def shade_vjp(coefficients: Floats, place: Place, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`shade` with respect to coefficients [G, D K] and Y_k [G, P, K-1].

    It is zero where the channel was clamped, but not at zero itself, so that a colour of 3DGS that was clamped to zero
    can still get a texture.
    """
    n_coefficients = place.basis.shape[2] + 1
    v = np.where(_unclamped(coefficients, place) >= 0, v, 0)  # [G, P, D]
    k = _split_channels(coefficients, n_coefficients)[:, :, 1:]  # [G, D, K-1]
    v_base = v.sum(axis=1)[:, :, None]  # [G, D, 1]
    v_k = np.einsum("gpd,gpk->gdk", v, place.basis)
    v_coefficients = np.concatenate([v_base, v_k], axis=2).reshape(coefficients.shape)
    return v_coefficients, np.einsum("gpd,gdk->gpk", v, k)


def _unclamped(coefficients: Floats, place: Place) -> Floats:
    by_channel = _split_channels(coefficients, place.basis.shape[2] + 1)
    return by_channel[:, None, :, 0] + np.einsum("gdk,gpk->gpd", by_channel[:, :, 1:], place.basis)


def _split_channels(coefficients: Floats, n_coefficients: int) -> Floats:
    """Return ``coefficients`` [G, D K] as [G, D, K]."""
    return coefficients.reshape(len(coefficients), coefficients.shape[1] // n_coefficients, n_coefficients)


RESPONSE = Response(boxes_of, hit, hit_vjp, FIELDS, Shading(shade, shade_vjp))
