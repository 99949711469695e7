"""The pose of a viewer's camera, its conversion to a :class:`Camera`, and the path of a film through several poses.

The field of view is that of the vertical, as browsers have it; pixels are square and the principal point is central, so
that a training camera is shown with its vertical field of view and without its lens.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from minisplat_ref.errors import InputError
from minisplat_ref.io.orbits import nearest_to_axes, orbit
from minisplat_ref.io.upright import turn_upright
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.types import Camera, Floats

NEAREST_TARGET = 1e-3  # of the distance to the scene's middle: the orbit centre is in front of the camera


class Pose(NamedTuple):
    """A camera without its image; numbers alone, so that equal ones compare equal."""

    wxyz: tuple[float, ...]
    """[4] rotation world_from_camera; camera axes are OpenCV's."""
    position: tuple[float, ...]
    """[3] world frame."""
    fov: float
    """Vertical field of view, radians."""
    time: float = 0.0
    """Moment shown, of scenes that move."""


class Start(NamedTuple):
    """Initial camera and orbit centre of the viewer."""

    pose: Pose
    target: Floats
    """[3] point on the optical axis, world frame."""
    up: Floats
    """[3] unit vector."""


def camera_from_pose(pose: Pose, width: int, height: int) -> Camera:
    """Return the camera of a pose with an image of width x height pixels."""
    w, x, y, z = pose.wxyz
    cam_from_world_R = Rotation.from_quat([x, y, z, w]).as_matrix().T  # [3, 3]
    focal = 0.5 * height / math.tan(0.5 * pose.fov)
    t = -cam_from_world_R @ np.array(pose.position)
    return Camera(cam_from_world_R, t, focal, focal, 0.5 * width, 0.5 * height, width, height)


def pose_from_camera(camera: Camera, time: float = 0.0) -> Pose:
    """Return the pose of a camera; of another principal point or lens nothing is left."""
    x, y, z, w = Rotation.from_matrix(np.asarray(camera.cam_from_world_R, np.float64).T).as_quat().tolist()
    fov = 2 * math.atan(0.5 * camera.height / camera.fy)
    return Pose((w, x, y, z), tuple(np.asarray(camera.center, np.float64).tolist()), fov, time)


def choose_start(means: Floats, cameras: Sequence[Viewpoint], up: Floats) -> Start:
    """Return the start of a viewer: the first camera, or without any the start of the circle of ``render``.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        Centres of the Gaussians, world frame.
    cameras : sequence of Viewpoint
        Of the training.
    up : ndarray of shape (3,)
        What is up, world frame.
    """
    views = make_upright(cameras, up) or orbit(means, [], 1, 640, 480, up=up)
    rotations = np.array([view.camera.cam_from_world_R for view in views])  # [V, 3, 3]
    centres = np.array([view.camera.center for view in views])  # [V, 3]
    middle = nearest_to_axes(centres, rotations[:, 2]) if cameras else np.median(means, axis=0) if len(means) else None
    position, forward = centres[0], rotations[0, 2]  # [3], [3]
    to_middle = forward if middle is None else middle - position
    distance = max(float(to_middle @ forward), NEAREST_TARGET * float(np.linalg.norm(to_middle)))
    return Start(pose_from_camera(views[0].camera, views[0].time), position + distance * forward, up)


def make_upright(views: Sequence[Viewpoint], up: Floats) -> list[Viewpoint]:
    """Return views of which each is turned by the quarters of a circle that make its image most nearly upright."""
    return [view._replace(camera=turn_upright(view.camera, up)) for view in views]


def travel(keyframes: Sequence[Pose], n_frames: int) -> list[Pose]:
    """Return a path through poses, which it reaches at equal intervals of time.

    Positions, fields of view and moments follow monotone cubics, which pass through the keyframes without overshoot;
    orientations turn about one axis from each keyframe to the next.

    Parameters
    ----------
    keyframes : sequence of Pose
    n_frames : int
        At least 2; the first and the last frame are the first and the last keyframe.

    Raises
    ------
    InputError
        There are fewer than two keyframes.
    """
    if len(keyframes) < 2:
        raise InputError("a film leads from one keyframe to another: add at least two")
    when = np.arange(len(keyframes), dtype=np.float64)
    frames = np.linspace(0.0, when[-1], n_frames)  # [n_frames]
    wxyz = np.array([pose.wxyz for pose in keyframes])  # [K, 4]
    turned = Slerp(when, Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]))(frames).as_quat()[:, [3, 0, 1, 2]]  # [n_frames, 4]
    rest = np.array([[*pose.position, pose.fov, pose.time] for pose in keyframes])  # [K, 5]
    passed = PchipInterpolator(when, rest)(frames)  # [n_frames, 5]
    return [
        Pose(tuple(quat), tuple(row[:3]), row[3], row[4])
        for quat, row in zip(turned.tolist(), passed.tolist(), strict=True)
    ]
