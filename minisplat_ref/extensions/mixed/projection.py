"""From hulls in the world to their footprints in the image, in NumPy, with the gradient (MP-GS, 2507.11321).

A hull's vertices lie in the plane of its first two axes, all with the covariance ``R S S^T R^T``::

    x_k = mu + a_k R[:, 0] + b_k R[:, 1],   a_1 = b_1 = 0
    p_k = pinhole(R_c x_k + t),   C = A Sigma A^T + eps I,  A = J R_c

One covariance needs one Jacobian J: that at the anchor, the mean of the vertices. The anchor's depth is also that by
which tiles are sorted, and colours are seen from the camera in its direction. A hull is culled if one of its vertices
is nearer than the near plane. Where there is one vertex, anchor and vertex are the mean, and the projection is that of
3DGS, by the backend.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.backends import Backend
from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.mixed.response import Footprints
from minisplat_ref.reference.antialiasing import adjugates, compensations, determinants
from minisplat_ref.reference.covariance import covariances, rotation_matrices, rotation_matrices_vjp
from minisplat_ref.reference.extent import extents
from minisplat_ref.reference.pinhole import (
    pinhole,
    pinhole_jacobians,
    pinhole_vjp,
    pose,
    slope_limits,
    with_principal_point,
)
from minisplat_ref.types import Camera, Floats, Ints, Primitives, Projection, ProjectionGradient, TileBins, TileGrid

N_VERTICES = 3  # at most


def corners_of(means: Floats, quats: Floats, offsets: Floats, n_vertices: Ints) -> Floats:
    """Return the vertices x_k in the world.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        mu, the first vertices.
    quats : ndarray of shape (N, 4)
    offsets : ndarray of shape (N, 4)
        a_2, b_2, a_3, b_3, world units.
    n_vertices : ndarray of shape (N,)
        1, 2 or 3.

    Returns
    -------
    ndarray of shape (N, 3, 3)
        One vertex after the other; those that a hull does not have repeat the first.
    """
    in_plane = _in_plane(offsets, n_vertices)
    return means[:, None] + np.einsum("nij,nkj->nki", rotation_matrices(quats)[:, :, :2], in_plane)


def corners_vjp(quats: Floats, offsets: Floats, n_vertices: Ints, v_corners: Floats) -> tuple[Floats, Floats, Floats]:
    """Gradient of :func:`corners_of` with respect to means, quaternions and offsets.

    ::

        v_mu = sum_k v_x_k,  v_(a,b)_k = R[:, :2]^T v_x_k where there is a k-th vertex,  v_R[:, :2] = sum_k v_x_k (a,b)_k^T
    """
    R, in_plane = rotation_matrices(quats), _in_plane(offsets, n_vertices)
    v_R = np.zeros_like(R)
    v_R[:, :, :2] = np.einsum("nki,nkj->nij", v_corners, in_plane)
    v_in_plane = np.einsum("nij,nki->nkj", R[:, :, :2], v_corners) * _has_vertex(n_vertices)[:, :, None]
    return v_corners.sum(axis=1), rotation_matrices_vjp(quats, v_R), v_in_plane[:, 1:].reshape(offsets.shape)


def _in_plane(offsets: Floats, n_vertices: Ints) -> Floats:
    """Return (a, b)_k [N, 3, 2] of all vertices, zeros where there is none."""
    in_plane = np.zeros((len(offsets), N_VERTICES, 2), offsets.dtype)
    in_plane[:, 1:] = offsets.reshape(-1, N_VERTICES - 1, 2)
    return in_plane * _has_vertex(n_vertices)[:, :, None]


def _has_vertex(n_vertices: Ints) -> Floats:
    """Return 1 where a hull has the k-th vertex and 0 elsewhere, [N, 3]; an int8 widens no float."""
    return (np.arange(N_VERTICES) < n_vertices[:, None]).astype(np.int8)


def anchors_of(corners: Floats, n_vertices: Ints) -> Floats:
    """Return the means [N, 3] of the vertices; of a single vertex, the vertex itself."""
    total = np.sum(corners * _has_vertex(n_vertices)[:, :, None], axis=1)
    return np.where((n_vertices > 1)[:, None], total / n_vertices.astype(corners.dtype)[:, None], corners[:, 0])


class Seen(NamedTuple):
    """Hulls before a camera."""

    anchors: Primitives
    """With the anchors for means."""
    corners: Floats
    """[N, 3, 3] x_k."""
    footprints: Footprints


def project(
    primitives: Primitives,
    offsets: Floats,
    n_vertices: Ints,
    camera: Camera,
    conventions: Conventions,
    backend: Backend,
) -> Seen:
    """Project hulls into the image and cull those that it does not show."""
    corners = corners_of(primitives.means, primitives.quats, offsets, n_vertices)
    anchors = primitives._replace(means=np.ascontiguousarray(anchors_of(corners, n_vertices)))
    is_hull = n_vertices > 1
    of_points = np.where(is_hull, primitives.opacities.dtype.type(0), primitives.opacities)
    projection = backend.project(*anchors._replace(opacities=of_points), camera, conventions)
    vertices = np.repeat(projection.means2d[:, None], N_VERTICES, axis=1)
    rows = np.flatnonzero(is_hull)
    of_rows, found = _project_hulls(Primitives(*(f[rows] for f in anchors)), corners[rows], camera, conventions)
    for whole, part in zip((*projection, vertices), (*of_rows, found), strict=True):
        whole[rows] = part
    return Seen(anchors, corners, Footprints(projection, vertices, n_vertices))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # non-finite rows are culled, not reported
def _project_hulls(
    anchors: Primitives, corners: Floats, camera: Camera, conventions: Conventions
) -> tuple[Projection, Floats]:
    """Return the projection of hulls, and their vertices [N, 3, 2] in px; in float64 whatever the data."""
    means, quats, scales, opacities = (field.astype(np.float64) for field in anchors)
    camera = with_principal_point(camera, conventions)
    R, t = pose(camera, means.dtype)
    x, x_corners = means @ R.T + t, (corners.astype(np.float64) @ R.T + t).reshape(-1, 3)
    A = pinhole_jacobians(x, camera, *slope_limits(camera, conventions, means.dtype)) @ R
    C = A @ covariances(quats, scales) @ np.swapaxes(A, 1, 2)
    B = C + conventions.eps2d * np.eye(2)
    det = determinants(B)
    conics = (adjugates(B) / det[:, None, None])[:, [0, 0, 1], [0, 1, 1]]
    if conventions.is_antialiased:
        opacities = opacities * compensations(C, B)
    vertices = pinhole(x_corners, camera).reshape(-1, N_VERTICES, 2)
    reached = [extents(vertices[:, k], B, opacities, camera, conventions) for k in range(N_VERTICES)]
    radii, each = reached[0][0], np.stack([box for _, box in reached])  # [3, N, 4]
    box = np.hstack([each[:, :, :2].min(axis=0), each[:, :, 2:].max(axis=0)])

    nearest, depths = x_corners[:, 2].reshape(-1, N_VERTICES).min(axis=1), x[:, 2]
    numbers = np.column_stack([det, vertices.reshape(-1, 2 * N_VERTICES), conics, opacities, radii, box])
    is_visible = (conventions.near_plane < nearest) & (depths < conventions.far_plane) & (det > 0)
    is_visible &= (opacities >= conventions.alpha_min) & np.isfinite(numbers).all(axis=1)
    is_visible &= (radii > 0).all(axis=1) & (box[:, :2] < box[:, 2:]).all(axis=1)
    row = is_visible[:, None]
    vertices = np.where(row[:, :, None], vertices, 0)
    projection = Projection(
        means2d=vertices[:, 0],
        depths=np.where(is_visible, depths, 0),
        conics=np.where(row, conics, 0),
        opacities=np.where(is_visible, opacities, 0),
        radii=np.where(row, radii, 0).astype(np.int32),
        boxes=np.where(row, box, 0).astype(np.int32),
    )
    return projection, vertices


class FootprintGradient(NamedTuple):
    """Gradient of the loss with respect to :class:`Footprints`, and to the anchors through the colours."""

    vertices: Floats  # [N, 3, 2]
    conics: Floats  # [N, 3]
    opacities: Floats  # [N]
    depths: Floats  # [N]
    anchors: Floats  # [N, 3]


class HullGradient(NamedTuple):
    """Gradient of the loss with respect to what :func:`project` takes."""

    means: Floats  # [N, 3]
    quats: Floats  # [N, 4]
    scales: Floats  # [N, 3]
    opacities: Floats  # [N]
    offsets: Floats  # [N, 4]
    cam_from_world_R: Floats  # [3, 3]
    cam_from_world_t: Floats  # [3]


def project_vjp(
    seen: Seen, offsets: Floats, camera: Camera, conventions: Conventions, backend: Backend, v: FootprintGradient
) -> HullGradient:
    """Gradient of :func:`project`.

    Conic, opacity and depth move with the anchor; each vertex has its own pinhole::

        v_x_k = R_c^T pinhole_vjp(v_p_k) + v_anchor / m
        v_R_c = that of the anchors + sum pinhole_vjp(v_p_k) x_k^T,  v_t = that of the anchors + sum pinhole_vjp(v_p_k)
    """
    projection, _, n_vertices = seen.footprints
    is_hull = n_vertices > 1
    v_points = np.ascontiguousarray(np.where(is_hull[:, None], 0, v.vertices[:, 0]).astype(v.vertices.dtype))
    v_projection = ProjectionGradient(v_points, v.depths, v.conics, v.opacities)
    v_flat = backend.project_vjp(*seen.anchors, camera, conventions, projection, v_projection)
    means, quats, v_offsets = v_flat.means + v.anchors, v_flat.quats.copy(), np.zeros_like(offsets)

    rows = np.flatnonzero(is_hull & (projection.radii[:, 0] > 0))
    eye = with_principal_point(camera, conventions)
    R, t = pose(camera, seen.corners.dtype)
    corners = seen.corners[rows].reshape(-1, 3)
    v_in_camera = pinhole_vjp(corners @ R.T + t, eye, v.vertices[rows].reshape(-1, 2))
    m = n_vertices[rows].astype(means.dtype)[:, None]
    has_vertex = _has_vertex(n_vertices[rows])[:, :, None]
    v_corners = (v_in_camera @ R).reshape(-1, N_VERTICES, 3) + has_vertex * (means[rows] / m)[:, None]
    means[rows], v_quats, v_offsets[rows] = corners_vjp(
        seen.anchors.quats[rows], offsets[rows], n_vertices[rows], v_corners
    )
    quats[rows] += v_quats
    return HullGradient(
        means,
        quats,
        v_flat.scales,
        v_flat.opacities,
        v_offsets,
        v_flat.cam_from_world_R + v_in_camera.T @ corners,
        v_flat.cam_from_world_t + v_in_camera.sum(axis=0),
    )


def tile_lists(footprints: Footprints, camera: Camera, conventions: Conventions, backend: Backend) -> TileBins:
    """Return the tiles' lists, nearest anchors first; a hull is in the lists of all tiles under its box."""
    projection = footprints.projection
    # The backend leaves out tiles that an ellipse does not reach: one without bounds reaches all.
    conics = np.where((footprints.n_vertices > 1)[:, None], 0, projection.conics).astype(projection.conics.dtype)
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    return backend.bin_gaussians(projection._replace(conics=conics), grid, conventions)
