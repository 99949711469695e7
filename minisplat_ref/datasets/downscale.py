"""Write the images of a scene at one D-th of their size into the folder ``images_D`` beside them.

Loading a scene with ``downscale=D`` uses that folder, and resizes on the fly without it: this only saves time. Sizes
are rounded; colours pass through the same LANCZOS filter as on the fly.
"""

import warnings
from pathlib import Path

from tqdm import tqdm

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.images import IMAGE_SUFFIXES, downscaled_size, read_image, resize_image, write_image

UNREAD_SUFFIXES = (
    *(".heic", ".heif", ".avif", ".jxl"),
    *(".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"),
)
"""Formats of phones and cameras that Pillow does not decode."""
NAMED_MAX = 20  # files that a message names


def list_images(folder: Path) -> list[Path]:
    """Return the image files in a folder and below, sorted by name; warn of photographs in unsupported formats."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a folder with photographs")
    found = sorted(file for file in folder.rglob("*") if file.is_file())
    files = [file for file in found if file.suffix.lower() in IMAGE_SUFFIXES]
    others = [file for file in found if file.suffix.lower() in UNREAD_SUFFIXES]
    names = ", ".join(str(file.relative_to(folder)) for file in others[:NAMED_MAX])
    names += f" and {len(others) - NAMED_MAX} more" if len(others) > NAMED_MAX else ""
    not_read = f"{len(others)} photographs of formats that are not read ({names}): convert them to JPEG"
    if not files:
        found_instead = f", but {not_read}" if others else ""
        raise InputError(f"{folder}: no images in it (looked for {' '.join(IMAGE_SUFFIXES)}){found_instead}")
    if others:
        warnings.warn(one_line(f"{folder}: leaving out {not_read}"), InputWarning, stacklevel=2)
    return files


def downscale_images(images: Path, factor: int) -> Path:
    """Write every image of a folder at 1 / factor of its size into its sibling ``<images>_<factor>``.

    Parameters
    ----------
    images : Path
        Folder of images; its subfolders are kept.
    factor : int
        At least 2.

    Returns
    -------
    Path
        The new folder.

    Raises
    ------
    InputError
        If there are no images, one cannot be read, or the new folder is already there.
    """
    if factor < 2:
        raise InputError(f"--downscale is {factor}; it must be at least 2")
    files = list_images(images)
    target = images.with_name(f"{images.name}_{factor}")
    with making_folder(target) as folder:
        for file in tqdm(files, desc=target.name, unit=" images", leave=False, disable=None):
            image = read_image(file)
            small = folder / file.relative_to(images)
            small.parent.mkdir(parents=True, exist_ok=True)
            write_image(small, resize_image(image, *downscaled_size(image.shape[1], image.shape[0], factor)))
    return target
