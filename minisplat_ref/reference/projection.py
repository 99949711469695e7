"""Stage 2: a pinhole camera projects each 3D Gaussian to a 2D Gaussian on the image.

A perspective map is not affine, so it is replaced by its first-order expansion at the mean: EWA splatting (Zwicker et
al. 2002) equation (31), 3DGS equation (5), ``Sigma' = J W Sigma W^T J^T``. Left out: EWA's normalisation of the
footprint; in 3DGS the opacity is that of the peak.

Powers of scales leave the range of float32, from 1e9 pixels on in the determinant. Therefore scales above 1 are divided
by a power of two, 2^m, which is exact, and so are covariances by 2^2m, until the footprint is inverted.
"""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.reference.antialiasing import adjugates, compensations, compensations_vjp, determinants
from minisplat_ref.reference.covariance import covariances, covariances_vjp
from minisplat_ref.reference.extent import extents
from minisplat_ref.reference.pinhole import (
    pinhole,
    pinhole_jacobians,
    pinhole_jacobians_vjp,
    pinhole_vjp,
    pose,
    slope_limits,
    with_principal_point,
)
from minisplat_ref.types import Camera, Floats, Ints, PrimitiveGradient, Projection, ProjectionGradient


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # non-finite rows are culled, not reported
def project(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
) -> Projection:
    """Project Gaussians into the image and cull those that it does not show.

    ::

        x = R mu + t,  p = pinhole(x),  A = J(x) R,  C = A Sigma A^T,  B = C + eps I,  Q = B^-1

    A Gaussian is culled unless ``near < z < far``; if its (compensated) opacity is below ``alpha_min``; if its box lies
    outside the image; if B is not finite or not invertible.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame.
    quats : ndarray of shape (N, 4)
        wxyz, any length.
    scales : ndarray of shape (N, 3)
        Standard deviations, world units.
    opacities : ndarray of shape (N,)
        In [0, 1].
    camera : Camera
        The view.
    conventions : Conventions
        Planes, low-pass, antialiasing, extent rule, principal point and clamp.

    Returns
    -------
    Projection
        Zeros in every field of a culled Gaussian.
    """
    camera = with_principal_point(camera, conventions)
    exponents = _exponents(scales)  # m
    x, *_, C, B = _expand(means, quats, scales, exponents, camera, conventions)
    means2d, depths, det = pinhole(x, camera), x[:, 2], determinants(B)
    conics = np.ldexp(_entries(adjugates(B) / det[:, None, None]), -2 * exponents[:, None])  # of Q
    if conventions.is_antialiased:
        opacities = opacities * compensations(C, B)
    radii, boxes = extents(means2d, np.ldexp(B, 2 * exponents[:, None, None]), opacities, camera, conventions)

    is_visible = (conventions.near_plane < depths) & (depths < conventions.far_plane)
    is_visible &= opacities >= conventions.alpha_min
    is_visible &= (det > 0) & np.isfinite(np.column_stack([det, means2d, conics, opacities, radii, boxes])).all(axis=1)
    is_visible &= (radii > 0).all(axis=1) & (boxes[:, :2] < boxes[:, 2:]).all(axis=1)
    rows = is_visible[:, None]
    return Projection(
        means2d=np.where(rows, means2d, 0),
        depths=np.where(is_visible, depths, 0),
        conics=np.where(rows, conics, 0).copy(order="C"),
        opacities=np.where(is_visible, opacities, 0),
        radii=np.where(rows, radii, 0).astype(np.int32),
        boxes=np.where(rows, boxes, 0).astype(np.int32),
    )


def project_vjp(
    means: Floats,
    quats: Floats,
    scales: Floats,
    opacities: Floats,
    camera: Camera,
    conventions: Conventions,
    projection: Projection,
    v_projection: ProjectionGradient,
) -> PrimitiveGradient:
    """Gradient of :func:`project`; culled Gaussians get zeros.

    With ``V_Q = [[v_a, v_b / 2], [v_b / 2, v_c]]``, since b occurs twice in Q::

        v_B = -Q V_Q Q
        v_rho = o v_o',  v_o = rho v_o'                        (o' = rho o is the projection's opacity)
        v_C = v_B + compensation's share of v_rho
        v_A = 2 v_C A Sigma,  v_Sigma = A^T v_C A              (v_C is symmetric)
        v_J = v_A R^T
        v_x = pinhole's share + J's share + (0, 0, v_depth)
        v_mu = R^T v_x
        v_R = sum_n J^T v_A + v_x mu^T,  v_t = sum_n v_x

    Parameters
    ----------
    means, quats, scales, opacities, camera, conventions
        As for :func:`project`.
    projection : Projection
        Its result; tells which rows were culled.
    v_projection : ProjectionGradient
        Derivative of the loss with respect to its fields.

    Returns
    -------
    PrimitiveGradient
        Derivative with respect to the Gaussians and by the camera's pose.
    """
    camera = with_principal_point(camera, conventions)
    rows = np.flatnonzero(projection.radii[:, 0] > 0)  # [V] visible
    v_means2d, v_depths, v_conics, v_opacities = (field[rows] for field in v_projection)
    exponents = _exponents(scales[rows])  # m
    x, J, Sigma, A, C, B = _expand(means[rows], quats[rows], scales[rows], exponents, camera, conventions)
    R, _ = pose(camera, means.dtype)
    low, high = slope_limits(camera, conventions, means.dtype)

    Q = adjugates(B) / determinants(B)[:, None, None]
    v_conics = np.ldexp(v_conics * np.array([1, 0.5, 1], dtype=means.dtype), -2 * exponents[:, None])
    v_B = -Q @ _symmetric(v_conics) @ Q
    v_C = v_B  # B = C + eps I
    if conventions.is_antialiased:
        v_C = v_B + compensations_vjp(C, B, opacities[rows] * v_opacities)
        v_opacities = v_opacities * compensations(C, B)
    v_A = 2 * v_C @ A @ Sigma  # [V, 2, 3]
    v_Sigma = np.swapaxes(A, 1, 2) @ v_C @ A
    v_x = pinhole_vjp(x, camera, v_means2d) + pinhole_jacobians_vjp(x, camera, low, high, v_A @ R.T)
    v_x[:, 2] += v_depths
    v_quats, v_scales = covariances_vjp(quats[rows], np.ldexp(scales[rows], -exponents[:, None]), v_Sigma)
    v_scales = np.ldexp(v_scales, -exponents[:, None])
    return PrimitiveGradient(
        means=_scatter(v_x @ R, rows, len(means)),
        quats=_scatter(v_quats, rows, len(means)),
        scales=_scatter(v_scales, rows, len(means)),
        opacities=_scatter(v_opacities, rows, len(means)),
        cam_from_world_R=np.einsum("nki,nkj->ij", J, v_A) + v_x.T @ means[rows],
        cam_from_world_t=v_x.sum(axis=0),
    )


def _exponents(scales: Floats) -> Ints:
    """Return m [N] such that no scale is larger than 2^m; 0 where all are below 1."""
    return np.maximum(np.frexp(scales.max(axis=1))[1], 0)


def _expand(
    means: Floats, quats: Floats, scales: Floats, exponents: Ints, camera: Camera, conventions: Conventions
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Return x [N, 3], J [N, 2, 3], Sigma [N, 3, 3], A [N, 2, 3], C and B [N, 2, 2] of :func:`project`.

    Sigma, C and B are divided by 2^2m.
    """
    R, t = pose(camera, means.dtype)
    x = means @ R.T + t
    J = pinhole_jacobians(x, camera, *slope_limits(camera, conventions, means.dtype))
    Sigma = covariances(quats, np.ldexp(scales, -exponents[:, None]))
    A = J @ R
    C = A @ Sigma @ np.swapaxes(A, 1, 2)
    B = C + np.ldexp(means.dtype.type(conventions.eps2d), -2 * exponents)[:, None, None] * np.eye(2, dtype=means.dtype)
    return x, J, Sigma, A, C, B


def _entries(symmetric: Floats) -> Floats:
    """Return (a, b, c) [N, 3] of [[a, b], [b, c]]."""
    return symmetric[:, [0, 0, 1], [0, 1, 1]]


def _symmetric(entries: Floats) -> Floats:
    """Return [[a, b], [b, c]] for (a, b, c) [N, 3]."""
    return entries[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def _scatter(values: Floats, rows: np.ndarray, n: int) -> Floats:
    """Return an array of n rows with ``values`` at ``rows`` and zeros elsewhere."""
    full = np.zeros((n, *values.shape[1:]), dtype=values.dtype)
    full[rows] = values
    return full
