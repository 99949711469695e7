"""Prepare photographs for structure from motion: upright and shrunk copies, their masks, and their cameras.

Photographs share a camera if size, make, model and focal length agree: another zoom setting is another camera. Values
that the EXIF data lack count as equal. Copies keep the focal length, COLMAP's initial value; location and time are left
out. An alpha channel is a mask, and so is a file in ``masks/`` beside the photographs, as COLMAP names it
(``0001.jpg.png``) or by the name alone (``0001.png``).
"""

import math
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import ExifTags, Image, ImageOps

from minisplat_ref.datasets.photo_files import MASKS, enumerate_names, list_images
from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.images import (
    IMAGE_SUFFIXES,
    MASK_THRESHOLD,
    SAVE_OPTIONS,
    check_flat,
    decode_pixels,
    open_image,
    read_mask,
    resize_mask,
    write_image,
)
from minisplat_ref.types import Bools

CAMERA_TAGS = (ExifTags.Base.Make, ExifTags.Base.Model)
TIME_TAGS = (ExifTags.Base.DateTimeOriginal, ExifTags.Base.SubsecTimeOriginal)
FOCAL_TAGS = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)


class Group(NamedTuple):
    """Properties that photographs of one camera share, of their copies and from their EXIF data."""

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    camera: str
    """Make and model, "" if unknown."""
    focal: float | None
    """Focal length, mm, None if unknown."""
    focal_35: float | None
    """Focal length with the same angle of view on 35 mm film, mm, None if unknown."""
    found: float | None = None
    """Focal length in widths, where photographs of one group were told apart by it (:mod:`.zoom`)."""


class Photographs(NamedTuple):
    """Copies of photographs, ready for COLMAP; a copy's name is relative to ``images``."""

    source: Path
    """Folder of the originals."""
    images: Path
    """Folder of the copies."""
    originals: dict[str, Path]
    """The original of each copy, relative to ``source``; sorted."""
    groups: dict[Group, list[str]]
    """Names of the photographs that share a camera."""
    masks: Path
    """Folder of the masks of copies, named as COLMAP does."""
    masked: frozenset[str]
    """Names of the photographs that have a mask."""
    ordered: list[str]
    """Names in the order in which the photographs were taken, as far as EXIF data or their names tell."""


def prepare_photos(source: Path, work: Path, long_side: int) -> Photographs:
    """Copy the photographs of a folder upright and shrunk into ``work/images``, and their masks into ``work/masks``.

    Parameters
    ----------
    source : Path
        Folder of photographs.
    work : Path
        Folder for the copies.
    long_side : int
        A longer side is shrunk to this, pixels.

    Raises
    ------
    InputError
        If there are no photographs, one cannot be read, two have one name, suffix aside, or a mask has another size
        than its photograph.
    """
    images, masks = work / "images", work / MASKS
    originals: dict[str, Path] = {}
    groups: dict[Group, list[str]] = {}
    masked = set()
    used = set()
    times: dict[str, str] = {}
    for file in with_progress(list_images(source), "reading", "photographs"):
        relative = file.relative_to(source)
        name = _name_copy(relative)
        if name in originals:
            raise InputError(f"{file}: another photograph is called {name}; give each its own name, suffix aside")
        originals[name] = relative
        mask_file = find_mask(source, relative)
        group, mask, times[name] = _copy(file, mask_file, images / name, long_side)
        groups.setdefault(group, []).append(name)
        if mask is not None:
            masked.add(name)
            (masks / f"{name}.png").parent.mkdir(parents=True, exist_ok=True)
            write_image(masks / f"{name}.png", mask)
        if mask_file is not None:
            used.add(mask_file)
    _warn_of_unused(source, used)
    return Photographs(source, images, originals, groups, masks, frozenset(masked), order(times))


def order(times: Mapping[str, str]) -> list[str]:
    """Return the names of photographs in the order of their times, or of the names if not all have a time.

    Parameters
    ----------
    times : mapping of str to str
        As EXIF data have them, so that the order is that of the alphabet; "" if unknown.
    """
    names = sorted(times)
    return sorted(names, key=lambda name: times[name]) if all(times.values()) else names


def _name_copy(original: Path) -> str:
    """Return the name of a copy: without spaces, which separate names in COLMAP's lists of pairs."""
    suffix = ".png" if original.suffix.lower() == ".png" else ".jpg"
    return re.sub(r"\s", "_", original.with_suffix(suffix).as_posix())


def find_mask(source: Path, relative: Path) -> Path | None:
    """Return the mask file of a photograph, in ``masks/`` in the folder of photographs or beside it; None if none."""
    stems = (f"{relative}.png", relative.with_suffix(".png"))
    candidates = [folder / MASKS / stem for folder in (source, source.absolute().parent) for stem in stems]
    return next((file for file in candidates if file.is_file()), None)


def _copy(file: Path, mask_file: Path | None, target: Path, long_side: int) -> tuple[Group, Bools | None, str]:
    """Write the copy of a photograph; return its group, its mask at the copy's size if it has one, and its time."""
    with open_image(file) as opened:
        check_flat(opened)
        exif, time = _focal_exif(opened), _time(opened)
        pixels = decode_pixels(ImageOps.exif_transpose(opened))  # [H, W, 3 or 4], upright
    mask = None if pixels.shape[2] == 3 else pixels[..., 3] >= MASK_THRESHOLD
    if mask_file is not None:
        given = read_mask(mask_file)
        if given.shape != pixels.shape[:2]:
            raise InputError(
                f"{mask_file}: the mask is {given.shape[1]}x{given.shape[0]} but its photograph {file.name}, upright,"
                f" is {pixels.shape[1]}x{pixels.shape[0]}; resize, turn or remove the mask"
            )
        mask = given if mask is None else given & mask
    image = Image.fromarray(np.ascontiguousarray(pixels[..., :3]))
    image.thumbnail((long_side, long_side), Image.Resampling.LANCZOS)
    target.parent.mkdir(parents=True, exist_ok=True)
    image.save(target, exif=exif, **SAVE_OPTIONS["JPEG"])  # PNG ignores these options
    return _group(image, exif), None if mask is None else resize_mask(mask, *image.size), time


def _focal_exif(image: Image.Image) -> Image.Exif:
    """Return the EXIF data of the focal length only; location, time and the orientation, now applied, are left out."""
    source, focal = image.getexif(), Image.Exif()
    focal.update({tag: source[tag] for tag in CAMERA_TAGS if tag in source})
    lens = source.get_ifd(ExifTags.IFD.Exif)
    focal.get_ifd(ExifTags.IFD.Exif).update({tag: lens[tag] for tag in FOCAL_TAGS if tag in lens})
    return focal


def _time(image: Image.Image) -> str:
    """Return when a photograph was taken, with fractions of a second where they are known; "" if unknown."""
    lens = image.getexif().get_ifd(ExifTags.IFD.Exif)
    time, fraction = (str(lens.get(tag, "")).strip(" \0") for tag in TIME_TAGS)
    return f"{time}.{fraction}" if time.strip("0: ") else ""


def _group(image: Image.Image, exif: Image.Exif) -> Group:
    """Return the group of a copy."""
    lens = exif.get_ifd(ExifTags.IFD.Exif)
    camera = " ".join(str(exif[tag]).strip(" \0") for tag in CAMERA_TAGS if tag in exif)
    focal, focal_35 = (_positive(lens.get(tag)) for tag in FOCAL_TAGS)
    return Group(*image.size, camera, focal, focal_35)


def _positive(value: object) -> float | None:
    """Return a length in the EXIF data, rounded as it is printed; None for nothing, 0 and 0/0, which mean unknown."""
    try:
        length = round(float(value), 2)  # type: ignore[arg-type]  # TypeError is caught
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return length if math.isfinite(length) and length > 0 else None


def _warn_of_unused(source: Path, used: set[Path]) -> None:
    """Name the files in ``masks/`` in the folder of photographs that are no photograph's mask."""
    folder = source / MASKS
    files = {file for file in folder.rglob("*") if file.suffix.lower() in IMAGE_SUFFIXES}
    unused = sorted({file for file in files if not file.name.startswith(".")} - used)
    if unused:
        names = enumerate_names([file.relative_to(folder).as_posix() for file in unused])
        warnings.warn(
            one_line(
                f"{folder}: no photograph belongs to {names}; the mask of 0001.jpg is called 0001.jpg.png or 0001.png"
            ),
            InputWarning,
            stacklevel=3,
        )
