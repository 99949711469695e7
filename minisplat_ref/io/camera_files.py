"""Cameras for ``render`` from the files of other programs, each recognised by its content.

========================  ==================================================================================
``cameras.json``          of 3DGS and ours, :mod:`.viewpoints`
``camera_path.json``      of nerfstudio: ``camera_path``, each with ``camera_to_world``, ``fov`` in degrees from top to
                          bottom, and the size of all
``transforms.json``       any dialect, :mod:`.transforms`; the photographs need not be there
SuperSplat                ``poses``, or ``poseSets`` of them: ``position``, ``target``, ``fov`` in degrees of the longer
                          side
instant-ngp               ``base_cam.json``: a ``path`` of ``R``, ``T`` and ``fov``
COLMAP                    a folder with a model, or a scene that has one
========================  ==================================================================================

Matrices of nerfstudio have OpenGL's axes (x right, y up, z backward). SuperSplat turns what it shows by 180 degrees
about z, so x and y of its places change sign, and up is -y; its angle is that of the longer side. instant-ngp moves a
scene into its unit cube: for a place p of the scene it has ``0.33 p + 0.5`` with the axes y, z, x, and its angle is
from top to bottom; another scale or offset of its transforms.json is not in the file of cameras. Places between the
cameras of a path are not interpolated. What a lens bends is left out, with a warning.
"""

import math
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.colmap import has_model, model_cameras
from minisplat_ref.io.json_file import as_array, as_number, read_json
from minisplat_ref.io.transforms import frame_camera, read_transforms
from minisplat_ref.io.viewpoints import Viewpoint, from_json, to_viewpoint
from minisplat_ref.types import Floats

# playcanvas/supersplat: src/camera-poses.ts for the entries of a pose, src/camera.ts for the side of its angle
FOV = 60.0  # degrees, of SuperSplat, where a file has none
# NVlabs/instant-ngp: nerf_loader.h for the unit cube, camera_path.cu for the entries, testbed.h for the angle's side
NGP_SCALE, NGP_OFFSET = 0.33, 0.5
NGP_AXES = (1, 2, 0)  # of the scene, which are x, y and z of instant-ngp
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
FORMS = (
    "3DGS's cameras.json, nerfstudio's camera_path.json, a transforms.json, SuperSplat's poses, instant-ngp's"
    " base_cam.json, or a folder with a COLMAP model"
)


def read_cameras(path: Path, size: tuple[int, int]) -> list[Viewpoint]:
    """Read the cameras of a file or folder of any program that is known.

    Parameters
    ----------
    path : Path
    size : (int, int)
        Width and height in pixels of images whose file has none.

    Raises
    ------
    InputError
        It is none of these, or damaged, or a camera makes no sense.
    """
    if path.is_dir():
        return _of_colmap(path)
    content = read_json(path, f"give {FORMS}")
    if isinstance(content, dict):
        if isinstance(content.get("camera_path"), list):
            return _of_nerfstudio(path, content, size)
        if isinstance(content.get("path"), list):
            return _numbered(path, content["path"], _of_instant_ngp, size)
        if "frames" in content:
            return _of_transforms(path)
        sets = content.get("poseSets", [content])
        found = [one.get("poses") for one in sets if isinstance(one, dict)] if isinstance(sets, list) else []
        poses = [one for one in found if isinstance(one, list)]
        if poses and len(poses) == len(found):
            return _numbered(path, [pose for one in poses for pose in one], _of_supersplat, size)
    if isinstance(content, list) and content and isinstance(content[0], dict):
        if "target" in content[0]:
            return _numbered(path, content, _of_supersplat, size)
        return from_json(path, content)
    raise InputError(f"{path} does not hold a list of cameras: give {FORMS}")


def _numbered(path: Path, entries: Sequence[Any], convert: Any, size: tuple[int, int]) -> list[Viewpoint]:
    """Return viewpoints of entries, each converted to what a ``cameras.json`` has."""
    if not entries:
        raise InputError(f"{path} has no cameras: give {FORMS}")
    found = []
    for i, entry in enumerate(entries):
        where = f"{path}, camera {i}"
        if not isinstance(entry, dict):
            raise InputError(f"{where} is not an object; export it again")
        name = entry.get("name")
        name = f"{name}_{i:04d}" if isinstance(name, str) and name else f"camera_{i:04d}"
        found.append(to_viewpoint({"img_name": name, **convert(entry, where, size)}, where))
    return found


def _seen_by(fov: Any, where: str, size: tuple[int, int], side: int | None = None) -> dict[str, float]:
    """Return size and focal length of an angle of view, degrees, along a side in pixels: by default the height."""
    angle = as_number(fov)
    if not 0 < angle < 180:
        raise InputError(f"{where}: fov is {fov!r}, not an angle between 0 and 180 degrees; export it again")
    focal = 0.5 * (side or size[1]) / math.tan(math.radians(angle) / 2)
    return {"width": size[0], "height": size[1], "fx": focal, "fy": focal}


def _of_nerfstudio(path: Path, content: dict[str, Any], size: tuple[int, int]) -> list[Viewpoint]:
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise InputError(f"{path}: camera_type is {kind!r}, and paths are rendered in perspective: export it as that")
    width, height = as_number(content.get("render_width", size[0])), as_number(content.get("render_height", size[1]))
    if not (1 <= width <= 1e6 and 1 <= height <= 1e6):
        raise InputError(f"{path}: render_width and render_height are no sizes in pixels; export it again")

    def convert(entry: dict[str, Any], where: str, size: tuple[int, int]) -> dict[str, Any]:
        numbers = entry.get("camera_to_world")
        matrix = as_array(numbers, (4, 4), (3, 4))
        flat = as_array(numbers, (16,), (12,))
        matrix = flat.reshape(-1, 4) if flat is not None else matrix
        if matrix is None:
            raise InputError(f"{where}: camera_to_world is not 4 x 4 numbers; export it again")
        rotation = matrix[:3, :3] @ OPENCV_FROM_OPENGL
        return {**_seen_by(entry.get("fov", FOV), where, size), **_pose(matrix[:3, 3], rotation)}

    return _numbered(path, content["camera_path"], convert, (int(width), int(height)))


def _pose(position: Floats, rotation: Floats) -> dict[str, Any]:
    return {"position": position.tolist(), "rotation": rotation.tolist()}


def _of_supersplat(entry: dict[str, Any], where: str, size: tuple[int, int]) -> dict[str, Any]:
    places = [as_array(entry.get(key), (3,)) for key in ("position", "target")]
    position, target = (place if place is None else place * [-1, -1, 1] for place in places)
    if position is None or target is None:
        raise InputError(f"{where}: position and target must be 3 numbers each; export it again")
    forward = target - position
    right = np.cross(forward, [0.0, -1.0, 0.0])  # up is -y
    if not np.linalg.norm(right) > 0:  # straight up or down, where SuperSplat keeps x
        right = np.array([1.0, 0.0, 0.0])
    if not np.linalg.norm(forward) > 0:
        raise InputError(f"{where}: position and target are one point; export it again")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(forward, right), forward])
    return {**_seen_by(entry.get("fov", FOV), where, size, max(size)), **_pose(position, rotation)}


def _of_instant_ngp(entry: dict[str, Any], where: str, size: tuple[int, int]) -> dict[str, Any]:
    quat, place = as_array(entry.get("R"), (4,)), as_array(entry.get("T"), (3,))
    if quat is None or place is None or not np.linalg.norm(quat) > 0:
        raise InputError(f"{where}: R and T must be 4 and 3 numbers; export it again")
    x, y, z, w = quat / np.linalg.norm(quat)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    position = (place - NGP_OFFSET) / NGP_SCALE
    order = np.argsort(NGP_AXES)
    return {**_seen_by(entry.get("fov", FOV), where, size), **_pose(position[order], rotation[order])}


def _of_transforms(path: Path) -> list[Viewpoint]:
    transforms = read_transforms(path)
    found, lenses = [], []
    for i, frame in enumerate(transforms["frames"]):
        camera, lens, time = frame_camera(path, {**transforms, **frame})
        found.append(_checked(path, i, Path(frame["file_path"]).stem, camera, time))
        lenses.append(lens)
    _warn_of_lenses(path, lenses)
    return found


def _of_colmap(path: Path) -> list[Viewpoint]:
    folder = next((f for f in (path, path / "sparse" / "0", path / "sparse") if has_model(f)), None)
    if folder is None:
        raise InputError(f"{path}: no COLMAP model in it, neither cameras.bin nor cameras.txt: give {FORMS}")
    named = sorted(model_cameras(folder).items())
    _warn_of_lenses(path, [lens for _, (_, lens) in named])
    stems = [Path(name).with_suffix("").as_posix() for name, _ in named]
    return [_checked(path, i, stem, named[i][1][0]) for i, stem in enumerate(stems)]


def _checked(path: Path, i: int, name: str, camera: Any, time: float = 0.0) -> Viewpoint:
    entry = {"img_name": name, "width": camera.width, "height": camera.height, "time": time}
    entry |= {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    with np.errstate(over="ignore", invalid="ignore"):
        entry |= _pose(camera.center, camera.cam_from_world_R.T)
    return to_viewpoint(entry, f"{path}, camera {i}")


def _warn_of_lenses(path: Path, lenses: Iterable[Any]) -> None:
    if n := sum(lens is not None for lens in lenses):
        message = f"{path}: {n} cameras have lens distortion, which is left out: images are those of pinholes"
        warnings.warn(one_line(message), InputWarning, stacklevel=4)
