"""Viewpoints for ``render``: the cameras of a run, those of a JSON file, or an orbit.

The JSON file is the ``cameras.json`` of 3DGS training folders: a list of objects with ``img_name, width, height``,
``position`` (camera centre, world frame), ``rotation`` (3 x 3, world_from_camera) and ``fx, fy``; and, of our own,
``cx, cy`` (the image's centre where absent), ``split`` (``train`` or ``test``) and ``time`` (0 where absent).
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.images import check_n_pixels
from minisplat_ref.io.json_file import as_array, as_number, read_json
from minisplat_ref.io.scene import COORDINATE_MAX, ROTATION_TOLERANCE
from minisplat_ref.types import Camera, Floats, Scene

ORBIT_FOV = math.radians(50.0)  # horizontal, for an orbit without a run's cameras
NEEDED = "needed are position, rotation, width, height, fx, fy"
ORBIT_ELEVATION = math.radians(20.0)  # likewise


class Viewpoint(NamedTuple):
    """A camera with the name of its picture."""

    name: str
    """File name without suffix."""
    camera: Camera
    """The camera."""
    split: str
    """``train``, ``test`` or, where nothing says so, the empty string."""
    time: float = 0.0
    """The moment shown, in [0, 1]; for scenes that move."""


def scene_viewpoints(scene: Scene) -> list[Viewpoint]:
    """Return the cameras of a scene, training views first."""
    splits = (("train", scene.train_views), ("test", scene.test_views))
    return [Viewpoint(view.name, view.camera, split, view.time) for split, views in splits for view in views]


def to_json(viewpoints: Sequence[Viewpoint]) -> list[dict[str, Any]]:
    """Return the content of ``cameras.json``."""
    return [
        {
            "id": index,
            "img_name": name,
            "split": split,
            "width": camera.width,
            "height": camera.height,
            "position": camera.center.tolist(),
            "rotation": camera.cam_from_world_R.T.tolist(),
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "time": time,
        }
        for index, (name, camera, split, time) in enumerate(viewpoints)
    ]


def read(path: Path) -> list[Viewpoint]:
    """Read a ``cameras.json``.

    Raises
    ------
    InputError
        The file cannot be read, or a camera lacks a value or has one that makes no sense.
    """
    entries = read_json(path, "give the cameras as 3DGS's cameras.json does")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} does not hold a list of cameras (the layout of 3DGS's cameras.json)")
    return [_viewpoint(entry, f"{path}, camera {index}") for index, entry in enumerate(entries)]


def _viewpoint(entry: Any, where: str) -> Viewpoint:
    if not isinstance(entry, dict):
        raise InputError(f"{where} is not an object; {NEEDED}")
    missing = [key for key in ("position", "rotation", "width", "height", "fx", "fy") if key not in entry]
    if missing:
        raise InputError(f"{where} lacks {', '.join(missing)}; {NEEDED}")
    position, rotation = as_array(entry["position"], (3,)), as_array(entry["rotation"], (3, 3))
    width, height, fx, fy = (as_number(entry[key]) for key in ("width", "height", "fx", "fy"))
    cx, cy = as_number(entry.get("cx", 0.5 * width)), as_number(entry.get("cy", 0.5 * height))
    time = as_number(entry.get("time", 0.0))
    numbers = (width, height, fx, fy, cx, cy, time)
    if (
        position is None
        or rotation is None
        or not np.abs([*position, *rotation.flat, *numbers]).max() <= COORDINATE_MAX  # False for NaN
    ):
        raise InputError(
            f"{where}: position must be 3 and rotation 3 x 3 finite numbers, like width, height, fx, fy, cx, cy, time,"
            f" none above {COORDINATE_MAX:g}"
        )
    if min(width, height) < 1 or min(fx, fy) <= 0:
        raise InputError(f"{where}: width, height, fx, fy must be positive")
    check_n_pixels(where, int(width), int(height))
    is_rotation = np.abs(rotation @ rotation.T - np.eye(3)).max() <= ROTATION_TOLERANCE and np.linalg.det(rotation) > 0
    if not is_rotation:
        raise InputError(f"{where}: rotation is not a rotation matrix")
    camera = Camera(rotation.T.copy(), -rotation.T @ position, fx, fy, cx, cy, int(width), int(height))
    name, split = (entry.get(key, "") for key in ("img_name", "split"))
    if not (isinstance(name, str | int | float) and isinstance(split, str)):
        raise InputError(f"{where}: img_name and split must be text")
    return Viewpoint(str(name), camera, split, time)


def orbit(means: Floats, like: Sequence[Viewpoint], n_frames: int, width: int, height: int) -> list[Viewpoint]:
    """Return cameras on a circle that look at the middle of the scene.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        Centres of the Gaussians, world frame.
    like : sequence of Viewpoint
        Cameras of a run, from which the circle takes its centre, height, radius and focal length. Without any, it
        surrounds the median of the means, so far out that nine tenths of them are in view, with -y up (the y axis of
        COLMAP scenes points down).
    n_frames : int
        Number of cameras.
    width, height : int
        Image size, pixels.

    Returns
    -------
    list of Viewpoint
        Named ``orbit_000`` onwards; the time runs once from 0 to 1 around the circle.
    """
    ring = _ring_of_cameras([view.camera for view in like], width) if like else _ring_of_means(means, width, height)
    viewpoints = []
    for frame in range(n_frames):
        angle = 2.0 * math.pi * frame / n_frames
        offset = ring.radius * (math.cos(angle) * ring.start + math.sin(angle) * np.cross(ring.up, ring.start))  # [3]
        position = ring.target + offset + ring.height * ring.up
        rotation = _looking_at(position, ring.target, ring.up)
        camera = Camera(
            rotation, -rotation @ position, ring.focal, ring.focal, 0.5 * width, 0.5 * height, width, height
        )
        viewpoints.append(Viewpoint(f"orbit_{frame:03d}", camera, "", frame / n_frames))
    return viewpoints


class _Ring(NamedTuple):
    """A circle of positions around a target."""

    target: Floats
    """[3] what every camera looks at, world frame."""
    up: Floats
    """[3] unit axis of the circle."""
    start: Floats
    """[3] unit direction from the axis to the first position."""
    radius: float
    """World units."""
    height: float
    """Of the circle above the target, along ``up``, world units."""
    focal: float
    """Pixels."""


def _ring_of_cameras(cameras: Sequence[Camera], width: int) -> _Ring:
    rotations = np.array([camera.cam_from_world_R for camera in cameras])  # [V, 3, 3]
    centres = np.array([camera.center for camera in cameras])  # [V, 3]
    # The point nearest to all optical axes d: sum (I - d d^T)(x - c) = 0; the damping keeps parallel axes solvable.
    across = np.eye(3) - rotations[:, 2, :, None] * rotations[:, 2, None, :]  # [V, 3, 3]
    damping = 1e-3 * len(cameras) * np.eye(3)
    target = np.linalg.solve(
        across.sum(axis=0) + damping, np.einsum("vij,vj->i", across, centres) + damping @ centres.mean(axis=0)
    )
    up = _unit(-rotations[:, 1].mean(axis=0), fallback=np.array([0.0, -1.0, 0.0]))
    heights = (centres - target) @ up  # [V]
    radial = centres - target - heights[:, None] * up  # [V, 3]
    start = _unit(radial[0], fallback=_perpendicular(up))
    radius = float(np.linalg.norm(radial, axis=1).mean())
    focal = cameras[0].fx * width / cameras[0].width
    return _Ring(target, up, start, radius, float(heights.mean()), focal)


def _ring_of_means(means: Floats, width: int, height: int) -> _Ring:
    target = np.median(means, axis=0) if len(means) else np.zeros(3)  # [3]; floaters do not move a median
    reach = float(np.quantile(np.linalg.norm(means - target, axis=1), 0.9)) if len(means) else 1.0
    focal = 0.5 * width / math.tan(0.5 * ORBIT_FOV)
    distance = max(reach, 1e-6) / math.sin(math.atan(0.5 * min(width, height) / focal))
    up = np.array([0.0, -1.0, 0.0])
    radius, rise = distance * math.cos(ORBIT_ELEVATION), distance * math.sin(ORBIT_ELEVATION)
    return _Ring(target, up, _perpendicular(up), radius, rise, focal)


def _looking_at(position: Floats, target: Floats, up: Floats) -> Floats:
    """Return cam_from_world [3, 3], whose rows are the camera's right, down and forward."""
    forward = _unit(target - position, fallback=_perpendicular(up))
    right = _unit(np.cross(forward, up), fallback=_perpendicular(up))
    return np.stack([right, np.cross(forward, right), forward])


def _perpendicular(direction: Floats) -> Floats:
    """Return a unit vector perpendicular to a direction and to the axis that is least aligned with it."""
    return _unit(np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))]), fallback=np.array([1.0, 0.0, 0.0]))


def _unit(vector: Floats, fallback: Floats) -> Floats:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else fallback
