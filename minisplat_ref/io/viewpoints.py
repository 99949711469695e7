"""Viewpoints for ``render``: the cameras of a run or of a JSON file; for paths around a scene see :mod:`.orbits`.

The JSON file is the ``cameras.json`` of 3DGS training folders: a list of objects with ``img_name, width, height``,
``position`` (camera centre, world frame), ``rotation`` (3 x 3, world_from_camera) and ``fx, fy``; and, of our own,
``cx, cy`` (the image's centre where absent), ``split`` (``train`` or ``test``) and ``time`` (0 where absent).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.images import check_n_pixels
from minisplat_ref.io.json_file import as_array, as_number, read_json
from minisplat_ref.io.lens import N_COEFFICIENTS
from minisplat_ref.io.scene import COORDINATE_MAX, ROTATION_TOLERANCE
from minisplat_ref.types import Camera, Optics, Scene

NEEDED = "needed are position, rotation, width, height, fx, fy"


class Viewpoint(NamedTuple):
    """A camera with the name of its image."""

    name: str
    """File name without suffix."""
    camera: Camera
    """The camera."""
    split: str
    """``train``, ``test``, or the empty string if unknown."""
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
            **({} if camera.optics is None else {"optics": [camera.optics.model, *camera.optics.coefficients]}),
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
    return from_json(path, read_json(path, "give the cameras as 3DGS's cameras.json does"))


def from_json(path: Path, entries: Any) -> list[Viewpoint]:
    """Return the viewpoints of a parsed ``cameras.json``; errors as for :func:`read`."""
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} does not hold a list of cameras (the layout of 3DGS's cameras.json)")
    return [to_viewpoint(entry, f"{path}, camera {index}") for index, entry in enumerate(entries)]


def to_viewpoint(entry: Any, where: str) -> Viewpoint:
    """Return one camera of a ``cameras.json``; ``where`` names it in errors, which are those of :func:`read`."""
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
    optics = _optics(entry.get("optics"), where)
    camera = Camera(rotation.T.copy(), -rotation.T @ position, fx, fy, cx, cy, int(width), int(height), optics)
    name, split = (entry.get(key, "") for key in ("img_name", "split"))
    if not (isinstance(name, str | int | float) and isinstance(split, str)):
        raise InputError(f"{where}: img_name and split must be text")
    return Viewpoint(str(name), camera, split, time)


def _optics(value: Any, where: str) -> Optics | None:
    """Return the optics of a camera that is no pinhole: a list of the model's name and its coefficients."""
    if value is None:
        return None
    name, *coefficients = value if isinstance(value, list) and value else [None]
    n_needed = N_COEFFICIENTS.get(name, -1) if isinstance(name, str) else -1
    numbers = as_array(coefficients, (n_needed,)) if n_needed >= 0 else None
    if numbers is None or not np.isfinite(numbers).all():
        forms = " or ".join(f"{known!r} and {k} numbers" for known, k in N_COEFFICIENTS.items())
        raise InputError(f"{where}: optics is not a list of {forms}")
    return Optics(str(name), tuple(numbers.tolist()))
