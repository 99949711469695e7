"""Copy a scene and remove the lens distortion of its photographs.

Every photograph is warped to the pinhole that COLMAP chooses for its lens (same focal length, no blank pixels). A
COLMAP scene keeps its points and 2D features, a transforms.json scene its poses and points; masks are warped too, and
in a transforms.json scene, where alpha is no mask, it is composited onto black.
"""

import json
import os
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.colmap import colmap_photos, find_model, image_folder, write_model
from minisplat_ref.io.images import SAVE_OPTIONS, open_image, write_image
from minisplat_ref.io.lens import import_quiet_pycolmap
from minisplat_ref.io.names import file_names
from minisplat_ref.io.scene import Photo, build_reading, check_photo, check_pixels, read_view
from minisplat_ref.io.transforms import find_frames, find_points, find_transforms, read_transforms
from minisplat_ref.types import Camera

# Entries of a transforms.json about lenses; every frame gets its pinhole's entries instead.
LENS_KEYS = (
    *("k1", "k2", "k3", "k4", "p1", "p2", "camera_model", "is_fisheye"),
    *("camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h"),
)
POINTS_FILE = "points3d.ply"
OUTSIDE = "outside"  # folder for copies of photographs that lie beside the scene's folder


def undistort_scene(scene: Path, out: Path) -> None:
    """Write an undistorted copy of a scene, complete or not at all.

    Parameters
    ----------
    scene : Path
        Folder of a COLMAP scene or of a transforms.json, or a transforms.json file.
    out : Path
        Folder to make.

    Raises
    ------
    InputError
        If there is no scene, it has no distortion, or ``out`` is already there.
    """
    model, files = find_model(scene), find_transforms(scene)
    if model is None and not files:
        raise InputError(f"{scene}: neither a COLMAP model nor a transforms.json; give the folder of a scene")
    with making_folder(out) as folder:
        if model is not None:
            photos = colmap_photos(scene)
            _check_distorted(scene, photos)
            for photo in with_progress(photos, "reading", "photographs"):
                check_pixels(photo)  # COLMAP fills what is missing of a truncated file with gray
            undistort_colmap(scene, photos, folder)
        else:
            _undistort_transforms(files, folder)


def undistort_colmap(scene: Path, photos: Sequence[Photo], out: Path) -> list[Photo]:
    """Undistort a COLMAP scene into ``out/images``, ``out/sparse/0`` and ``out/masks``, if it has masks.

    Parameters
    ----------
    scene : Path
        Folder with ``images/`` and a model.
    photos : sequence of Photo
        Those of the model that have a camera.
    out : Path
        Folder, which must exist.

    Returns
    -------
    list of Photo
        The undistorted ones, as the loader finds them.

    Raises
    ------
    InputError
        If a photograph or a mask cannot be read, or COLMAP has left one out.
    """
    pycolmap = import_quiet_pycolmap()
    with tempfile.TemporaryDirectory(dir=out) as temporary:
        quality = SAVE_OPTIONS["JPEG"]["quality"]
        model = Path(temporary, "model")
        model.mkdir()
        write_model(scene, model)
        with _without_stderr():
            pycolmap.undistort_images(temporary, str(model), str(image_folder(scene)), jpeg_quality=quality)
        (out / "sparse").mkdir()
        shutil.move(Path(temporary, "images"), out / "images")
        shutil.move(Path(temporary, "sparse"), out / "sparse" / "0")
    reading = build_reading(1, None, undistort=True, alpha_is_mask=True)
    for photo in with_progress(photos, "undistorting", "masks"):
        # COLMAP does not write every format that the loader reads (not .webp, not .insp), and gives no error.
        is_missing = not (out / "images" / photo.file).is_file()
        if is_missing or _has_mask(photo):
            view = read_view(photo, photo.file, reading)
            if is_missing:
                _write(out / "images" / photo.file, view.image)
            if view.mask is not None:
                _write(out / "masks" / f"{photo.file}.png", view.mask)
    written = colmap_photos(out)
    missing = sorted({photo.file for photo in photos} - {photo.file for photo in written})
    if missing:
        raise InputError(f"{scene}: COLMAP has not undistorted {', '.join(missing)}; export the model again")
    return written


@contextmanager
def _without_stderr() -> Iterator[None]:
    """Discard what a library prints of files that it cannot write, which are written here."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _has_mask(photo: Photo) -> bool:
    """Return whether a photograph has a mask or transparency, without reading its pixels."""
    with open_image(photo.path) as image:
        return photo.mask_path is not None or image.has_transparency_data


def _undistort_transforms(files: Sequence[Path], folder: Path) -> None:
    """Write images, masks, points and each transforms file, with intrinsics per frame."""
    contents = [read_transforms(file) for file in files]
    pairs = [find_frames(file, content) for file, content in zip(files, contents, strict=True)]
    photos = [photo for of_file in pairs for _, photo in of_file]
    _check_distorted(files[0], photos)
    names = iter(_names_of_copies(files[0], photos))
    for file, content, of_file in zip(files, contents, pairs, strict=True):
        _undistort_frames(file, content, [(frame, photo, next(names)) for frame, photo in of_file], folder)


def _names_of_copies(file: Path, photos: Sequence[Photo]) -> list[Path]:
    """Return the paths of copied photographs: the same if inside the file's folder, and in OUTSIDE if beside it."""
    scene = os.path.abspath(file.parent)
    paths = [Path(os.path.relpath(os.path.abspath(photo.path), scene)) for photo in photos]
    is_outside = [path.parts[0] == ".." for path in paths]
    stems = [
        path.relative_to("..").with_suffix("").as_posix() for path, out in zip(paths, is_outside, strict=True) if out
    ]
    outside = iter(file_names(stems))
    names = [
        Path(OUTSIDE, f"{next(outside)}{path.suffix}") if out else path
        for path, out in zip(paths, is_outside, strict=True)
    ]
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise InputError(f"{file}: {count} frames would be written to {name.as_posix()}; remove or rename all but one")
    return names


def _undistort_frames(
    file: Path, content: Mapping[str, Any], frames: Sequence[tuple[dict[str, Any], Photo, Path]], folder: Path
) -> None:
    """Write the images and masks of one file's frames under their names, its points, and the file."""
    reading = build_reading(1, None, undistort=True, alpha_is_mask=False)
    copies = []
    for frame, photo, name in with_progress(frames, "undistorting", "photographs"):
        view = read_view(photo, photo.file, reading)
        entries = {"file_path": name.as_posix(), **_intrinsics(view.camera)}
        _write(folder / name, view.image)
        if view.mask is not None:
            entries["mask_path"] = Path("masks", f"{name.as_posix()}.png").as_posix()
            _write(folder / entries["mask_path"], view.mask)
        copies.append({key: value for key, value in frame.items() if key not in LENS_KEYS} | entries)
    changes: dict[str, Any] = {"frames": copies}
    points = find_points(file, content)
    if points is not None:
        shutil.copyfile(points, folder / POINTS_FILE)
        changes["ply_file_path"] = POINTS_FILE
    rest = {key: value for key, value in content.items() if key not in LENS_KEYS}
    (folder / file.name).write_text(json.dumps(rest | changes, indent=1), encoding="utf-8")


def _intrinsics(camera: Camera) -> dict[str, Any]:
    """Pinhole entries of a frame."""
    return {
        "camera_model": "PINHOLE",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
    }


def _write(path: Path, image: NDArray) -> None:
    """Write an image, creating its folder if necessary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, image)


def _check_distorted(source: Path, photos: Sequence[Photo]) -> None:
    """Refuse photographs that cannot be read, and scenes that have no distortion."""
    for photo in photos:
        check_photo(photo, source, undistort=True, as_photographed=False)
    if all(photo.lens is None for photo in photos):
        raise InputError(f"{source}: all cameras are pinholes already, nothing to undistort; use the scene as it is")
