"""Scenes described by transforms.json, in its four dialects.

* Blender (NeRF-synthetic): ``transforms_train.json`` and ``transforms_test.json``, one ``camera_angle_x``, square
  pixels, ``file_path`` without suffix, RGBA images, points in ``points3d.ply`` if there are any, or else random ones in
  the cube of these scenes.
* nerfstudio: ``fl_x fl_y cx cy w h`` at top level or per frame, ``mask_path``, ``ply_file_path``. Its
  ``applied_transform`` has already been applied to poses and points alike, so nothing is left to do with it.
* instant-ngp: as nerfstudio's, with ``aabb_scale``, ``scale`` and ``offset``, which only place the NeRF in its cube;
  often lists images that do not exist: those are named in a warning and skipped.
* Satellite, of our own: as nerfstudio's, with ``camera_model`` AFFINE, focal lengths in pixels per world unit, and
  ``shear``, ``metres_per_unit`` and ``sun`` of :class:`~minisplat_ref.types.Optics`.

Poses are world_from_camera in OpenGL axes (x right, y up, z backward); flipping the y and z columns gives OpenCV axes,
and the inverse gives cam_from_world. The world frame stays the file's. An alpha channel is composited onto the
background. :mod:`.names` restricts the paths that are read. Left out: ``depth_file_path``, file lists of splits,
per-frame exposure, rolling shutter.
"""

import math
import reprlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.images import PHOTOGRAPHS, PIXELS_MAX, image_size
from minisplat_ref.io.json_file import as_array, as_number, read_json
from minisplat_ref.io.lens import PARALLEL_MODEL, PINHOLE_MODELS, POLYNOMIAL_MODELS, Lens
from minisplat_ref.io.names import is_file, nearby_path, spelled_on_disk
from minisplat_ref.io.ply import NO_POINTS, load_points
from minisplat_ref.io.scene import TEST_EVERY, Listing, Photo, build_reading, build_scene, make_listing, split_photos
from minisplat_ref.types import Camera, Floats, Scene

BLENDER_FILES = ("transforms_train.json", "transforms_test.json")
SINGLE_FILE = "transforms.json"
BLENDER_POINTS = ("points3d.ply", "points3D.ply")
BLENDER_BOX = np.array([[-1.3, -1.3, -1.3], [1.3, 1.3, 1.3]])
"""Where the released code of 3DGS draws the points of such a scene, in ``readNerfSyntheticInfo`` of
``scene/dataset_readers.py``."""
OTHER_MODELS = {"PERSPECTIVE": "PINHOLE", "FISHEYE": "OPENCV_FISHEYE", "FULLOPENCV": "FULL_OPENCV"}
"""Names of camera models in other programs, by COLMAP's; upper and lower case are alike."""
OPENCV_FROM_OPENGL = np.array([1.0, -1.0, -1.0])  # factors of the camera's x, y and z axis
NAMED_MISSING_MAX = 20  # missing images that a warning names; all of them would not be one line


def load_transforms(
    path: str | Path,
    *,
    downscale: int = 1,
    test_every: int = TEST_EVERY,
    background: Sequence[float] | Floats | None = None,
    undistort: bool = False,
    as_photographed: bool = False,
) -> Scene:
    """Load a scene described by transforms.json.

    Parameters
    ----------
    path : str or Path
        Folder with ``transforms_train.json`` or ``transforms.json``, or one such file.
    downscale : int
        Divide the image size by this. A folder ``<images>_<downscale>`` is used where it exists, otherwise images are
        resized to the rounded size; intrinsics scale by the exact ratio either way.
    test_every : int
        Of the images sorted by name, every ``test_every``-th is a test view, beginning with the first; 0 for none.
        Where there is a ``transforms_test.json``, it is the test set, unless this is 0.
    background : array_like of shape (3,), optional
        Colour in [0, 1] under transparent images and behind everything; black by default.
    undistort : bool
        Warp images with lens distortion to a pinhole, instead of refusing them.
    as_photographed : bool
        Leave them as they are, with cameras that have ``optics``.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        If a file is missing or malformed, no image exists, there is distortion, or an image does not fit its camera.
    """
    from minisplat_ref.io.inventory import warn_of_unused  # which reads both kinds of scenes

    reading = build_reading(downscale, background, undistort, False, as_photographed)
    scene = build_scene(list_transforms(Path(path), test_every), reading)
    warn_of_unused(Path(path), scene)
    return scene


def list_transforms(path: Path, test_every: int, offset: int = 0) -> Listing:
    """Return all that :func:`load_transforms` reads but the photographs; ``offset`` as for :func:`split_photos`."""
    files = find_transforms(path)
    if not files:
        raise InputError(f"{path}: no {BLENDER_FILES[0]} or {SINGLE_FILE}; give the folder that holds one, or the file")
    if offset and len(files) == 2:
        raise InputError(
            f"{path}: {files[1].name} says which photographs are held out, so that no others can be; give {files[0]} as"
            " the scene to hold out some of that"
        )
    sets = [read_transforms(file) for file in files[: 1 if test_every == 0 else 2]]
    photos = [[photo for _, photo in find_frames(*pair)] for pair in zip(files, sets, strict=False)]
    train_photos, test_photos = split_photos(photos[0], test_every if len(files) == 1 else 0, offset)
    if len(photos) == 2:
        test_photos, _ = split_photos(photos[1], 0)
    points_file = find_points(files[0], sets[0])
    cloud = NO_POINTS if points_file is None else load_points(points_file)
    if cloud.dropped:
        warnings.warn(f"{points_file}: {cloud.dropped} and left out", stacklevel=2)
    listing = make_listing(path, train_photos, test_photos, cloud.points, cloud.colors, alpha_is_mask=False)
    is_blender = files[0].name == BLENDER_FILES[0] and "camera_angle_x" in sets[0]
    return listing._replace(random_box=BLENDER_BOX) if is_blender else listing


def find_transforms(path: Path) -> tuple[Path, ...]:
    """Return the training file and, for Blender scenes that have one, the test file; empty if there is none."""
    if path.is_file():
        return (path,)
    train, test = (path / name for name in BLENDER_FILES)
    if train.is_file():
        return (train, test) if test.is_file() else (train,)
    return (path / SINGLE_FILE,) if (path / SINGLE_FILE).is_file() else ()


def read_transforms(file: Path) -> dict[str, Any]:
    """Parse the JSON and check that it has frames, each with an image and a 4x4 or 3x4 matrix."""
    transforms = read_json(file, "copy or export it again")
    frames = transforms.get("frames") if isinstance(transforms, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{file}: no list 'frames', so this is not a transforms.json with cameras")
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{file}: frame {i} has no file_path; add it or remove the frame")
        if as_array(frame.get("transform_matrix"), (4, 4), (3, 4)) is None:
            raise InputError(f"{file}: transform_matrix of {frame['file_path']} is not 4x4; repair or remove the frame")
    return transforms


def find_frames(file: Path, transforms: Mapping[str, Any]) -> list[tuple[dict[str, Any], Photo]]:
    """Pair the frames of a file with their photographs; one warning names the images that do not exist."""
    frames = [(frame, find_image(file, frame["file_path"])) for frame in transforms["frames"]]
    missing = [frame["file_path"] for frame, image_file in frames if image_file is None]
    if len(missing) == len(frames):
        raise InputError(f"{file}: none of its {len(frames)} images exists, first {missing[0]}; put them beside it")
    if missing:
        names = ", ".join(missing[:NAMED_MISSING_MAX]) + (" and more" if len(missing) > NAMED_MISSING_MAX else "")
        message = f"{file}: {len(missing)} of {len(frames)} images are missing and skipped: {names}"
        warnings.warn(one_line(message), InputWarning, stacklevel=2)
    return [(frame, _photo(file, {**transforms, **frame}, image)) for frame, image in frames if image is not None]


def find_points(file: Path, transforms: Mapping[str, Any]) -> Path | None:
    """Find the point cloud that a file names, or the Blender scene's; None if there is none."""
    if "ply_file_path" in transforms:
        points_file = _named_file(file, transforms, "ply_file_path")
        if not is_file(points_file):
            raise InputError(f"{points_file}: missing, but {file} names it; add it or remove ply_file_path")
        return points_file
    candidates = (file.parent / name for name in BLENDER_POINTS) if file.name == BLENDER_FILES[0] else ()
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def find_image(file: Path, file_path: str) -> Path | None:
    """Return a frame's image, relative to the JSON file; try suffixes if it has none. None if missing."""
    path = nearby_path(file, file_path)
    names = (path.name, *(path.name + suffix for suffix in PHOTOGRAPHS))
    candidates = (path.parent / spelled_on_disk(path.parent, name) for name in names)
    return next((candidate for candidate in candidates if is_file(candidate)), None)


def _named_file(file: Path, entries: Mapping[str, Any], key: str) -> Path:
    """Return the path that an entry gives."""
    if not isinstance(entries[key], str):
        raise InputError(f"{file}: {key} is {reprlib.repr(entries[key])}, not the path of a file; repair or remove it")
    path = nearby_path(file, entries[key])
    return path.parent / spelled_on_disk(path.parent, path.name)


def _time(file: Path, frame: Mapping[str, Any]) -> float:
    """Return when the photograph was taken, the entry ``time`` of scenes that move; 0 without one."""
    time = as_number(frame.get("time", 0.0))
    if not math.isfinite(time):
        raise InputError(f"{file}: {frame.get('file_path')} has the time {reprlib.repr(frame['time'])}: give a number")
    return time


def frame_camera(file: Path, frame: Mapping[str, Any]) -> tuple[Camera, Lens | None, float]:
    """Return camera, lens and time of a frame; its image is looked at only for a size that the file does not have.

    Parameters
    ----------
    file : Path
    frame : mapping
        With the entries of the top level that it does not override.

    Raises
    ------
    InputError
        An entry makes no sense, or there is no size.
    """
    image_file = find_image(file, frame["file_path"])
    if image_file is None and not {"w", "h"} <= frame.keys():
        raise InputError(f"{file}: {frame['file_path']} has no w and h, and is not there to be measured; add them")
    camera, lens = _camera(file, frame, image_file or file)
    return camera, lens, _time(file, frame)


def _photo(file: Path, frame: Mapping[str, Any], image_file: Path) -> Photo:
    """Return one frame's photograph; ``frame`` includes the top level's entries that it does not override."""
    mask_path = _named_file(file, frame, "mask_path") if frame.get("mask_path") else None
    camera, lens = _camera(file, frame, image_file)
    return Photo(image_file.parent, image_file.name, mask_path, camera, lens, time=_time(file, frame))


def _parallel_rays(
    file: Path, frame: Mapping[str, Any], number: Callable[[str], float]
) -> tuple[float, float, float, float, float]:
    """Return the coefficients of affine optics of a frame; one without a sun has no shadows."""
    metres, sun = number("metres_per_unit"), as_array(frame.get("sun", [0, 0, 0]), (3,))
    if not 0 < metres < math.inf:
        raise InputError(f"{file}: metres_per_unit of {frame['file_path']} is not above 0; make the scene again")
    if sun is None or not (sun[2] > 0 or not sun.any()):
        raise InputError(f"{file}: sun of {frame['file_path']} is no direction [3] upwards; make the scene again")
    east, north, up = sun.tolist()
    return number("shear"), metres, east, north, up


def _camera(file: Path, frame: Mapping[str, Any], image_file: Path) -> tuple[Camera, Lens | None]:
    """Return camera and lens of a frame, in whichever dialect its focal length is given."""

    def number(key: str, default: float = 0.0) -> float:
        value = frame.get(key, default)
        if math.isnan(as_number(value)) and not isinstance(value, float):  # NaN itself is shown with the camera
            raise InputError(f"{file}: {key} of {frame['file_path']} is {reprlib.repr(value)}, not a number")
        return as_number(value)

    def n_pixels(key: str) -> int:
        value = number(key)
        if not abs(value) <= PIXELS_MAX:
            raise InputError(f"{file}: {key} of {frame['file_path']} is {value:g}, not a number of pixels; repair it")
        return int(value)

    def focal(key: str, angle_key: str, size: int, default: float) -> float:
        angle = number(angle_key)
        return number(key) if key in frame else size / (2.0 * math.tan(angle / 2.0)) if 0 < angle < math.pi else default

    width, height = n_pixels("w"), n_pixels("h")
    if width <= 0 or height <= 0:
        width, height = image_size(image_file)
    fx = focal("fl_x", "camera_angle_x", width, 0.0)
    if fx <= 0.0:
        raise InputError(f"{file}: {frame['file_path']} has neither fl_x nor camera_angle_x; add one of them")
    matrix = np.array(frame["transform_matrix"], np.float64)
    R = (matrix[:3, :3] * OPENCV_FROM_OPENGL).T
    with np.errstate(over="ignore", invalid="ignore"):  # check_photo refuses the result
        t = -R @ matrix[:3, 3]
    camera = Camera(
        cam_from_world_R=np.ascontiguousarray(R),
        cam_from_world_t=t,
        fx=fx,
        fy=focal("fl_y", "camera_angle_y", height, fx),
        cx=number("cx", width / 2),
        cy=number("cy", height / 2),
        width=width,
        height=height,
    )
    pinhole = (camera.fx, camera.fy, camera.cx, camera.cy)
    k1, k2, k3, k4, p1, p2 = (number(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = str(frame.get("camera_model", "OPENCV")).upper().replace("-", "_")
    model = OTHER_MODELS.get(model, model)
    if model == PARALLEL_MODEL:
        return camera, Lens(model, (*pinhole, *_parallel_rays(file, frame, number)))
    if frame.get("is_fisheye") or model == "OPENCV_FISHEYE":
        return camera, Lens("OPENCV_FISHEYE", (*pinhole, k1, k2, k3, k4))
    if model not in (*PINHOLE_MODELS, *POLYNOMIAL_MODELS) or k4 != 0.0:
        raise InputError(
            f"{file}: camera_model {model} with k4 = {k4:g} of {frame['file_path']} is not supported;"
            " undistort it with the program that calibrated it"
        )
    if k3 != 0.0:
        return camera, Lens("FULL_OPENCV", (*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    return camera, Lens("OPENCV", (*pinhole, k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else None
