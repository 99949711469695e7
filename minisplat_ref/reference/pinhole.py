"""Stage 2a: the camera model. It maps a point in the camera frame to a pixel; a Gaussian needs the map's derivative.

Left out: lens distortion (images are undistorted beforehand) and rolling shutter.
"""

import numpy as np

from minisplat_ref.constants import JACOBIAN_CLAMP, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.types import Camera, Floats, Ints


def pose(camera: Camera, dtype: np.dtype) -> tuple[Floats, Floats]:
    """Return R [3, 3] and t [3] of the camera's ``x = R mu + t`` in the dtype of the data."""
    camera = camera.astype(dtype)
    return camera.cam_from_world_R, camera.cam_from_world_t


def pinhole(means_cam: Floats, camera: Camera) -> Floats:
    """Return the pixel positions of points: ``p_k = f_k x_k / z + c_k`` for k = x, y.

    Parameters
    ----------
    means_cam : ndarray of shape (N, 3)
        Camera frame, world units.
    camera : Camera
        Focal lengths and principal point.

    Returns
    -------
    ndarray of shape (N, 2)
        Pixels.
    """
    focal = np.array([camera.fx, camera.fy], dtype=means_cam.dtype)
    center = np.array([camera.cx, camera.cy], dtype=means_cam.dtype)
    return focal * means_cam[:, :2] / means_cam[:, 2:] + center


def pinhole_vjp(means_cam: Floats, camera: Camera, v_means2d: Floats) -> Floats:
    """Gradient of :func:`pinhole`: ``v_x = J^T v_p`` with its Jacobian J, nowhere clamped.

    Parameters
    ----------
    means_cam, camera
        As for the forward function.
    v_means2d : ndarray of shape (N, 2)
        Derivative with respect to the pixel positions.

    Returns
    -------
    ndarray of shape (N, 3)
        Derivative with respect to ``means_cam``.
    """
    limits = np.full(2, np.inf, dtype=means_cam.dtype)
    return np.einsum("nki,nk->ni", pinhole_jacobians(means_cam, camera, -limits, limits), v_means2d)


def project_into_image(points: Floats, camera: Camera) -> tuple[Ints, Floats, Floats]:
    """Return the rows, image positions and depths of the points inside a camera's image.

    Parameters
    ----------
    points : ndarray of shape (P, 3)
        World frame.
    camera : Camera

    Returns
    -------
    rows : ndarray of shape (Q,) of int
        Points in front of the camera and inside the image, ascending.
    xy : ndarray of shape (Q, 2)
        Pixels.
    depths : ndarray of shape (Q,)
        Camera z, world units.
    """
    _check_pinhole(camera)
    seen = points @ camera.cam_from_world_R.T + camera.cam_from_world_t
    rows = np.flatnonzero(seen[:, 2] > 0)
    xy = pinhole(seen[rows], camera)
    is_inside = (xy >= 0).all(axis=1) & (xy < (camera.width, camera.height)).all(axis=1)
    return rows[is_inside], xy[is_inside], seen[rows[is_inside], 2]


def pinhole_rays(xs: Floats | float, ys: Floats | float, camera: Camera) -> Floats:
    """Return the directions of the rays through image positions, ``r = ((x - c_x) / f_x, (y - c_y) / f_y, 1)``.

    :func:`pinhole` maps every point ``z r`` back to (x, y), and z is its depth.

    Parameters
    ----------
    xs, ys : ndarray or float
        Pixels, of shapes that broadcast; the centre of the first pixel is (0.5, 0.5).
    camera : Camera
        Focal lengths and principal point.

    Returns
    -------
    ndarray of the broadcast shape and (3,)
        Camera frame.
    """
    _check_pinhole(camera)
    slopes = (xs - camera.cx) / camera.fx, (ys - camera.cy) / camera.fy
    return np.stack(np.broadcast_arrays(*slopes, 1.0), axis=-1)


def unproject_depth(depth: Floats, camera: Camera) -> Floats:
    """Return the points that the pixels of a depth map show, ``x_world = R^T (z r - t)``, row by row.

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        Camera z at the centres of the pixels, world units; 0 where a pixel shows nothing.
    camera : Camera

    Returns
    -------
    ndarray of shape (P, 3)
        World frame.
    """
    y, x = np.nonzero(depth)
    in_camera = depth[y, x][:, None] * pinhole_rays(x + 0.5, y + 0.5, camera)
    return np.asarray((in_camera - camera.cam_from_world_t) @ camera.cam_from_world_R)


def pinhole_jacobians(means_cam: Floats, camera: Camera, low: Floats, high: Floats) -> Floats:
    """Return the Jacobians of :func:`pinhole`, EWA splatting equation (29), with x/z and y/z clamped to [low, high].

    ::

        u = clip((x, y) / z, low, high)
        J = [[f_x / z, 0, -f_x u_x / z], [0, f_y / z, -f_y u_y / z]]

    Parameters
    ----------
    means_cam : ndarray of shape (N, 3)
        Camera frame, world units.
    camera : Camera
        Focal lengths.
    low, high : ndarray of shape (2,)
        From :func:`slope_limits`.

    Returns
    -------
    ndarray of shape (N, 2, 3)
        Pixels per world unit.
    """
    focal = np.array([camera.fx, camera.fy], dtype=means_cam.dtype)
    z = means_cam[:, 2:]  # [N, 1]
    slopes = np.clip(means_cam[:, :2] / z, low, high)
    J = np.zeros((len(means_cam), 2, 3), dtype=means_cam.dtype)
    J[:, [0, 1], [0, 1]] = focal / z
    J[:, :, 2] = -focal * slopes / z
    return J


def pinhole_jacobians_vjp(means_cam: Floats, camera: Camera, low: Floats, high: Floats, v_jacobians: Floats) -> Floats:
    """Gradient of :func:`pinhole_jacobians` with respect to the points.

    Every entry is proportional to 1/z, and a slope that is not clamped depends on x and again on z::

        v_u_k = -f_k / z V_k2          where low_k < x_k / z < high_k, else 0
        v_x_k = v_u_k / z
        v_z   = -<J, V> / z - sum_k v_u_k u_k / z

    Parameters
    ----------
    means_cam, camera, low, high
        As for the forward function.
    v_jacobians : ndarray of shape (N, 2, 3)
        V, derivative with respect to the entries of J.

    Returns
    -------
    ndarray of shape (N, 3)
        Derivative with respect to ``means_cam``.
    """
    focal = np.array([camera.fx, camera.fy], dtype=means_cam.dtype)
    z = means_cam[:, 2:]
    slopes = means_cam[:, :2] / z  # [N, 2]
    J = pinhole_jacobians(means_cam, camera, low, high)
    v_slopes = np.where((low < slopes) & (slopes < high), -focal / z * v_jacobians[:, :, 2], 0)
    v_z = -np.einsum("nki,nki->n", J, v_jacobians) - np.einsum("nk,nk->n", v_slopes, slopes)
    return np.column_stack([v_slopes, v_z]) / z


def slope_limits(camera: Camera, conventions: Conventions, dtype: np.dtype) -> tuple[Floats, Floats]:
    """Return the lowest and highest (x/z, y/z) up to which the Jacobian follows the mean.

    Far outside the image the expansion is worthless and its 1/z^2 entry explodes, so the 3DGS code freezes the slope
    there. gsplat measures the margin from the image's edges, INRIA from the axis.

    Parameters
    ----------
    camera : Camera
        Intrinsics and size of the image.
    conventions : Conventions
        ``clamp_is_symmetric`` chooses the rule.
    dtype : dtype
        Of the results.

    Returns
    -------
    low, high : ndarray of shape (2,)
        Slopes, no unit.
    """
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    size = np.array([camera.width, camera.height])
    half_width = 0.5 * size / focal  # tan(half field of view)
    if conventions.clamp_is_symmetric:
        low, high = -JACOBIAN_CLAMP * half_width, JACOBIAN_CLAMP * half_width
    else:
        margin = (JACOBIAN_CLAMP - 1) * half_width
        low, high = -center / focal - margin, (size - center) / focal + margin
    return low.astype(dtype), high.astype(dtype)


def with_principal_point(camera: Camera, conventions: Conventions) -> Camera:
    """Return the camera with the conventions' principal point; INRIA's is the image's centre."""
    if conventions.uses_principal_point:
        return camera
    return camera._replace(cx=0.5 * camera.width, cy=0.5 * camera.height)


def _check_pinhole(camera: Camera) -> None:
    """Refuse a camera whose optics the formulas here would silently ignore.

    Raises
    ------
    InputError
        It is no pinhole.
    """
    if camera.optics is not None:
        raise InputError(
            f"a {camera.optics.model} camera is no pinhole, which this step needs: train with --recipe lens, or with"
            " --undistort and without lens"
        )
