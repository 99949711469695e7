"""The first population (3DGS, Sec. 4 and 5.1): one Gaussian per point of structure from motion, or per random point.

Left out: the mean distance that the paper states; the released code takes the root mean square, and so do we.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.strategy.clone_split import logit
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Scene

N_NEIGHBOURS = 3
SQUARED_DISTANCE_MIN = 1e-7  # world units^2; points in the same place would get a scale of zero, whose log is -inf
INITIAL_OPACITY = 0.1
N_RANDOM_POINTS = 100_000  # as in 3DGS for scenes without points
GRAY = 127  # of 255. In their box, released code draws harmonics from 0 to 1/255 and not colours, as it seems to intend

IsInside = Callable[[Floats, Camera], Bools]
"""``is_inside(points, camera)``: [P] whether points [P, 3] of the world are inside the camera's image."""


def may_be_inside(points: Floats, camera: Camera) -> Bools:
    """Return for each point [P, 3] whether it may be inside a camera's image, [P]; for a pinhole the answer is exact.

    Lenses are not known here (:mod:`minisplat_ref.mechanisms.cameras` is a layer above), so a camera with optics counts
    as seeing all that a lens of its kind may see: a fisheye and parallel rays every point, others the points in front
    of them.
    """
    x, y, z = (points @ camera.cam_from_world_R.T + camera.cam_from_world_t).T
    is_in_front = z > 0
    if camera.optics is not None:
        return is_in_front if camera.optics.model == "brown" else np.ones(len(points), bool)
    z = np.where(is_in_front, z, 1.0)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return is_in_front & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)


def initial_gaussians(
    scene: Scene, sh_degree: int, rng: np.random.Generator, is_inside: IsInside = may_be_inside
) -> Gaussians:
    """Return Gaussians at the scene's points, or at random ones if it has too few to measure distances.

    Parameters
    ----------
    scene : Scene
    sh_degree : int
        Stored degree; coefficients above degree 0 start at zero.
    rng : numpy.random.Generator
        Draws the random points; untouched when the scene has points.
    is_inside : callable, optional
        As for :func:`random_points`.

    Returns
    -------
    gaussians : Gaussians
        float32.
    """
    if len(scene.points) > N_NEIGHBOURS:
        return gaussians_from_points(scene.points, scene.point_colors, sh_degree)
    cameras = [view.camera for view in scene.train_views]
    if scene.random_box is not None:
        points = random_points(cameras, scene.random_box, N_RANDOM_POINTS, rng, is_inside)
        return gaussians_from_points(points, np.full(points.shape, GRAY, np.uint8), sh_degree)
    points = random_points(cameras, box_around(cameras, scene.extent), N_RANDOM_POINTS, rng, is_inside)
    return gaussians_from_points(points, rng.integers(0, 256, points.shape, np.uint8), sh_degree)


def gaussians_from_points(points: Floats, colors: NDArray[np.uint8], sh_degree: int) -> Gaussians:
    """Return one round Gaussian per point, as large as the distance to its neighbours.

    Parameters
    ----------
    points : ndarray of shape (P, 3)
        World frame.
    colors : ndarray of shape (P, 3), uint8
    sh_degree : int

    Returns
    -------
    gaussians : Gaussians
        float32; scale = root mean square distance to the 3 nearest other points, opacity 0.1, no rotation.

    Raises
    ------
    InputError
        There are fewer than 4 points.
    """
    return gaussians_from_means(points, ((colors / 255.0 - 0.5) / SH_C0).astype(np.float32), sh_degree)


def gaussians_from_means(means: Floats, sh_dc: Floats, sh_degree: int) -> Gaussians:
    """Do as :func:`gaussians_from_points` with colours given as coefficients, and in their dtype.

    Parameters
    ----------
    means : ndarray of shape (P, 3)
        World frame.
    sh_dc : ndarray of shape (P, 3)
    sh_degree : int

    Returns
    -------
    gaussians : Gaussians

    Raises
    ------
    InputError
        There are fewer than 4.
    """
    n, dtype = len(means), sh_dc.dtype
    if n <= N_NEIGHBOURS:
        raise InputError(f"points has {n} rows, a scale needs {N_NEIGHBOURS} neighbours: give more points")
    distances, _ = cKDTree(means).query(means, N_NEIGHBOURS + 1)  # [P, 4], the first is the point itself
    squared = np.maximum((distances[:, 1:] ** 2).mean(axis=1), SQUARED_DISTANCE_MIN)  # [P]
    quats = np.zeros((n, 4), dtype)
    quats[:, 0] = 1
    return Gaussians(
        means=means.astype(dtype),
        quats=quats,
        log_scales=np.repeat(0.5 * np.log(squared)[:, None], 3, axis=1).astype(dtype),
        opacity_logits=np.full(n, logit(INITIAL_OPACITY), dtype),
        sh_dc=sh_dc.copy(),
        sh_rest=np.zeros((n, (sh_degree + 1) ** 2 - 1, 3), dtype),
    )


def box_around(cameras: Sequence[Camera], extent: float) -> Floats:
    """Return the lowest and highest corner [2, 3] of a cube that holds all cameras.

    It is centred on the mean of the camera centres and reaches ``extent`` to each side. It covers an object that they
    surround, but only the near part of a landscape that they look out on.

    Parameters
    ----------
    cameras : sequence of Camera
    extent : float
        ``Scene.extent``, world units.
    """
    centre = np.array([camera.center for camera in cameras]).mean(axis=0)
    return np.array([centre - extent, centre + extent])


def random_points(
    cameras: Sequence[Camera], box: Floats, n: int, rng: np.random.Generator, is_inside: IsInside = may_be_inside
) -> Floats:
    """Return points drawn uniformly in a box, without those that no camera sees.

    A point that no camera sees would never get a gradient and would stay forever.

    Parameters
    ----------
    cameras : sequence of Camera
    box : ndarray of shape (2, 3)
        Lowest and highest corner, world frame.
    n : int
        Number of points drawn.
    rng : numpy.random.Generator
    is_inside : callable, optional
        As for :func:`are_seen`.

    Returns
    -------
    points : ndarray of shape (P, 3), float64
        P is at most ``n``.
    """
    points = rng.uniform(box[0], box[1], (n, 3))  # [n, 3]
    return points[are_seen(points, cameras, is_inside)]


def are_seen(points: Floats, cameras: Sequence[Camera], is_inside: IsInside = may_be_inside) -> Bools:
    """Return for each point [P, 3] whether it is inside the image of any camera, [P].

    Parameters
    ----------
    points : ndarray of shape (P, 3)
    cameras : sequence of Camera
    is_inside : callable, optional
        Decides for one camera.
    """
    is_seen = np.zeros(len(points), bool)
    for camera in cameras:
        is_seen |= is_inside(points, camera)
    return is_seen
