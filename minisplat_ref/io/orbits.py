"""Paths around a scene for ``render``: along the training cameras of a run, or on a circle around a point cloud.

A camera is described in the cylinder about the scene's axis, which is at right angles to the horizontal edges of the
images and passes through the point nearest to all optical axes. At every angle the path takes the mean of radius,
height and viewing direction of the training cameras near that angle, so that it stays where the scene was photographed:
beyond, no photograph has constrained the Gaussians. Where more than a quarter of the circle was never photographed, the
path leaves it out, and goes there and back along the rest. Where the cameras are those of a walk, it goes there and
back along that instead (:mod:`.walks`).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.io.upright import MINUS_Y, find_up
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.io.walks import is_walk, way_along
from minisplat_ref.types import Camera, Floats

FOV = math.radians(50.0)  # horizontal, around a point cloud
ELEVATION = math.radians(20.0)  # likewise
FULL_CIRCLE = 2.0 * math.pi
LARGEST_GAP = math.radians(90.0)  # between neighbouring cameras; a larger one is not crossed
SMOOTHING = math.radians(15.0)  # standard deviation of the weights by which cameras near an angle count
RADIUS_MIN = 0.1  # of the median: the angle of a camera nearer to the axis is arbitrary
PARALLEL = 0.9  # length of the mean viewing direction, from which on the axes may meet behind the cameras


def orbit(
    means: Floats,
    like: Sequence[Viewpoint],
    n_frames: int,
    width: int,
    height: int,
    arc: float | None = None,
    up: Floats | None = None,
) -> list[Viewpoint]:
    """Return the cameras of a closed path around the scene, or along a walk.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        Centres of the Gaussians, world frame.
    like : sequence of Viewpoint
        Training cameras in the order of their photographs, which the path follows. Without any, it is a circle around
        the median of the means, so wide that nine tenths of them are in the image.
    n_frames : int
        Number of cameras.
    width, height : int
        Image size, pixels.
    arc : float, optional
        Angle that the path covers, radians, centred on the middle of the training cameras. Less than a full circle is
        travelled there and back. By default the angle that the training cameras cover, or the full circle, or a walk,
        and the path begins at one of them.
    up : ndarray of shape (3,), optional
        What is up, world frame; by default what :func:`.upright.find_up` finds, or without cameras -y (the y axis of
        COLMAP scenes points down).

    Returns
    -------
    list of Viewpoint
        Named ``orbit_000`` onwards; the time goes once from 0 to 1 on the way.
    """
    cameras = [view.camera for view in like]
    if up is None:
        up = find_up(cameras, means).direction if cameras else MINUS_Y
    path = _path_of_cameras(cameras, width, up) if cameras else _path_of_means(means, width, height, up)
    first, last = path.covered
    if arc is not None:
        middle = 0.5 * (first + last)
        first, last = (first, first + FULL_CIRCLE) if arc >= FULL_CIRCLE else (middle - 0.5 * arc, middle + 0.5 * arc)
    begin = None if arc is not None or not cameras else _step_to_camera(path, first)
    way = way_along(cameras) if arc is None and is_walk(cameras, _off_circle(path)) else None
    viewpoints = []
    for frame in range(n_frames):
        time = frame / n_frames
        is_closed = way is None and last - first >= FULL_CIRCLE
        share = time if is_closed else 0.5 - 0.5 * math.cos(FULL_CIRCLE * time)  # slows down where it turns
        position, forward = way(share) if way else _place(path, first + share * (last - first), begin)
        rotation = _look_along(forward, path.up)
        camera = Camera(
            rotation, -rotation @ position, path.focal, path.focal, 0.5 * width, 0.5 * height, width, height
        )
        viewpoints.append(Viewpoint(f"orbit_{frame:03d}", camera, "", time))
    return viewpoints


class _Path(NamedTuple):
    """Cameras in cylindrical coordinates about an axis, which define the path."""

    target: Floats
    """[3] origin of the cylinder, world frame."""
    up: Floats
    """[3] unit vector along the axis."""
    start: Floats
    """[3] unit vector across the axis, at angle 0."""
    angles: Floats
    """[V] of the cameras, radians."""
    places: Floats
    """[V, 2] their distances from the axis, and heights along it, world units."""
    directions: Floats
    """[V, 3] where they look: outwards, along the circle, up."""
    covered: tuple[float, float]
    """First and last angle of the path."""
    focal: float
    """Pixels."""


class _Step(NamedTuple):
    """From the path to a camera, at whose angle the path goes all the way, and near it a part."""

    angle: float
    place: Floats
    """[2]"""
    direction: Floats
    """[3]"""


def _step_to_camera(path: _Path, angle: float) -> _Step:
    """Return the step to the camera that is nearest to an angle."""
    nearest = int(_angular_distances(path, angle).argmin())
    place, direction = _smooth(path, angle)
    return _Step(angle, path.places[nearest] - place, path.directions[nearest] - direction)


def _angular_distances(path: _Path, angle: float) -> Floats:
    return np.abs((path.angles - angle + math.pi) % FULL_CIRCLE - math.pi)  # [V]


def _smooth(path: _Path, angle: float) -> tuple[Floats, Floats]:
    """Return distance and height [2], and direction [3], of the cameras near an angle, in the axes of the circle."""
    exponents = -0.5 * (_angular_distances(path, angle) / SMOOTHING) ** 2  # [V]
    weights = np.exp(exponents - exponents.max())  # [V]
    weights /= weights.sum()
    return weights @ path.places, weights @ path.directions


def _off_circle(path: _Path) -> Floats:
    """Return how much farther from the axis the cameras are than the path at their angles [V]."""
    return path.places[:, 0] - np.array([_smooth(path, float(angle))[0][0] for angle in path.angles])


def _place(path: _Path, angle: float, begin: _Step | None) -> tuple[Floats, Floats]:
    """Return the position [3] of the path at an angle, and the direction [3] that it looks in, world frame."""
    place, direction = _smooth(path, angle)
    if begin is not None:
        away = (angle - begin.angle + math.pi) % FULL_CIRCLE - math.pi
        share = math.exp(-0.5 * (away / SMOOTHING) ** 2)
        place, direction = place + share * begin.place, direction + share * begin.direction
    radius, height = place
    outwards = math.cos(angle) * path.start + math.sin(angle) * np.cross(path.up, path.start)  # [3]
    axes = np.stack([outwards, np.cross(path.up, outwards), path.up])  # [3, 3]
    return path.target + radius * outwards + height * path.up, direction @ axes


def _path_of_cameras(cameras: Sequence[Camera], width: int, up: Floats) -> _Path:
    rotations = np.array([camera.cam_from_world_R for camera in cameras])  # [V, 3, 3]
    centres = np.array([camera.center for camera in cameras])  # [V, 3]
    forwards = rotations[:, 2]  # [V, 3]
    target = nearest_to_axes(centres, forwards)
    heights = (centres - target) @ up  # [V]
    radial = centres - target - heights[:, None] * up  # [V, 3]
    radii = np.linalg.norm(radial, axis=1)  # [V]
    start = _unit(radial[0], fallback=_perpendicular(up))
    angles = np.arctan2(radial @ np.cross(up, start), radial @ start)  # [V]
    outwards = np.cos(angles)[:, None] * start + np.sin(angles)[:, None] * np.cross(up, start)  # [V, 3]
    local = np.stack([outwards, np.cross(up, outwards), np.broadcast_to(up, outwards.shape)], axis=1)  # [V, 3, 3]
    directions = np.einsum("vij,vj->vi", local, forwards)  # [V, 3]
    is_off_axis = radii >= RADIUS_MIN * np.median(radii)  # at least one: the largest
    places = np.stack([radii, heights], axis=1)
    focal = cameras[0].fx * width / cameras[0].width
    angles, places, directions = angles[is_off_axis], places[is_off_axis], directions[is_off_axis]
    return _Path(target, up, start, angles, places, directions, _find_covered(angles), focal)


def nearest_to_axes(centres: Floats, forwards: Floats) -> Floats:
    """Return the point nearest to all optical axes; for parallel ones, a point in front of the cameras."""
    # The minimum solves sum (I - d d^T)(x - c) = 0; the damping keeps parallel axes solvable.
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]  # [V, 3, 3]
    middle = centres.mean(axis=0)
    damping = 1e-3 * len(centres) * np.eye(3)
    target = np.linalg.solve(across.sum(axis=0) + damping, np.einsum("vij,vj->i", across, centres) + damping @ middle)
    ahead = forwards.mean(axis=0)  # [3]
    if np.linalg.norm(ahead) < PARALLEL:
        return target
    spread = float(np.sqrt(((centres - middle) ** 2).sum(axis=1).mean()))
    return target + max(spread - float((target - middle) @ ahead), 0.0) * ahead


def _find_covered(angles: Floats) -> tuple[float, float]:
    """Return the first and last angle of the path: a full circle, or all but the largest gap between cameras."""
    ordered = np.sort(angles)
    gaps = np.diff(ordered, append=ordered[0] + FULL_CIRCLE)  # [V]
    widest = int(gaps.argmax())
    if gaps[widest] <= LARGEST_GAP * (1 + 1e-6):
        return 0.0, FULL_CIRCLE
    first = float(ordered[(widest + 1) % len(ordered)])
    return first, first + FULL_CIRCLE - float(gaps[widest])


def _path_of_means(means: Floats, width: int, height: int, up: Floats) -> _Path:
    target = np.median(means, axis=0) if len(means) else np.zeros(3)  # [3]; floaters do not move a median
    offsets = means.astype(np.float64) - target  # [N, 3]
    reach = float(np.quantile(np.linalg.norm(offsets, axis=1), 0.9)) if len(means) else 1.0
    focal = 0.5 * width / math.tan(0.5 * FOV)
    distance = max(reach, 1e-6) / math.sin(math.atan(0.5 * min(width, height) / focal))
    place = distance * np.array([[math.cos(ELEVATION), math.sin(ELEVATION)]])
    direction = np.array([[-math.cos(ELEVATION), 0.0, -math.sin(ELEVATION)]])
    return _Path(target, up, _perpendicular(up), np.zeros(1), place, direction, (0.0, FULL_CIRCLE), focal)


def _look_along(forward: Floats, up: Floats) -> Floats:
    """Return the rotation cam_from_world [3, 3], whose rows are the camera's right, down and forward."""
    forward = _unit(forward, fallback=_perpendicular(up))
    right = _unit(np.cross(forward, up), fallback=_perpendicular(up))
    return np.stack([right, np.cross(forward, right), forward])


def _perpendicular(direction: Floats) -> Floats:
    """Return a unit vector at a right angle to a direction."""
    return _unit(np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))]), fallback=np.array([1.0, 0.0, 0.0]))


def _unit(vector: Floats, fallback: Floats) -> Floats:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else fallback
