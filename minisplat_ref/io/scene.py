"""From photographs with cameras to a :class:`Scene`: the common part of the readers of COLMAP and transforms.json.

Pixels are read, masked, composited, undistorted and downscaled here, and everything that makes a scene unusable is
detected here. All photographs are kept in memory as uint8 if they take a moderate part of it; if they would take more,
only sizes are checked here, and pixels are read on demand (:mod:`minisplat_ref.io.stored_views`).
"""

import math
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref import memory
from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.empty_masks import TRAIN_VIEWS_MIN, MaskFiles, find_empty, report_empty
from minisplat_ref.io.images import (
    MASK_THRESHOLD,
    check_n_pixels,
    composite_alpha,
    downscaled_size,
    flat_size,
    is_turned,
    mask_areas,
    read_image,
    read_mask,
    resize_image,
    resize_mask,
)
from minisplat_ref.io.lens import Lens, lens_optics, undistort, undistorted_pinhole
from minisplat_ref.io.names import is_file, with_any_suffix
from minisplat_ref.io.stored_views import Photograph, Pixels, Shelf, StoredView
from minisplat_ref.types import Bools, Camera, Floats, Ints, Scene, View, number_views

TEST_EVERY = 8  # of the photographs one is a test view where nothing else is asked for, as in the 3DGS code
EXTENT_MARGIN = 1.1  # the 3DGS code's factor on the radius of the cameras; the learning rates were tuned with it
COORDINATE_MAX = 1e18  # world units or pixels; the square of more would overflow float32
DARK = 64  # of 255: a scene whose brightest pixel is below is stored in the wrong range; 14 bits of 16 reach 63
ROTATION_TOLERANCE = 1e-3  # greatest error of R R^T = I: poses written with four digits pass, scaled ones do not


class Photo(NamedTuple):
    """A photograph before its pixels are read."""

    folder: Path
    """Folder of images, the one that has a sibling ``<folder>_D`` when downscaled images are ready."""
    file: str
    """Path inside the folder, with suffix."""
    mask_path: Path | None
    """Its mask file, if it has one."""
    camera: Camera
    """Pose, intrinsics and size at full resolution; the pinhole part of the lens."""
    lens: Lens | None
    """None for a pinhole."""
    point_ids: Ints | None = None
    """As :attr:`View.point_ids`."""
    time: float = 0.0
    """As :attr:`View.time`."""

    @property
    def path(self) -> Path:
        """Return the image file at full resolution."""
        return self.folder / self.file


class Listing(NamedTuple):
    """A scene before its photographs are read."""

    source: Path
    """The path that the user gave; errors name it, and its folder names the scene."""
    train_photos: Sequence[Photo]
    test_photos: Sequence[Photo]
    names: Sequence[str]
    """Of the views, those of training first."""
    points: Floats
    """[P, 3] world frame."""
    point_colors: NDArray[np.uint8]
    """[P, 3]"""
    alpha_is_mask: bool
    """As :attr:`Reading.alpha_is_mask`, which the format of the scene decides."""
    random_box: Floats | None = None
    """As :attr:`minisplat_ref.types.Scene.random_box`."""


class Reading(NamedTuple):
    """Options for making views of photographs."""

    downscale: int
    """Divide the image size by this; ``<folder>_D`` is used where it exists."""
    background: Floats
    """[3] in [0, 1]."""
    undistort: bool
    """Warp photographs of other lenses to a pinhole; False refuses them, unless they are read as photographed."""
    alpha_is_mask: bool
    """An alpha channel masks the loss; False composites it onto the background."""
    as_photographed: bool = False
    """Leave photographs of other lenses as they are, and describe the lens by the camera's ``optics``."""


def build_reading(
    downscale: int,
    background: Sequence[float] | Floats | None,
    undistort: bool,
    alpha_is_mask: bool,
    as_photographed: bool = False,
) -> Reading:
    """Check the arguments that all loaders share."""
    if downscale < 1 or downscale != int(downscale):
        raise InputError(f"downscale is {downscale}; it must be a whole number of at least 1")
    color = np.zeros(3) if background is None else np.asarray(background, np.float64)
    if color.shape != (3,) or not np.all((color >= 0) & (color <= 1)):
        raise InputError(f"background is {background}; it must be three numbers in [0, 1]")
    if undistort and as_photographed:
        raise InputError("photographs are either undistorted or read as they are: leave out one of the two")
    return Reading(int(downscale), color, undistort, alpha_is_mask, as_photographed)


def split_photos(photos: Sequence[Photo], test_every: int, offset: int = 0) -> tuple[list[Photo], list[Photo]]:
    """Sort by file name and hold out every ``test_every``-th, beginning with number ``offset``; 0 holds out none."""
    if test_every < 0:
        raise InputError(f"test_every is {test_every}; it must be 0 (no test views) or positive")
    if not 0 <= offset < max(test_every, 1):
        raise InputError(f"offset is {offset}; the first held-out photograph is one of the first {test_every}, from 0")
    ordered = sorted(photos, key=lambda photo: photo.path.as_posix())
    is_test = [test_every > 0 and i % test_every == offset for i in range(len(ordered))]
    train = [photo for photo, held_out in zip(ordered, is_test, strict=True) if not held_out]
    return train, [photo for photo, held_out in zip(ordered, is_test, strict=True) if held_out]


def make_listing(
    source: Path,
    train_photos: Sequence[Photo],
    test_photos: Sequence[Photo],
    points: Floats,
    point_colors: NDArray[np.uint8],
    *,
    alpha_is_mask: bool,
) -> Listing:
    """Name the views; raise an InputError if two photographs have one name."""
    names = _view_names((*train_photos, *test_photos), source)
    return Listing(source, train_photos, test_photos, names, points, point_colors, alpha_is_mask)


def build_scene(listing: Listing, reading: Reading) -> Scene:
    """Build the scene, with all pixels in memory if they take a moderate part of it.

    Parameters
    ----------
    listing : Listing
        Of at least two training photographs.
    reading : Reading
        Options for making views of photographs.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        If there are too few views, a camera is not usable, or an image is missing or does not fit its camera.
    """
    source, train_photos, test_photos, names, points, point_colors, _, random_box = listing
    photos = (*train_photos, *test_photos)
    if len(train_photos) < TRAIN_VIEWS_MIN:
        raise InputError(
            f"{source}: {len(train_photos)} training and {len(test_photos)} test view(s), training needs at least"
            f" {TRAIN_VIEWS_MIN}; add photographs or hold out fewer"
        )
    for photo in photos:
        check_photo(photo, source, undistort=reading.undistort, as_photographed=reading.as_photographed)
    _check_points(points, source)
    memory.check_photograph(source, max(_n_pixels(photo) for photo in photos), reading.downscale)
    _check_places(source, [photo.camera for photo in train_photos])
    shelf_bytes = memory.shelf_bytes(sum(map(_n_bytes, photos)) / reading.downscale**2)
    if shelf_bytes is None:
        views = tuple(read_view(photo, name, reading) for photo, name in _show_progress(photos, names))
    else:
        shelf = Shelf(shelf_bytes)
        views = tuple(make_stored_view(photo, name, reading, shelf) for photo, name in _show_progress(photos, names))
    files = [MaskFiles(_path(photo, reading), photo.mask_path, reading.alpha_is_mask) for photo in photos]
    empty = find_empty(views, files)
    report_empty(source, views, files, empty, len(train_photos))
    train_views = [view for i, view in enumerate(views[: len(train_photos)]) if i not in empty]
    test_views = tuple(view for i, view in enumerate(views) if i >= len(train_photos) and i not in empty)
    cameras = [view.camera for view in train_views]
    _check_places(source, cameras)
    _warn_of_darkness(source, views)
    folder = source if source.is_dir() else source.parent
    return Scene(
        name=folder.resolve().name,
        train_views=number_views(train_views),
        test_views=test_views,
        points=points,
        point_colors=point_colors,
        background=reading.background,
        extent=camera_extent(cameras),
        random_box=random_box,
    )


def _check_places(source: Path, cameras: Sequence[Camera]) -> None:
    """Refuse training cameras that are all at one point."""
    if camera_extent(cameras) == 0.0:
        raise InputError(f"{source}: all training cameras stand at one point, which shows no depth; move between shots")


def _warn_of_darkness(source: Path, views: Sequence[View]) -> None:
    """Warn of photographs in memory that are all almost black: usually of 10 to 14 bits in files of 16."""
    if any(isinstance(view, StoredView) for view in views):
        return
    brightest = max(view.image.max() for view in views)
    if brightest < DARK:
        message = (
            f"{source}: the photographs are almost black, the brightest value is {brightest} of 255; if files of"
            " 16 bits hold fewer, scale the values so that white is 65535"
        )
        warnings.warn(one_line(message), InputWarning, stacklevel=2)


def _show_progress(photos: Sequence[Photo], names: Sequence[str]) -> Iterable[tuple[Photo, str]]:
    """Return photographs with their names, with a progress bar if reading takes a while."""
    pairs = list(zip(photos, names, strict=True))
    return with_progress(pairs, "reading", "photographs")


def _n_pixels(photo: Photo) -> int:
    return photo.camera.width * photo.camera.height


def _n_bytes(photo: Photo) -> int:
    """Return the bytes of its pixels and its mask at full resolution."""
    return (3 + (photo.mask_path is not None)) * _n_pixels(photo)


def check_photo(photo: Photo, source: Path, *, undistort: bool, as_photographed: bool) -> None:
    """Raise an InputError for a photograph that cannot become a view, by the arguments of :class:`Reading`."""
    camera = photo.camera
    intrinsics = np.array(camera[2:8], np.float64)
    is_small = np.abs(intrinsics).max() <= COORDINATE_MAX  # False for NaN
    if not is_small or min(camera.fx, camera.fy, camera.width, camera.height) <= 0:
        raise InputError(
            f"{source}: the camera of {photo.file} is not usable (fx, fy, cx, cy, width, height are"
            f" {', '.join(f'{value:g}' for value in intrinsics)}); repair or remove that image"
        )
    check_n_pixels(f"{source}: the camera of {photo.file}", camera.width, camera.height)
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    with np.errstate(over="ignore", invalid="ignore"):
        is_rotation = np.abs(R @ R.T - np.eye(3)).max() <= ROTATION_TOLERANCE and np.linalg.det(R) > 0  # False for NaN
    if not is_rotation or not np.abs(t).max() <= COORDINATE_MAX:
        raise InputError(f"{source}: the pose of {photo.file} is not a rotation and a translation; repair or remove it")
    if photo.lens is not None and photo.lens.is_parallel and not as_photographed:
        raise InputError(
            f"{source}: the rays of {photo.file} are parallel (camera model {photo.lens.model}), of which no pinhole is"
            " made: train with --recipe satellite"
        )
    if photo.lens is not None and not (undistort or as_photographed):
        raise InputError(
            f"{source}: {photo.file} has lens distortion (camera model {photo.lens.model}), only pinholes are rendered;"
            f" run `minisplat-ref undistort {source} --out DIR`, or train with --undistort (undistort=True in Python),"
            " or as photographed with --recipe lens"
        )
    if photo.lens is not None and not np.isfinite(photo.lens.params).all():
        raise InputError(
            f"{source}: the lens of {photo.file} has coefficients that are not finite; repair or remove it"
        )
    if not is_file(photo.path):
        raise InputError(f"{photo.path}: missing, but {source} has a camera for it; add the image or remove its camera")


def _check_points(points: Floats, source: Path) -> None:
    """Refuse sparse points that are not finite, or so far away that float32 cannot hold their distances."""
    is_bad = ~(np.abs(points) <= COORDINATE_MAX).all(axis=1)  # [P], True for NaN
    if is_bad.any():
        raise InputError(
            f"{source}: {is_bad.sum()} of {len(points)} sparse points are not finite or beyond {COORDINATE_MAX:g},"
            f" first {points[is_bad][0].tolist()}; remove them or export the scene again"
        )


def camera_extent(cameras: Sequence[Camera]) -> float:
    """Return 1.1 x the largest distance of a camera centre from the mean centre, world units.

    Parallel rays say nothing of the place that they come from. There it is half the diagonal of the largest image.
    """
    if all(camera.optics is not None and camera.optics.is_parallel for camera in cameras):
        return max(math.hypot(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras) / 2
    centers = np.stack([camera.center for camera in cameras])  # [V, 3]
    return EXTENT_MARGIN * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


def read_view(photo: Photo, name: str, reading: Reading) -> View:
    """Return the view of a photograph with its pixels."""
    camera = _camera(photo, reading)  # before reading pixels, because a damaged file can claim any number of them
    image, mask = _read_pixels(photo, reading, camera)
    return View(name, camera, image, mask, photo.point_ids, time=photo.time)


def check_pixels(photo: Photo) -> None:
    """Raise an InputError for a photograph that cannot be decoded to its end, or has not its camera's size."""
    _camera(photo, build_reading(1, None, undistort=False, alpha_is_mask=True, as_photographed=True))
    read_image(photo.path)


def make_stored_view(photo: Photo, name: str, reading: Reading, shelf: Shelf) -> View:
    """Return the view of a photograph whose pixels are read on demand; now only the file's size is read."""
    camera = _camera(photo, reading)
    read = partial(_read_again, photo, reading, camera, _signature(photo, reading))
    n_pixels = _n_pixels(photo) if _path(photo, reading) == photo.path else camera.width * camera.height
    photograph: Any = Photograph(read, n_pixels, shelf)
    return StoredView(name, camera, photograph, None, photo.point_ids, time=photo.time)


def _path(photo: Photo, reading: Reading) -> Path:
    """Return the file to read: a downscaled image if there is one, except with a lens, which needs the full size."""
    small_folder = photo.folder.with_name(f"{photo.folder.name}_{reading.downscale}")
    is_small = reading.downscale > 1 and photo.lens is None and small_folder.is_dir()
    return small_folder / with_any_suffix(small_folder, photo.file) if is_small else photo.path


def _camera(photo: Photo, reading: Reading) -> Camera:
    """Return the view's camera, undistorted and downscaled; refuse a file whose size is not that of its camera."""
    camera, path = photo.camera, _path(photo, reading)
    width, height = flat_size(path)
    if path != photo.path:
        _check_downscaled(photo, width, height, reading.downscale)
        return rescale_camera(camera, width, height)
    if (width, height) != (camera.width, camera.height):
        raise InputError(_wrong_size(photo, path, width, height))
    if photo.lens is not None and reading.as_photographed:
        camera = camera._replace(optics=lens_optics(photo.lens, path))
    elif photo.lens is not None:
        camera = undistorted_pinhole(camera, photo.lens)
    return rescale_camera(camera, *downscaled_size(camera.width, camera.height, reading.downscale))


def _read_pixels(photo: Photo, reading: Reading, camera: Camera) -> Pixels:
    """Read one photograph for the camera of its view: alpha, mask, undistortion, downscaling, in this order."""
    image = read_image(_path(photo, reading))  # [H, W, 3 or 4]
    image, mask = _apply_alpha_and_mask(image, photo, reading)
    if photo.lens is not None and not reading.as_photographed:
        image, mask, _ = undistort(image, mask, photo.camera, photo.lens)
    return _resize(Pixels(image, mask), camera.width, camera.height)


def _read_again(photo: Photo, reading: Reading, camera: Camera, signature: list[tuple[int, int] | None]) -> Pixels:
    """Read one photograph, perhaps long after its scene was loaded, and check that its files have not changed."""
    now = _signature(photo, reading)
    try:
        if None not in now and now != signature:
            raise InputError(f"{_path(photo, reading)}: has changed since its scene was loaded")
        return _read_pixels(photo, reading, camera)
    except InputError as error:
        raise InputError(
            f"{error} (photographs that do not all fit into memory are read again and again: leave them as they are)"
        ) from error


def _signature(photo: Photo, reading: Reading) -> list[tuple[int, int] | None]:
    """Return modification time and size of a photograph's files, None for a missing file."""
    paths = [_path(photo, reading), *([] if photo.mask_path is None else [photo.mask_path])]
    stats = [path.stat() if is_file(path) else None for path in paths]
    return [None if stat is None else (stat.st_mtime_ns, stat.st_size) for stat in stats]


def half_size(view: View) -> View:
    """Return the view at half the width and height, rounded, with matching intrinsics.

    If a mask is so fine that no pixel would be left, the pixels that are mostly white stay.
    """
    width, height = downscaled_size(view.camera.width, view.camera.height, 2)
    camera = rescale_camera(view.camera, width, height)
    if isinstance(view, StoredView):
        return view.change(partial(_halve, width=width, height=height))._replace(camera=camera)
    image, mask = _halve(Pixels(view.image, view.mask), width, height)
    return view._replace(camera=camera, image=image, mask=mask)


def _resize(pixels: Pixels, width: int, height: int) -> Pixels:
    """Return a photograph and its mask at another size."""
    image, mask = pixels
    if image.shape[:2] == (height, width):
        return pixels
    return Pixels(resize_image(image, width, height), None if mask is None else resize_mask(mask, width, height))


def _halve(pixels: Pixels, width: int, height: int) -> Pixels:
    """Return a photograph and its mask at half their size; of the mask something is left."""
    halved = _resize(pixels, width, height)
    if pixels.mask is None or halved.mask is None or halved.mask.any() or not pixels.mask.any():
        return halved
    areas = mask_areas(pixels.mask, width, height)
    return halved._replace(mask=areas == areas.max())


def rescale_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of the same view at another size; ratios are exact, as the image's corner is the origin."""
    ratio_x, ratio_y = width / camera.width, height / camera.height
    return camera._replace(
        fx=camera.fx * ratio_x,
        fy=camera.fy * ratio_y,
        cx=camera.cx * ratio_x,
        cy=camera.cy * ratio_y,
        width=width,
        height=height,
    )


def _apply_alpha_and_mask(
    image: NDArray[np.uint8], photo: Photo, reading: Reading
) -> tuple[NDArray[np.uint8], Bools | None]:
    """Return RGB image and mask at the image's size, from its alpha channel and its mask file."""
    height, width = image.shape[:2]
    mask = None if photo.mask_path is None else read_mask(photo.mask_path)
    if mask is not None and mask.shape not in ((height, width), (photo.camera.height, photo.camera.width)):
        raise InputError(
            f"{photo.mask_path}: the mask is {mask.shape[1]}x{mask.shape[0]} but its image {photo.file} is"
            f" {photo.camera.width}x{photo.camera.height}; resize or remove the mask"
        )
    if mask is not None:
        mask = resize_mask(mask, width, height)
    if image.shape[2] == 3:
        return image, mask
    if not reading.alpha_is_mask:
        return composite_alpha(image, reading.background), mask
    opaque = image[..., 3] >= MASK_THRESHOLD
    return np.ascontiguousarray(image[..., :3]), opaque if mask is None else opaque & mask


def _wrong_size(photo: Photo, path: Path, width: int, height: int) -> str:
    """Return advice for an image [height, width] whose size is not its camera's."""
    camera = photo.camera
    problem = f"{path}: the image is {width}x{height} but its camera is {camera.width}x{camera.height}"
    if (height, width) == (camera.width, camera.height) and is_turned(path):
        return (
            f"{problem}, because its EXIF data ask to turn it and the camera is of the turned image; turn the pixels"
            " themselves, for example with `mogrify -auto-orient` of ImageMagick, or make the scene with"
            " `minisplat-ref sfm`, which does"
        )
    return (
        f"{problem}; put the full-size image there (smaller ones belong in {photo.folder.name}_D and are read with"
        " --downscale D, downscale=D in Python)"
    )


def _check_downscaled(photo: Photo, width: int, height: int, downscale: int) -> None:
    """Refuse a ready-made downscaled image whose size differs by more than rounding."""
    exact_width, exact_height = photo.camera.width / downscale, photo.camera.height / downscale
    if abs(width - exact_width) >= 1 or abs(height - exact_height) >= 1:
        small_folder = f"{photo.folder}_{downscale}"
        raise InputError(
            f"{small_folder}/{photo.file}: the image is {width}x{height} but 1/{downscale} of its camera is"
            f" {exact_width:g}x{exact_height:g}; remove {small_folder} and run"
            f" `minisplat-ref downscale {photo.folder} --downscale {downscale}`"
        )


def _view_names(photos: Sequence[Photo], source: Path) -> list[str]:
    """Return file names without suffix, with their folders if they are not unique (train/r_0 and test/r_0)."""
    files = [Path(photo.folder.name, photo.file).with_suffix("") for photo in photos]
    names = [file.name for file in files]
    if len(set(names)) < len(names):
        names = ["_".join(file.parts) for file in files]
    for name, count in Counter(names).most_common(1):
        if count > 1:
            raise InputError(f"{source}: {count} images are called {name}; give each its own name, suffix aside")
    return names
