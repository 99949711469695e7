"""Scenes that COLMAP has calibrated: ``images/`` with ``sparse/0/`` or ``sparse/``, binary or text, read by pycolmap.

Poses follow COLMAP's convention, which is also ours: cam_from_world, OpenCV axes, the centre of the top-left pixel at
(0.5, 0.5). Masks are where COLMAP looks for them (``masks/<file>.png``, as in ``0001.jpg.png``) or at
``masks/<name>.png``. An alpha channel is a mask too. A point's track lists the views that see it. Left out: 2D
features (:mod:`.colmap_light`), and images that COLMAP could not register.
"""

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.colmap_light import without_features
from minisplat_ref.io.colmap_records import LAYOUTS, check_records, read_records
from minisplat_ref.io.colmap_text import readable, text_lines, text_names
from minisplat_ref.io.lens import PINHOLE_MODELS, POLYNOMIAL_MODELS, Lens, import_pycolmap
from minisplat_ref.io.names import name_inside, spelled_on_disk
from minisplat_ref.io.ply import NO_POINTS, PointCloud, load_points
from minisplat_ref.io.scene import TEST_EVERY, Listing, Photo, build_reading, build_scene, make_listing, split_photos
from minisplat_ref.types import Camera, Floats, Ints, Scene

MODEL_FOLDERS = ("sparse/0", "sparse")
OTHER_MODEL_FOLDERS = ("colmap/sparse/0", "distorted/sparse/0", "")
"""Of ns-process-data, of 3DGS's convert.py before it undistorts, and a model alone; a transforms.json comes before."""
TRANSFORMS = ("transforms_train.json", "transforms.json")
IMAGE_FOLDERS = ("images", "input")
POINTS_PLY = "points3D.ply"  # which 3DGS and its viewers write beside the model's points
N_IMAGES = re.compile(r"# Number of images: (\d+)")  # in a model as text


# Errors of pycolmap for damaged files: from its own checks, and when it takes garbage for an id or a count.
DAMAGE_ERRORS = (ValueError, IndexError, OverflowError, RuntimeError, MemoryError, OSError)


class LightModel(NamedTuple):
    """A model without its 2D features."""

    reconstruction: Any
    """A ``pycolmap.Reconstruction``, whose points have no tracks."""
    seen: Mapping[int, Ints] | None
    """Of :func:`.colmap_light.without_features`."""


def load_colmap(
    path: str | Path,
    *,
    downscale: int = 1,
    test_every: int = TEST_EVERY,
    background: Sequence[float] | Floats | None = None,
    undistort: bool = False,
    as_photographed: bool = False,
    model: str | None = None,
) -> Scene:
    """Load a COLMAP scene.

    Parameters
    ----------
    path : str or Path
        Folder with ``images/`` and ``sparse/0/`` or ``sparse/``.
    downscale : int
        Divide the image size by this. ``images_<downscale>/`` is used where it exists, otherwise images are resized
        to the rounded size; intrinsics scale by the exact ratio either way.
    test_every : int
        Of the images sorted by name, every ``test_every``-th is a test view, beginning with the first; 0 for none.
    background : array_like of shape (3,), optional
        Colour behind everything, in [0, 1]; black by default.
    undistort : bool
        Warp images of other camera models to a pinhole, instead of refusing them.
    as_photographed : bool
        Leave them as they are, with cameras that have ``optics``.
    model : str, optional
        Folder of the model, relative to ``path``, where there are several; the first of those above by default.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        If a file is missing or damaged, a camera model is distorted, or an image does not fit its camera.
    """
    from minisplat_ref.io.inventory import warn_of_unused  # which reads both kinds of scenes

    reading = build_reading(downscale, background, undistort, True, as_photographed)
    scene = build_scene(list_colmap(Path(path), test_every, model), reading)
    warn_of_unused(Path(path), scene, model)
    return scene


def list_colmap(path: Path, test_every: int, model: str | None = None, offset: int = 0) -> Listing:
    """Return all that :func:`load_colmap` reads but the photographs; ``offset`` as for :func:`split_photos`."""
    light = _read_light(_model_folder(path, model))
    train_photos, test_photos = split_photos(_photos(path, light), test_every, offset)
    points, colors = _points(light.reconstruction)
    if not len(points):
        points, colors = _points_beside(path, find_model(path, model))
    return make_listing(path, train_photos, test_photos, points, colors, alpha_is_mask=True)


def has_model(folder: Path) -> bool:
    """Return whether a folder holds a COLMAP model."""
    return (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file()


def find_model(path: Path, name: str | None = None) -> Path | None:
    """Return the folder of the COLMAP model of a scene, None if it has none.

    Parameters
    ----------
    path : Path
        The scene.
    name : str, optional
        Which model, relative to the scene; by default the first that is there.

    Raises
    ------
    InputError
        There is no such model.
    """
    if name is not None:
        if not has_model(path / name):
            found = sorted(f.relative_to(path).as_posix() for f in (path / "sparse").rglob("*") if has_model(f))
            raise InputError(
                f"{path / name}: no COLMAP model, neither cameras.bin nor cameras.txt; --model takes a folder relative"
                f" to the scene{f', such as {found[0]}' if found else ''}"
            )
        return path / name
    folders = [path / folder for folder in MODEL_FOLDERS]
    if not any((path / name).is_file() for name in TRANSFORMS):
        folders += [path / folder for folder in OTHER_MODEL_FOLDERS]
    return next((folder for folder in folders if has_model(folder)), None)


def image_folder(path: Path) -> Path:
    """Return the folder of the photographs of a scene; beside or above the model if that is all that is given.

    Raises
    ------
    InputError
        There is none.
    """
    places = [path, *path.resolve().parents[:2]] if has_model(path) else [path]
    found = next((p / name for p in places for name in IMAGE_FOLDERS if (p / name).is_dir()), None)
    if found is None:
        raise InputError(f"{path}: no folder images/; put the photographs there, named as in the model")
    return found


def image_names(model: Path) -> set[str]:
    """Return the names of all images of a model, without reading the rest of it.

    Raises
    ------
    InputError
        Its file of images cannot be read.
    """
    binary, text = model / "images.bin", model / "images.txt"
    if (model / "cameras.bin").is_file():
        return {r.name.decode(errors="replace") for r in read_records(binary)} if binary.is_file() else set()
    return set(text_names(text).values()) if text.is_file() else set()


def read_model(path: Path, name: str | None = None) -> Any:
    """Read all of the COLMAP model of a scene, with its 2D features, as a ``pycolmap.Reconstruction``.

    Parameters
    ----------
    path : Path
        The scene.
    name : str, optional
        As for :func:`find_model`.

    Raises
    ------
    InputError
        There is no model, or it is damaged.
    """
    model = _model_folder(path, name)
    with _readable(model) as folder:
        reconstruction = import_pycolmap().Reconstruction(str(folder))
    return _checked(reconstruction, model)


def _model_folder(path: Path, name: str | None = None) -> Path:
    """Return the folder of the model of a scene, which must have one; ``name`` as for find_model."""
    model = find_model(path, name)
    if model is None:
        raise InputError(
            f"{path}: no COLMAP model, looked for cameras.bin or cameras.txt in {' and '.join(MODEL_FOLDERS)};"
            f" to make one from photographs run `minisplat-ref sfm PHOTOS --out {path}`"
        )
    return model


def _read_light(model: Path) -> LightModel:
    """Read the model in a folder without its 2D features."""
    with _readable(model) as folder, without_features(folder) as (light, seen):
        reconstruction = import_pycolmap().Reconstruction(str(light))
    return LightModel(_checked(reconstruction, model), seen)


@contextmanager
def _readable(model: Path) -> Iterator[Path]:
    """Give a folder of a model that pycolmap can read, whose files end where they should; say it if it cannot."""
    if (model / "cameras.bin").is_file():
        for name in LAYOUTS:
            if (model / name).is_file():
                check_records(model / name)
    elif (model / "images.txt").is_file():
        _check_text_images(model / "images.txt")
    try:
        with readable(model) as folder:
            yield folder
    except DAMAGE_ERRORS as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{model}: damaged or incomplete COLMAP model ({reason}); copy or export it again") from None


def _checked(reconstruction: Any, model: Path) -> Any:
    """Refuse a model with too few cameras, which pycolmap does not notice, and give images the names that they have."""
    if (model / "cameras.bin").is_file():
        size = 8 + sum(24 + 8 * len(camera.params) for camera in reconstruction.cameras.values())
        found = (model / "cameras.bin").stat().st_size
        if found < size:
            raise InputError(f"{model / 'cameras.bin'}: truncated, {found} of {size} bytes; copy or export it again")
    else:
        for image_id, text in text_names(model / "images.txt").items():
            if reconstruction.exists_image(image_id) and " " in text:
                reconstruction.image(image_id).name = text
    return reconstruction


def write_model(path: Path, folder: Path) -> None:
    """Write the model of a scene as pycolmap reads it, with the names that the photographs have on disk."""
    reconstruction = read_model(path)
    for image in reconstruction.images.values():
        image.name = spelled_on_disk(image_folder(path), _name(path, image))
    reconstruction.write_binary(str(folder))


def colmap_photos(path: Path) -> list[Photo]:
    """List the registered images of the model of a scene, in no particular order."""
    return _photos(path, _read_light(_model_folder(path)))


def _photos(path: Path, model: LightModel) -> list[Photo]:
    """List the registered images of a model."""
    folder, images = image_folder(path), model.reconstruction.images
    masks = _mask_files(folder.with_name("masks"))
    names = {image_id: _name(path, image) for image_id, image in images.items()}
    registered = [(names[image_id], image) for image_id, image in images.items() if image.has_pose]
    return [_photo(path, folder, name, image, model.seen, masks) for name, image in registered]


def _name(path: Path, image: Any) -> str:
    """Return the name of an image, which must be text and stay in ``images/``."""
    try:
        return name_inside(image.name, path)
    except UnicodeDecodeError:
        raise InputError(
            f"{path}: the name of image {image.image_id} is not UTF-8; rename the file and export the model again"
        ) from None


def _mask_files(masks: Path) -> dict[str, Path]:
    """Return the files of a folder by their names relative to it, without regard to upper and lower case."""
    files = sorted(masks.rglob("*"), reverse=True) if masks.is_dir() else []  # of two, lower case wins: it sorts last
    return {file.relative_to(masks).as_posix().casefold(): file for file in reversed(files)}


def model_cameras(folder: Path) -> dict[str, tuple[Camera, Lens | None]]:
    """Return the cameras of a model's registered images with their lenses, by the images' names.

    Parameters
    ----------
    folder : Path
        Of the model itself; photographs are not needed.

    Raises
    ------
    InputError
        The model is damaged, or a camera has no pinhole view.
    """
    images = _read_light(folder).reconstruction.images.values()
    return {
        name: (_camera(folder, name, image), _lens(image.camera))
        for name, image in ((_name(folder, image), image) for image in images if image.has_pose)
    }


def _photo(
    path: Path, folder: Path, name: str, image: Any, seen: Mapping[int, Ints] | None, masks: Mapping[str, Path]
) -> Photo:
    """Return a registered image of the model, with the points that it sees if there are tracks."""
    candidates = (f"{name}.png", Path(name).with_suffix(".png").as_posix())
    mask_path = next((masks[c.casefold()] for c in candidates if c.casefold() in masks), None)
    point_ids = None if seen is None else seen.get(image.image_id, np.zeros(0, np.int64))
    camera = _camera(path, name, image)
    return Photo(folder, spelled_on_disk(folder, name), mask_path, camera, _lens(image.camera), point_ids)


def _camera(path: Path, name: str, image: Any) -> Camera:
    """Return pose and pinhole of a registered image."""
    pose = image.cam_from_world().matrix()  # [3, 4]
    model = image.camera
    if len(model.focal_length_idxs()) == 0:  # asking it for a focal length would abort the process
        raise InputError(
            f"{path}: {name} has camera model {model.model.name}, a panorama, of which there is no pinhole view;"
            " cut pinhole views out of it and run COLMAP on those"
        )
    return Camera(
        cam_from_world_R=np.ascontiguousarray(pose[:, :3]),
        cam_from_world_t=np.ascontiguousarray(pose[:, 3]),
        fx=model.focal_length_x,
        fy=model.focal_length_y,
        cx=model.principal_point_x,
        cy=model.principal_point_y,
        width=model.width,
        height=model.height,
    )


def _lens(camera: Any) -> Lens | None:
    """Return the distortion of a ``pycolmap.Camera``; a polynomial model with all-zero coefficients has none."""
    name, params = camera.model.name, np.asarray(camera.params)
    has_zero_distortion = name in POLYNOMIAL_MODELS and not params[list(camera.extra_params_idxs())].any()
    return None if name in PINHOLE_MODELS or has_zero_distortion else Lens(name, tuple(params.tolist()))


def _points(reconstruction: Any) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the sparse points and their colours, [P, 3] each, by their numbers and not as they are in the file."""
    points = [point for _, point in sorted(reconstruction.points3D.items())]
    positions = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    return positions, np.array([point.color for point in points], np.uint8).reshape(-1, 3)


def _points_beside(path: Path, model: Path | None) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the points of the PLY that some programs write instead of the model's own; none without one."""
    file = None if model is None else model / POINTS_PLY
    cloud: PointCloud = NO_POINTS if file is None or not file.is_file() else load_points(file)
    if not len(cloud.points):
        message = f"{path}: the model has no sparse points; give some to start from by --init PLY, or run sfm"
        warnings.warn(one_line(message), InputWarning, stacklevel=3)
    return cloud.points, cloud.colors


def _check_text_images(file: Path) -> None:
    """Refuse a text file of images in which second lines are missing; warn if its heading states more images.

    An image takes two lines, the second of which lists its 2D features and is empty if there are none. Where a program
    has left out empty lines, pycolmap takes every second image for the features of the one before.
    """
    n_images = n_read = n_stated = 0
    of_features = False  # the next line
    for line in text_lines(file):
        is_comment = line.startswith("#")
        # Features are triples of numbers; an image has nine numbers and a name.
        n_images += not is_comment and len(line.split()) % 3 != 0
        heading = N_IMAGES.match(line)
        n_stated = n_stated or (int(heading[1]) if heading else 0)
        if of_features:
            n_read, of_features = n_read + 1, False
        else:
            of_features = bool(line.strip()) and not is_comment
    if n_read < n_images:
        raise InputError(
            f"{file}: {n_images} images, of which {n_read} can be read: each needs a second line with its 2D features,"
            " empty if it has none; add the empty lines, or export the model as binary"
        )
    if n_read < n_stated:
        warnings.warn(
            one_line(
                f"{file}: {n_read} images, though its heading says {n_stated}; export the model again, unless images"
                " were taken out on purpose"
            ),
            InputWarning,
            stacklevel=4,
        )
