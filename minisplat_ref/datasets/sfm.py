"""Estimate cameras and sparse points from a folder of photographs, on the CPU: structure from motion by pycolmap.

Photographs are rotated upright (EXIF) and shrunk, SIFT features are found and matched, cameras and points are estimated
one image after the other (incremental mapping), and the result is undistorted. What is left is a COLMAP scene with
pinhole cameras: ``images/`` and ``sparse/0/``. Photographs that could not be registered are named and left out. The
focal length in the EXIF data is COLMAP's initial value; location and time are not copied.
"""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from PIL import ExifTags, Image, ImageOps
from tqdm import tqdm

from minisplat_ref.datasets.downscale import list_images
from minisplat_ref.datasets.undistort import undistort_model
from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.images import SAVE_OPTIONS, open_image
from minisplat_ref.io.lens import import_quiet_pycolmap

CAMERA_TAGS = (ExifTags.Base.Make, ExifTags.Base.Model)
FOCAL_TAGS = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
PHOTOS_MIN, SHARE_MIN = 3, 0.25  # of the given ones; fewer registered photographs are no scene of them
SEED = 0  # of RANSAC: the same photographs give the same cameras, up to the order in which threads finish


class SfmResult(NamedTuple):
    """The result, for the report."""

    n_photos: int
    """Photographs that were given."""
    left_out: tuple[str, ...]
    """Names of those that could not be registered, in the folder of photographs."""
    other_groups: tuple[int, ...]
    """Sizes of the groups that fit together, but not with the scene."""
    n_points: int
    """Sparse points."""
    error: float
    """Mean reprojection error before undistortion, pixels."""


def run_sfm(
    photos: Path, out: Path, *, long_side: int = 1600, matching: str = "exhaustive", camera_model: str = "SIMPLE_RADIAL"
) -> SfmResult:
    """Make a COLMAP scene with pinhole cameras from photographs, complete or not at all.

    Parameters
    ----------
    photos : Path
        Folder of photographs.
    out : Path
        Folder to make.
    long_side : int
        Photographs with a longer side are shrunk to this, pixels.
    matching : str
        "exhaustive": every pair. "sequential": neighbours in the order of file names, for videos.
    camera_model : str
        COLMAP model that is estimated; one camera for all if all photographs have one size, else one for each.

    Returns
    -------
    SfmResult

    Raises
    ------
    InputError
        If there are fewer than two photographs, one cannot be read, or hardly any finds a place.
    """
    files = list_images(photos)
    if len(files) < 2:
        raise InputError(f"{photos}: 1 photograph, structure from motion needs at least 2 that overlap; take more")
    if long_side < 1:
        raise InputError(f"--long-side is {long_side}; it must be positive")
    with making_folder(out) as folder, TemporaryDirectory(dir=folder) as temporary:
        work = Path(temporary)
        names = prepare_photos(files, photos, work / "images", long_side)
        reconstruction, *others = _reconstruct(work, names, matching, camera_model, photos)
        n_placed = reconstruction.num_reg_images()
        if n_placed < max(min(len(files), PHOTOS_MIN), SHARE_MIN * len(files)):
            raise InputError(
                f"{photos}: {n_placed} of {len(files)} photographs ({n_placed / len(files):.0%}) found a place, too few"
                f" for a scene; {advice(matching)}"
            )
        (work / "model").mkdir()
        reconstruction.write(work / "model")
        undistort_model(work / "model", work / "images", folder)
    registered = {image.name for image in reconstruction.images.values() if image.has_pose}
    originals = zip(names, files, strict=True)
    left_out = tuple(str(file.relative_to(photos)) for name, file in originals if name not in registered)
    error = reconstruction.compute_mean_reprojection_error()
    groups = tuple(model.num_reg_images() for model in others)
    return SfmResult(len(files), left_out, groups, reconstruction.num_points3D(), error)


def advice(matching: str) -> str:
    """Return what usually helps photographs that could not be registered after this kind of matching."""
    if matching == "sequential":
        return (
            "--matching sequential compares neighbours in the order of file names, which suits frames of a video; for"
            " other photographs use --matching exhaustive"
        )
    return (
        "what usually helps: more photographs between those that do not join, so that each shares most of its view with"
        " two others; sharp ones, with a step to the side between shots; a subject with texture that does not move"
    )


def prepare_photos(files: Sequence[Path], photos: Path, target: Path, long_side: int) -> dict[str, tuple[int, int]]:
    """Copy photographs upright and shrunk; return the size of each by its new name, relative to ``target``."""
    sizes: dict[str, tuple[int, int]] = {}
    for file in tqdm(files, desc="photographs", unit=" images", leave=False, disable=None):
        relative = file.relative_to(photos)
        name = relative.with_suffix(".png" if relative.suffix.lower() == ".png" else ".jpg").as_posix()
        if name in sizes:
            raise InputError(f"{file}: another photograph is called {name}; give each its own name, suffix aside")
        with open_image(file) as opened:
            exif = _focal_exif(opened)
            image = ImageOps.exif_transpose(opened).convert("RGB")
        image.thumbnail((long_side, long_side), Image.Resampling.LANCZOS)
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        image.save(target / name, exif=exif, **SAVE_OPTIONS["JPEG"])  # PNG ignores these options
        sizes[name] = image.size
    return sizes


def _focal_exif(image: Image.Image) -> Image.Exif:
    """Return the EXIF data of the focal length only; location, time and the orientation, now applied, are left out."""
    source, focal = image.getexif(), Image.Exif()
    focal.update({tag: source[tag] for tag in CAMERA_TAGS if tag in source})
    lens = source.get_ifd(ExifTags.IFD.Exif)
    focal.get_ifd(ExifTags.IFD.Exif).update({tag: lens[tag] for tag in FOCAL_TAGS if tag in lens})
    return focal


def _reconstruct(
    work: Path, sizes: dict[str, tuple[int, int]], matching: str, camera_model: str, photos: Path
) -> list[Any]:
    """Find and match features, and return the models of incremental mapping as reconstructions, largest first."""
    pycolmap = import_quiet_pycolmap()
    pycolmap.set_random_seed(SEED)
    database, images = work / "database.db", work / "images"
    mode = pycolmap.CameraMode.SINGLE if len(set(sizes.values())) == 1 else pycolmap.CameraMode.PER_IMAGE
    reader = pycolmap.ImageReaderOptions(camera_model=camera_model)
    cpu = pycolmap.Device.cpu
    with tqdm(total=3, desc="features", unit=" steps", leave=False, disable=None) as bar:
        pycolmap.extract_features(database, images, camera_mode=mode, reader_options=reader, device=cpu)
        bar.update()
        bar.set_description("matches")
        match = pycolmap.match_exhaustive if matching == "exhaustive" else pycolmap.match_sequential
        match(database, device=cpu)
        bar.update()
        bar.set_description("cameras")
        options = pycolmap.IncrementalPipelineOptions(random_seed=SEED)
        models = pycolmap.incremental_mapping(database, images, work, options)
    if not models:
        raise InputError(
            f"{photos}: no two photographs could be placed; take them with more overlap, of something with texture"
        )
    return sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)
