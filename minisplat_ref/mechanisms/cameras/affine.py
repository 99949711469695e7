"""Cameras without perspective: an affine map projects a Gaussian exactly, and a row of it is the depth that orders.

With ``u = A mu + b``, of which the first two components are pixels and the third is the depth (an altitude, for a
satellite's camera)::

    p = u_xy,   C = A_xy Sigma A_xy^T,   B = C + eps I,   Q = B^-1,   depth = u_z

Nothing is expanded at the mean, so the conic is the footprint itself and not its approximation. :func:`with_affine`
makes of any backend one that projects so; the later stages, the lists and the blending, are those of 3DGS. Depths are
not bounded by near and far planes unless the camera has them, because an altitude may be negative.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.cameras.models import pixels_per_unit
from minisplat_ref.reference.antialiasing import adjugates, compensations, compensations_vjp, determinants
from minisplat_ref.reference.covariance import covariances, covariances_vjp
from minisplat_ref.reference.extent import extents
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Camera, Floats, PrimitiveGradient, Projection, ProjectionGradient


class AffineCamera(NamedTuple):
    """``A`` and ``b`` of a camera, under the names of a pose, with respect to which the core differentiates."""

    cam_from_world_R: Floats
    """[3, 3] A: pixels, pixels and units of depth per world unit. Not a rotation."""
    cam_from_world_t: Floats
    """[3] b: pixels, pixels and units of depth."""
    width: int
    """Image width, pixels."""
    height: int
    """Image height, pixels."""
    near: float = -np.inf
    """Gaussians whose depth is not above are culled."""
    far: float = np.inf
    """Those whose depth is not below."""

    @property
    def direction(self) -> Floats:
        """[3] unit vector along all rays, world frame, towards larger depths."""
        A = np.asarray(self.cam_from_world_R, np.float64)
        along = np.cross(A[0], A[1])
        return along / np.linalg.norm(along) * (1.0 if along @ A[2] >= 0 else -1.0)


def orthographic(camera: Camera, conventions: Conventions) -> AffineCamera:
    """Return a camera with parallel rays: focal lengths are pixels per world unit, the depth is the camera z.

    Parameters
    ----------
    camera : Camera
        Pose and intrinsics; its own optics are not used.
    conventions : Conventions
        Near and far planes.
    """
    scale = np.array([camera.fx, camera.fy, 1.0])
    return AffineCamera(
        scale[:, None] * camera.cam_from_world_R,
        scale * camera.cam_from_world_t + [camera.cx, camera.cy, 0.0],
        camera.width,
        camera.height,
        conventions.near_plane,
        conventions.far_plane,
    )


def downward(camera: Camera) -> AffineCamera:
    """Return the map of a camera with ``affine`` optics: to pixels, and to the negative altitude in metres.

    With rows r of R, ``A = [fx r0, fy (r1 + s r0), -m e_z]`` and ``b = [fx t0 + cx, fy (t1 + s t0) + cy, 0]``.
    """
    L = pixels_per_unit(camera)
    A = np.concatenate([L @ camera.cam_from_world_R[:2], [[0.0, 0.0, -metres_per_unit(camera)]]])
    b = np.append(L @ camera.cam_from_world_t[:2] + [camera.cx, camera.cy], 0.0)
    return AffineCamera(A, b, camera.width, camera.height)


def downward_vjp(camera: Camera, v_A: Floats, v_b: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`downward` with respect to the pose: ``v_R = L^T v_A`` of the pixels; the rest is constant."""
    L = pixels_per_unit(camera)
    return np.concatenate([L.T @ v_A[:2], np.zeros((1, 3))]), np.append(L.T @ v_b[:2], 0.0)


def metres_per_unit(camera: Camera) -> float:
    """Return m of a camera with ``affine`` optics."""
    assert camera.optics is not None and camera.optics.model == "affine"
    return camera.optics.coefficients[1]


def sun_slopes(camera: Camera) -> Floats:
    """Return the direction [3] towards the sun per metre of altitude, world units; zeros where there is no sun."""
    sun = np.array(() if camera.optics is None else camera.optics.coefficients[2:5])
    return sun / (metres_per_unit(camera) * sun[2]) if sun.any() else np.zeros(3)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # non-finite rows are culled, not reported
def project(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: AffineCamera, conventions: Conventions
) -> Projection:
    """Project Gaussians, and cull those that the image does not show; arguments as for the reference's ``project``.

    Conics are float64 and so is all arithmetic; the other fields have the dtype of the means.
    """
    dtype = means.dtype
    u, _, _, C, B = _expand(means, quats, scales, camera, conventions)
    wide = opacities.astype(np.float64)
    if conventions.is_antialiased:
        wide = wide * compensations(C, B)
    det = determinants(B)
    Q = adjugates(B) / det[:, None, None]
    conics = np.column_stack([Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 1]])
    means2d, depths = u[:, :2], u[:, 2]
    radii, boxes = extents(means2d, B, wide, camera, conventions)  # type: ignore[arg-type]  # it reads the size
    is_visible = (camera.near < depths) & (depths < camera.far) & (wide >= conventions.alpha_min) & (det > 0)
    is_visible &= np.isfinite(np.column_stack([det, means2d, conics, wide, radii, boxes])).all(axis=1)
    is_visible &= (radii > 0).all(axis=1) & (boxes[:, :2] < boxes[:, 2:]).all(axis=1)
    rows = is_visible[:, None]
    return Projection(
        means2d=np.where(rows, means2d, 0).astype(dtype),
        depths=np.where(is_visible, depths, 0).astype(dtype),
        conics=np.ascontiguousarray(np.where(rows, conics, 0)),
        opacities=np.where(is_visible, wide, 0).astype(dtype),
        radii=np.where(rows, radii, 0).astype(np.int32),
        boxes=np.where(rows, boxes, 0).astype(np.int32),
    )


def project_vjp(
    means: Floats,
    quats: Floats,
    scales: Floats,
    opacities: Floats,
    camera: AffineCamera,
    conventions: Conventions,
    projection: Projection,
    v_projection: ProjectionGradient,
) -> PrimitiveGradient:
    """Gradient of :func:`project`; culled Gaussians get zeros.

    With ``V_Q = [[v_a, v_b / 2], [v_b / 2, v_c]]`` and ``v_u = (v_p, v_depth)``::

        v_B = -Q V_Q Q,   v_C = v_B and what the compensation adds
        v_Sigma = A_xy^T v_C A_xy,   v_A_xy = 2 v_C A_xy Sigma
        v_mu = A^T v_u,   v_A += sum v_u mu^T,   v_b = sum v_u
    """
    dtype, rows = means.dtype, np.flatnonzero(projection.radii[:, 0] > 0)
    v_means2d, v_depths, v_conics, v_opacities = (field[rows].astype(np.float64) for field in v_projection)
    _, A, Sigma, C, B = _expand(means[rows], quats[rows], scales[rows], camera, conventions)
    Q = adjugates(B) / determinants(B)[:, None, None]
    V = (v_conics * [1, 0.5, 1])[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    v_C = -Q @ V @ Q
    if conventions.is_antialiased:
        v_C = v_C + compensations_vjp(C, B, opacities[rows] * v_opacities)
        v_opacities = v_opacities * compensations(C, B)
    v_u = np.column_stack([v_means2d, v_depths])
    v_Sigma = A[:2].T @ v_C @ A[:2]
    v_quats, v_scales = covariances_vjp(quats[rows].astype(np.float64), scales[rows].astype(np.float64), v_Sigma)
    v_A = v_u.T @ means[rows].astype(np.float64)
    v_A[:2] += 2 * np.einsum("nij,jk,nkl->il", v_C, A[:2], Sigma)

    def scatter(values: Floats) -> Floats:
        full = np.zeros((len(means), *values.shape[1:]), dtype)
        full[rows] = values
        return full

    return PrimitiveGradient(
        scatter(v_u @ A),
        scatter(v_quats),
        scatter(v_scales),
        scatter(v_opacities),
        v_A.astype(dtype),
        v_u.sum(axis=0).astype(dtype),
    )


def with_affine(backend: Backend, adapt: Callable[[Camera, Conventions], AffineCamera] | None = None) -> Backend:
    """Return a backend whose projection is affine; colours must not depend on the view, or be given.

    Parameters
    ----------
    backend : Backend
        That blends.
    adapt : callable, optional
        ``adapt(camera, conventions)`` makes the affine camera of another, such as :func:`orthographic`; without it the
        camera is affine already. Derivatives are always those with respect to A and b.
    """

    def affine(camera: Camera, conventions: Conventions) -> AffineCamera:
        found = camera if adapt is None else adapt(camera, conventions)
        if not isinstance(found, AffineCamera):
            raise InputError("this renderer needs an affine camera: fit one, or take the perspective renderer")
        return found

    def project_affine(
        means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
    ) -> Projection:
        return project(means, quats, scales, opacities, affine(camera, conventions), conventions)

    def project_affine_vjp(
        means: Floats,
        quats: Floats,
        scales: Floats,
        opacities: Floats,
        camera: Camera,
        conventions: Conventions,
        projection: Projection,
        v_projection: ProjectionGradient,
    ) -> PrimitiveGradient:
        seen = affine(camera, conventions)
        return project_vjp(means, quats, scales, opacities, seen, conventions, projection, v_projection)

    name = f"{backend.name} with an affine camera"
    return replace(backend, name=name, project=project_affine, project_vjp=project_affine_vjp)


def _expand(
    means: Floats, quats: Floats, scales: Floats, camera: AffineCamera, conventions: Conventions
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return u [N, 3], A [3, 3], Sigma [N, 3, 3], C and B [N, 2, 2] in float64."""
    A, b = (np.asarray(field, np.float64) for field in camera[:2])
    u = means.astype(np.float64) @ A.T + b
    Sigma = covariances(quats.astype(np.float64), scales.astype(np.float64))
    C = A[:2] @ Sigma @ A[:2].T
    return u, A, Sigma, C, C + conventions.eps2d * np.eye(2)
