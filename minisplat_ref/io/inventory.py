"""The inventory of a scene's folder, with its used and its unused files: one line for ``info``, a warning elsewhere.

A scene loads without a mask whose name does not fit, without photographs that have no camera, and from the first of two
models. Each may be intended, so none is refused; but a user who expects it to be used has to hear that it is not.
"""

import math
import re
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.colmap import find_model, has_model, image_folder, image_names
from minisplat_ref.io.images import BY_PRODUCT, PHOTOGRAPHS, UNREAD_SUFFIXES
from minisplat_ref.io.names import spelled_on_disk
from minisplat_ref.io.ply import color_names
from minisplat_ref.io.ply_file import property_names
from minisplat_ref.io.transforms import (
    BLENDER_POINTS,
    SINGLE_FILE,
    find_image,
    find_points,
    find_transforms,
    read_transforms,
)
from minisplat_ref.types import Camera, Floats, Scene, View

MASK_FOLDERS = re.compile(r"(masks?|segmentations?|mattes?)(_png)?", re.IGNORECASE)
MAPS = re.compile(r"_(depth|normal|disp|alpha|albedo|mask|seg)", re.IGNORECASE)  # r_0_depth_0001.png beside r_0.png
SPLIT_FILES = re.compile(r"(test|train|val|split|train_test_split|train_list|test_list)\.(txt|json|csv)", re.IGNORECASE)
SPLIT_KEYS = ("train_filenames", "val_filenames", "test_filenames")
FRAME_KEYS = ("depth_file_path", "normal_file_path", "semantic_path")
OTHER_SETS = ("transforms_val.json", "transforms_test.json", "transforms_train.json")
CLOUDS = (*BLENDER_POINTS, "sparse_pc.ply", "pointcloud.ply", "point_cloud.ply", "points.ply")
FOCAL_TOLERANCE, PLACE_TOLERANCE = 0.005, 0.02  # relative; two calibrations of the same photographs differ by less


class Inventory(NamedTuple):
    """The findings about a folder."""

    used: str
    """The number of photographs that have cameras."""
    unused: tuple[str, ...]
    """Files that are not used, half a sentence each."""

    @property
    def line(self) -> str:
        """All of it."""
        return "; ".join([self.used, *self.unused])


def take_inventory(path: Path, scene: Scene, model: str | None = None) -> Inventory:
    """Compare the folder of a scene with the scene that was loaded from it.

    Parameters
    ----------
    path : Path
        What the scene was loaded from.
    scene : Scene
        In the frame of its files or another.
    model : str, optional
        The requested model.
    """
    folder = find_model(path, model)
    if folder is not None:
        return _take_from_colmap(path, folder, scene)
    return _take_from_transforms(path) if find_transforms(path) else _take_from_llff(path, scene)


def warn_of_unused(path: Path, scene: Scene, model: str | None = None) -> Inventory:
    """Warn of files in a scene's folder that are not used, in one line; arguments as for :func:`take_inventory`."""
    inventory = take_inventory(path, scene, model)
    if inventory.unused:
        warnings.warn(one_line(f"{path}: {inventory.line}"), InputWarning, stacklevel=3)
    return inventory


def _take_from_colmap(path: Path, model: Path, scene: Scene) -> Inventory:
    names = image_names(model)
    folder = image_folder(path)
    photographs = _list_images(folder)
    names = {spelled_on_disk(folder, name) for name in names}
    n_placed = len(photographs & names)
    used = f"{n_placed} of {len(photographs)} photographs have cameras"
    unused = [
        *_unused_masks(path, names),
        *_other_models(path, model, len(names)),
        *_own_splits((path, model)),
        *_disagreement(path, model, names, scene),
    ]
    others = [*_without_camera(sorted(photographs - names)), *_unread(folder, photographs)]
    return Inventory(used, (*others, *unused))


def _without_camera(names: Sequence[str]) -> list[str]:
    return [f"without a camera: {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}"] if names else []


def _unread(folder: Path, photographs: Iterable[str]) -> list[str]:
    """Name photographs of formats that are not read, but for those that are there in another format, too."""
    stems = {Path(name).with_suffix("").as_posix() for name in photographs}
    unread = _list_images(folder, UNREAD_SUFFIXES)
    names = sorted(name for name in unread if Path(name).with_suffix("").as_posix() not in stems)
    more = ", ..." if len(names) > 3 else ""
    return [f"of formats that are not read: {', '.join(names[:3])}{more}"] if names else []


def _list_images(folder: Path, suffixes: Collection[str] = PHOTOGRAPHS) -> set[str]:
    """Return the image files in a folder and below, by their names relative to it; hidden ones do not count."""
    if not folder.is_dir():
        return set()
    paths = (file.relative_to(folder) for file in folder.rglob("*") if file.suffix.lower() in suffixes)
    return {path.as_posix() for path in paths if not any(map(BY_PRODUCT.fullmatch, path.parts))}


def _unused_masks(path: Path, names: Iterable[str]) -> list[str]:
    """Report for each folder of masks how many of its files are masks of photographs, unless all are."""
    said = []
    fitting = {form.casefold() for name in names for form in (f"{name}.png", Path(name).with_suffix(".png").as_posix())}
    for folder in _folders(path):
        files = _list_images(folder) if MASK_FOLDERS.fullmatch(folder.name) else set()
        n_fit = sum(file.casefold() in fitting for file in files) if folder.name == "masks" else 0
        if n_fit < len(files):
            example = sorted(names)[0]
            said.append(
                f"{folder.name}/ has {len(files)} files, {n_fit} fit: a mask of {example} is masks/{example}.png or"
                f" masks/{Path(example).with_suffix('.png').as_posix()}"
            )
    return said


def _folders(path: Path) -> list[Path]:
    return sorted(folder for folder in path.iterdir() if folder.is_dir()) if path.is_dir() else []


def _other_models(path: Path, model: Path, n_images: int) -> list[str]:
    """Name other models, with advice if one has more images than the one that is used."""
    said = []
    ours = model.relative_to(path).as_posix()
    for folder in (path / "sparse", *_folders(path / "sparse")):
        if folder != model and has_model(folder):
            name, n = folder.relative_to(path).as_posix(), len(image_names(folder))
            way_out = f": give --model {name}" if n > n_images else ""
            said.append(f"{name} has {n} images, {ours} has {n_images}{way_out}")
    return said


def _own_splits(folders: Iterable[Path]) -> list[str]:
    """Name files that list the photographs for testing."""
    files = sorted(
        file.name
        for folder in folders
        if folder.is_dir()
        for file in folder.iterdir()
        if file.is_file() and SPLIT_FILES.fullmatch(file.name)
    )
    return [f"the split of {', '.join(files)} is not used, test views are every K-th (--test-every)"] if files else []


def _disagreement(path: Path, model: Path, names: Iterable[str], scene: Scene) -> list[str]:
    """Describe how the cameras of a transforms.json beside a model differ from the model's."""
    files = find_transforms(path)
    if not files:
        return []
    ours, theirs = model.relative_to(path).as_posix(), files[0].name
    try:
        transforms = read_transforms(files[0])
    except InputError:
        return [f"{theirs} is not used, and cannot be read"]
    frames = {Path(str(frame["file_path"])).stem: frame for frame in transforms["frames"]}
    n = len({Path(name).stem for name in names})
    if len(frames) != n:
        return [f"{theirs} lists {len(frames)} images, {ours} has {n} and is used"]
    views = {view.name: view for view in (*scene.train_views, *scene.test_views)}
    common = [name for name in frames if name in views]
    parts = [part for part in _differences(transforms, frames, views, common) if part]
    return [f"{theirs} differs from {ours}, which is used: {', '.join(parts)}"] if parts else []


def _differences(
    transforms: Mapping[str, Any],
    frames: Mapping[str, Mapping[str, Any]],
    views: Mapping[str, View],
    common: Sequence[str],
) -> Iterable[str]:
    """Yield the differences between the frames of a file and the views of the same names."""
    if not common:
        yield "other images"
        return
    focals = [_focal_share({**transforms, **frames[name]}, views[name].camera) for name in common]
    if max(abs(share - 1.0) for share in focals) > FOCAL_TOLERANCE:
        share = max(focals, key=lambda share: abs(share - 1.0))
        yield f"focal lengths are {share:.3g} times as long"
    theirs = np.array([np.array(frames[name]["transform_matrix"], np.float64)[:3, 3] for name in common])
    deviation = _deviation(np.array([views[name].camera.center for name in common]), theirs)
    if deviation > PLACE_TOLERANCE:
        yield f"cameras stand elsewhere, by {deviation:.0%} of their extent"


def _focal_share(frame: Mapping[str, Any], camera: Camera) -> float:
    """Return the ratio of a frame's focal length to the model's, 1 where it has none; both as fractions of a width.

    The photographs of the two may have other sizes.
    """
    ours = camera.fx / camera.width
    try:
        if "fl_x" in frame and float(frame["w"]) > 0:
            return float(frame["fl_x"]) / float(frame["w"]) / ours
        if "camera_angle_x" in frame:
            return 0.5 / math.tan(0.5 * float(frame["camera_angle_x"])) / ours
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        pass
    return 1.0


def _deviation(places: Floats, others: Floats) -> float:
    """Return the largest difference of distances between places [V, 3], as a part of the mean distance of each set."""

    def distances(points: Floats) -> Floats:
        between = np.linalg.norm(points[:, None] - points[None], axis=2)  # [V, V]
        return between / max(float(np.sqrt((between**2).mean())), np.finfo(np.float64).tiny)

    return float(np.abs(distances(places) - distances(others)).max())


def _take_from_transforms(path: Path) -> Inventory:
    files = find_transforms(path)
    folder = files[0].parent
    sets = [read_transforms(file) for file in files]
    frames = [frame for transforms in sets for frame in transforms["frames"]]
    stems = {_stem(folder, frame) for frame in frames}
    masks = {(folder / frame["mask_path"]).as_posix() for frame in frames if isinstance(frame.get("mask_path"), str)}
    photographs = set()
    for parent in sorted({Path(stem).parent for stem in stems}):
        for file in parent.iterdir() if parent.is_dir() else ():
            if file.suffix.lower() in PHOTOGRAPHS and not file.name.startswith(".") and file.as_posix() not in masks:
                photographs.add(file.with_suffix("").as_posix())
    photographs = {stem for stem in photographs if stem in stems or not MAPS.search(Path(stem).name)}
    used = f"{len(photographs & stems)} of {len(photographs)} photographs have cameras"
    missing = [Path(stem).name for stem in sorted(photographs - stems)]
    unused = [
        *_without_camera(missing),
        *_unnamed_masks(folder, masks),
        *_list_splits(files, sets, stems),
        *_list_clouds(files[0], sets[0]),
        *(f"{key} of {n} frames is not used" for key in FRAME_KEYS if (n := sum(key in frame for frame in frames))),
    ]
    return Inventory(used, tuple(unused))


def _take_from_llff(path: Path, scene: Scene) -> Inventory:
    """All photographs have cameras, by their order; masks and other files have no place in that format."""
    n_views = len(scene.train_views) + len(scene.test_views)
    masks = [
        f"{folder.name}/ has {len(_list_images(folder))} files, 0 fit: masks are those of other kinds of scenes"
        for folder in _folders(path)
        if MASK_FOLDERS.fullmatch(folder.name)
    ]
    return Inventory(f"{n_views} of {n_views} photographs have cameras", tuple(masks))


def _unnamed_masks(folder: Path, masks: set[str]) -> list[str]:
    """Report for each folder of masks how many of its files the frames name, unless all are named."""
    said = []
    for place in _folders(folder):
        files = _list_images(place) if MASK_FOLDERS.fullmatch(place.name) else set()
        n_fit = sum((place / file).as_posix() in masks for file in files)
        if n_fit < len(files):
            said.append(f"{place.name}/ has {len(files)} files, {n_fit} fit: a frame names its mask as mask_path")
    return said


def _list_splits(files: Sequence[Path], sets: Sequence[Mapping[str, Any]], stems: set[str]) -> list[str]:
    """Return sentences about the splits of the photographs that are not used."""
    folder = files[0].parent
    said = [
        f"{key} of {files[0].name} ({len(sets[0][key])}) is not used, test views are every K-th (--test-every)"
        for key in SPLIT_KEYS
        if isinstance(sets[0].get(key), list)
    ]
    for name in OTHER_SETS:
        if (folder / name).is_file() and folder / name not in files:
            n_others = _count_others(folder / name, stems)
            said += [f"{name} is not used, {n_others} of its images are in no other file"] if n_others else []
    return [*said, *_own_splits([folder])]


def _count_others(file: Path, stems: set[str]) -> int:
    """Return the number of frames of a file whose images others do not list; 0 if it is no such file."""
    try:
        frames = read_transforms(file)["frames"]
    except InputError:
        return 0
    return sum(_stem(file.parent, frame) not in stems for frame in frames)


def _stem(folder: Path, frame: Mapping[str, Any]) -> str:
    """Return the path of a frame's image without its suffix."""
    try:
        path = find_image(folder / SINGLE_FILE, frame["file_path"]) or folder / frame["file_path"]
    except InputError:  # a name that leads elsewhere is no photograph of the scene
        path = folder / frame["file_path"]
    return (path.with_suffix("") if path.suffix.lower() in PHOTOGRAPHS else path).as_posix()


def _list_clouds(file: Path, transforms: Mapping[str, Any]) -> list[str]:
    """Report point clouds that lack colours or are not referenced."""
    points = find_points(file, transforms)
    if points is None:
        there = [name for name in CLOUDS if (file.parent / name).is_file()]
        return [f"{there[0]} is not used: name it as ply_file_path in {file.name}"] if there else []
    names = property_names(points)
    if color_names(names) is not None:
        return []
    others = ", ".join(name for name in names if name not in ("x", "y", "z", "nx", "ny", "nz"))
    return [f"{points.name} has no red, green, blue{f', but {others}' if others else ''}: its points are gray"]
