"""Write the images of a scene at one D-th of their size into the folder ``images_D`` beside them.

Loading a scene with ``downscale=D`` uses that folder, and resizes on the fly without it: this only saves time. Sizes
are rounded; colours pass through the same LANCZOS filter as on the fly.
"""

from pathlib import Path

from tqdm import tqdm

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.images import IMAGE_SUFFIXES, downscaled_size, read_image, resize_image, write_image


def list_images(folder: Path) -> list[Path]:
    """Image files in a folder and below, sorted by name."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a folder with photographs")
    files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise InputError(f"{folder}: no images in it (looked for {' '.join(IMAGE_SUFFIXES)})")
    return files


def downscale_images(images: Path, factor: int) -> Path:
    """Write every image of a folder at 1 / factor of its size into its sibling ``<images>_<factor>``.

    Parameters
    ----------
    images : Path
        Folder of images; folders in it are kept.
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
        raise InputError(f"--factor is {factor}; it must be at least 2")
    files = list_images(images)
    target = images.with_name(f"{images.name}_{factor}")
    with making_folder(target) as folder:
        for file in tqdm(files, desc=target.name, unit=" images", leave=False, disable=None):
            image = read_image(file)
            small = folder / file.relative_to(images)
            small.parent.mkdir(parents=True, exist_ok=True)
            write_image(small, resize_image(image, *downscaled_size(image.shape[1], image.shape[0], factor)))
    return target
