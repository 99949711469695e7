"""Stage 7, optional: losses that compare a rendered depth map with what is known or likely about surfaces.

There are three terms besides the photometric loss. None is part of 3DGS or Mini-Splatting; all have the weight 0 by
default:

* depth at the points of structure from motion, as in DS-NeRF (Deng et al. 2022), here robust (Huber 1964);
* depth smoothness that photographed edges switch off, as in Monodepth (Godard et al. 2017);
* normal smoothness with the same edges: half the squared difference of neighbouring normals, 1 minus their cosine.

Depths are compared by the logarithm of their ratio, for three reasons. The unit of a scene from structure from motion
is arbitrary, so a weight must not depend on it; triangulation errors grow with the distance; and too near counts as
much as too far, while inverse depth is hardly sensitive to an error behind a far point. A point is compared with the
pixel that it falls on: interpolating would mix both sides of a silhouette, and half a pixel of a surface tilted by 60
degrees is 0.2 % of its depth at a focal length of 500 pixels, less than the tolerance. Left out are uncertainties of
single points, and the gradient with respect to the pose.

Normals are those of the surface that the pixels of a depth map form, lifted to points: cross products of neighbouring
differences, as in 2D Gaussian Splatting (Huang et al. 2024). The last row and column of pixels lack a neighbour and
have no normal.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.geometry.weights import EDGE_SHARPNESS, SFM_DEPTH_TOLERANCE, GeometricWeights
from minisplat_ref.reference.depth import expected_depth, expected_depth_vjp
from minisplat_ref.reference.pinhole import pinhole, pinhole_rays, pose
from minisplat_ref.types import Bools, Camera, Floats, Ints


class GeometricTape(NamedTuple):
    """The values that the forward pass keeps for the gradient of the geometric loss."""

    accumulated_depth: Floats
    """[H, W]."""
    alpha: Floats
    """[H, W]."""
    depth: Floats
    """[H, W] expected depth; 0 for none, also where masked out."""
    photograph: Floats
    """[H, W, 3]."""
    camera: Camera
    points: Floats
    """[Q, 3] world frame."""
    weights: GeometricWeights


def geometric_loss(
    accumulated_depth: Floats,
    alpha: Floats,
    photograph: Floats,
    camera: Camera,
    points: Floats,
    weights: GeometricWeights,
    mask: Bools | None = None,
) -> tuple[float, GeometricTape]:
    """Return the weighted sum of :func:`sfm_depth_loss`, :func:`depth_smoothness` and :func:`normal_smoothness`.

    Parameters
    ----------
    accumulated_depth : ndarray of shape (H, W)
        ``sum_g w_g z_g``, the last channel of an image that was rendered with depth.
    alpha : ndarray of shape (H, W)
        Accumulated opacity.
    photograph : ndarray of shape (H, W, 3)
        In [0, 1].
    camera : Camera
        The view; its principal point is used.
    points : ndarray of shape (Q, 3)
        World points that the view is known to see; Q may be 0.
    weights : GeometricWeights
        Factors of the terms.
    mask : ndarray of bool of shape (H, W), optional
        True where a pixel counts; the others are treated as if nothing was hit.

    Returns
    -------
    loss : float
        The loss.
    tape : GeometricTape
        For the gradient.
    """
    depth = expected_depth(accumulated_depth, alpha)
    if mask is not None:
        depth = np.where(mask, depth, 0)
    loss = weights.sfm_depth * sfm_depth_loss(depth, camera, points)
    loss += weights.depth_smoothness * depth_smoothness(depth, photograph)
    loss += weights.normal_smoothness * normal_smoothness(depth_normals(depth, camera), photograph)
    return loss, GeometricTape(accumulated_depth, alpha, depth, photograph, camera, points, weights)


def geometric_loss_vjp(tape: GeometricTape, v_loss: float = 1.0) -> tuple[Floats, Floats]:
    """Gradient of :func:`geometric_loss`: those of the terms through depth and normals.

    ::

        v_z = v_loss (w_1 v_z1 + w_2 v_z2 + depth_normals_vjp(w_3 v_n)),   v_D, v_alpha = expected_depth_vjp(v_z)

    Parameters
    ----------
    tape : GeometricTape
        From the forward function.
    v_loss : float
        Derivative with respect to the loss.

    Returns
    -------
    v_accumulated_depth : ndarray of shape (H, W)
        Derivative with respect to the accumulated depth.
    v_alpha : ndarray of shape (H, W)
        Derivative with respect to the accumulated opacity.
    """
    depth, photograph, camera, weights = tape.depth, tape.photograph, tape.camera, tape.weights
    v_normals = normal_smoothness_vjp(depth_normals(depth, camera), photograph, v_loss * weights.normal_smoothness)
    v_depth = depth_normals_vjp(depth, camera, v_normals)
    v_depth += depth_smoothness_vjp(depth, photograph, v_loss * weights.depth_smoothness)
    v_depth += sfm_depth_loss_vjp(depth, camera, tape.points, v_loss * weights.sfm_depth)
    return expected_depth_vjp(tape.accumulated_depth, tape.alpha, v_depth)


def sfm_depth_loss(depth: Floats, camera: Camera, points: Floats) -> float:
    """Return the mean of ``h(log(z / z_p))`` over points of depth z_p, with z of the pixel that a point falls on.

    h is the Huber function with the tolerance tau, a quadratic that continues as a line::

        h(e) = e^2 / (2 tau)  where |e| <= tau,   |e| - tau / 2  beyond

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        Camera z; 0 for none.
    camera : Camera
        The view.
    points : ndarray of shape (Q, 3)
        World frame. Points behind the camera, outside the image or on a pixel without depth are left out.

    Returns
    -------
    float
        0 if no point is left.
    """
    _, _, errors = _depth_errors(depth, camera, points)
    sizes = np.abs(errors)
    is_small = sizes <= SFM_DEPTH_TOLERANCE
    costs = np.where(is_small, errors**2 / (2 * SFM_DEPTH_TOLERANCE), sizes - SFM_DEPTH_TOLERANCE / 2)
    return float(np.sum(costs, dtype=np.float64)) / max(1, len(errors))


def sfm_depth_loss_vjp(depth: Floats, camera: Camera, points: Floats, v_loss: float = 1.0) -> Floats:
    """Gradient of :func:`sfm_depth_loss`.

    With n points that count::

        v_z = sum over the pixel's points of  v_loss h'(e) / (n z),   h'(e) = clip(e / tau, -1, 1)

    Parameters
    ----------
    depth, camera, points
        As for the forward function.
    v_loss : float
        Derivative with respect to the loss.

    Returns
    -------
    ndarray of shape (H, W)
        Derivative with respect to the depth.
    """
    rows, columns, errors = _depth_errors(depth, camera, points)
    slopes = np.clip(errors / SFM_DEPTH_TOLERANCE, -1, 1)
    v_depth = np.zeros_like(depth)
    np.add.at(v_depth, (rows, columns), v_loss * slopes / (max(1, len(errors)) * depth[rows, columns]))
    return v_depth


def depth_smoothness(depth: Floats, photograph: Floats) -> float:
    """Return the mean of ``e |log z' - log z|`` over all pairs of horizontal or vertical neighbours with depth.

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        Camera z; 0 for none.
    photograph : ndarray of shape (H, W, 3)
        It determines the weights e, see :func:`edge_weights`.

    Returns
    -------
    float
        0 for equal depths everywhere; a plane that is tilted against the image has a loss.
    """
    logs, weights = _logs_and_weights(depth, photograph)
    terms = [e * np.abs(np.diff(logs, axis=axis)) for axis, e in enumerate(weights)]
    return sum(float(np.sum(term, dtype=np.float64)) for term in terms)


def depth_smoothness_vjp(depth: Floats, photograph: Floats, v_loss: float = 1.0) -> Floats:
    """Gradient of :func:`depth_smoothness`.

    With n pairs, each difference adds its derivative to its second pixel and the negative to its first::

        v_difference = v_loss e sign(log z' - log z) / n
        v_z = (sum of v_difference where second - sum of v_difference where first) / z

    Parameters
    ----------
    depth, photograph
        As for the forward function.
    v_loss : float
        Derivative with respect to the loss.

    Returns
    -------
    ndarray of shape (H, W)
        Derivative with respect to the depth.
    """
    logs, weights = _logs_and_weights(depth, photograph)
    v_logs = np.zeros_like(depth)
    for axis, e in enumerate(weights):
        v_logs += _diff_vjp(v_loss * e * np.sign(np.diff(logs, axis=axis)), axis)
    return v_logs / np.where(depth > 0, depth, 1)


def normal_smoothness(normals: Floats, photograph: Floats) -> float:
    """Return the mean of ``e (1 - n . n') = e |n' - n|^2 / 2`` over all pairs of horizontal or vertical neighbours.

    Parameters
    ----------
    normals : ndarray of shape (H - 1, W - 1, 3)
        From :func:`depth_normals`; 0 where there is none. Pairs count where both normals exist.
    photograph : ndarray of shape (H, W, 3)
        It determines the weights. A normal spans two pixels, so a pair of normals may cross two edges, and e is the
        product of their :func:`edge_weights`.

    Returns
    -------
    float
        0 for any plane.
    """
    terms = [
        e[:, :, None] * np.diff(normals, axis=axis) ** 2 / 2
        for axis, e in enumerate(_normal_weights(normals, photograph))
    ]
    return sum(float(np.sum(term, dtype=np.float64)) for term in terms)


def normal_smoothness_vjp(normals: Floats, photograph: Floats, v_loss: float = 1.0) -> Floats:
    """Gradient of :func:`normal_smoothness`.

    Each of the n_differences adds its derivative to its second normal and the negative to its first::

        v_difference = v_loss e (n' - n) / n_differences

    Parameters
    ----------
    normals, photograph
        As for the forward function.
    v_loss : float
        Derivative with respect to the loss.

    Returns
    -------
    ndarray of shape (H - 1, W - 1, 3)
        Derivative with respect to the normals.
    """
    v_normals = np.zeros_like(normals)
    for axis, e in enumerate(_normal_weights(normals, photograph)):
        v_normals += _diff_vjp(v_loss * e[:, :, None] * np.diff(normals, axis=axis), axis)
    return v_normals


def edge_weights(photograph: Floats) -> tuple[Floats, Floats]:
    """Return weights ``exp(-k mean |I' - I|)`` of neighbouring pixels: 1 where equal, near 0 across an edge.

    Parameters
    ----------
    photograph : ndarray of shape (H, W, 3)
        In [0, 1]; the mean is over its channels.

    Returns
    -------
    down : ndarray of shape (H - 1, W)
        Between a pixel and the one below.
    right : ndarray of shape (H, W - 1)
        Between a pixel and the one to the right.
    """
    down, right = (np.exp(-EDGE_SHARPNESS * np.mean(np.abs(np.diff(photograph, axis=axis)), axis=2)) for axis in (0, 1))
    return down, right


def _depth_errors(depth: Floats, camera: Camera, points: Floats) -> tuple[Ints, Ints, Floats]:
    """Return row, column and ``log(z / z_p)`` [n] of the points that fall on a pixel with a depth."""
    R, t = pose(camera, points.dtype)
    in_camera = points @ R.T + t
    in_camera = in_camera[in_camera[:, 2] > 0]
    pixels = pinhole(in_camera, camera)  # [n, 2]
    is_inside = np.all((pixels >= 0) & (pixels < [camera.width, camera.height]), axis=1)
    columns, rows = pixels[is_inside].astype(int).T  # rounds down: the centre of pixel 0 is at 0.5
    has_depth = depth[rows, columns] > 0
    rows, columns, z_points = rows[has_depth], columns[has_depth], in_camera[is_inside, 2][has_depth]
    return rows, columns, np.log(depth[rows, columns] / z_points.astype(depth.dtype))


def _logs_and_weights(depth: Floats, photograph: Floats) -> tuple[Floats, tuple[Floats, Floats]]:
    """Return log depths [H, W], 0 where there is none, and the weight of each difference along axes 0 and 1."""
    has_depth = depth > 0
    return np.log(np.where(has_depth, depth, 1)), _mean_weights(edge_weights(photograph), has_depth)


def _normal_weights(normals: Floats, photograph: Floats) -> tuple[Floats, Floats]:
    """Return the weight of each difference of normals along axes 0 and 1 in the mean."""
    down, right = edge_weights(photograph)
    spanned = down[:-1, :-1] * down[1:, :-1], right[:-1, :-1] * right[:-1, 1:]  # [H - 2, W - 1], [H - 1, W - 2]
    return _mean_weights(spanned, np.any(normals != 0, axis=2))


def _mean_weights(weights: tuple[Floats, Floats], exists: Bools) -> tuple[Floats, Floats]:
    """Return weights over the number of pairs that exist, along both axes; 0 where one of a pair does not exist."""
    both_down, both_right = exists[:-1] & exists[1:], exists[:, :-1] & exists[:, 1:]
    n = max(1, int(np.count_nonzero(both_down) + np.count_nonzero(both_right)))
    return np.where(both_down, weights[0], 0) / n, np.where(both_right, weights[1], 0) / n


def _diff_vjp(v_difference: Floats, axis: int) -> Floats:
    """Gradient of ``np.diff``: ``v_x_j = v_difference_{j-1} - v_difference_j``."""
    padding = [(1, 1) if a == axis else (0, 0) for a in range(v_difference.ndim)]
    return -np.diff(np.pad(v_difference, padding), axis=axis)


def depth_normals(depth: Floats, camera: Camera) -> Floats:
    """Return unit normals of the surface through a depth map's points ``X = z r``, r = ((x - cx)/fx, (y - cy)/fy, 1).

    A normal follows from the points of a pixel, of its right neighbour and of its lower neighbour::

        N = (X_down - X) x (X_right - X),   n = N / |N|

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        Camera z, world units; 0 where there is no depth.
    camera : Camera
        Its intrinsics are used.

    Returns
    -------
    ndarray of shape (H - 1, W - 1, 3)
        Unit vectors of the camera frame that point towards the camera; 0 where one of the three pixels has no depth.
    """
    _, _, N, exists = _cross_products(depth, camera)
    return np.where(exists, N, 0) / np.where(exists, np.linalg.norm(N, axis=2, keepdims=True), 1)


def depth_normals_vjp(depth: Floats, camera: Camera, v_normals: Floats) -> Floats:
    """Gradient of :func:`depth_normals`.

    With ``a = X_down - X`` and ``b = X_right - X``::

        v_N = (v_n - (n . v_n) n) / |N|                        0 where there is no normal
        v_a = b x v_N,  v_b = v_N x a
        v_X = sums of v_a, v_b and -(v_a + v_b) over the normals that depend on a point
        v_z = r . v_X

    Parameters
    ----------
    depth, camera
        As for the forward function.
    v_normals : ndarray of shape (H - 1, W - 1, 3)
        Derivative with respect to the normals.

    Returns
    -------
    ndarray of shape (H, W)
        Derivative with respect to the depth.
    """
    a, b, N, exists = _cross_products(depth, camera)
    length = np.where(exists, np.linalg.norm(N, axis=2, keepdims=True), 1)
    n = N / length
    along = np.sum(n * v_normals, axis=2, keepdims=True)
    v_N = np.where(exists, (v_normals - along * n) / length, 0)
    v_a, v_b = np.cross(b, v_N), np.cross(v_N, a)
    rays = _rays(camera, depth)
    v_points = np.zeros_like(rays)
    v_points[:-1, :-1] -= v_a + v_b
    v_points[1:, :-1] += v_a
    v_points[:-1, 1:] += v_b
    return np.sum(rays * v_points, axis=2)


def _rays(camera: Camera, depth: Floats) -> Floats:
    """Return the camera-frame directions r [H, W, 3] of the pixel centres, whose z is 1."""
    height, width = depth.shape
    return pinhole_rays(np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5, camera).astype(depth.dtype)


def _cross_products(depth: Floats, camera: Camera) -> tuple[Floats, Floats, Floats, Bools]:
    """Return a, b and N [H - 1, W - 1, 3], and whether all three pixels have a depth [H - 1, W - 1, 1].

    Where they have one, N is not zero, because three rays through different pixels are linearly independent.
    """
    points = depth[:, :, None] * _rays(camera, depth)
    a, b = points[1:, :-1] - points[:-1, :-1], points[:-1, 1:] - points[:-1, :-1]
    exists = (depth[:-1, :-1] > 0) & (depth[1:, :-1] > 0) & (depth[:-1, 1:] > 0)
    return a, b, np.cross(a, b), exists[:, :, None]
