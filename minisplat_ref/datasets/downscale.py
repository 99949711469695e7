"""Write the images of a scene, smaller by a factor D, into the folder ``images_D`` next to them.

Loading a scene with ``downscale=D`` uses that folder, and resizes on the fly without it: this only saves time. Sizes
are rounded; colours pass through the same LANCZOS filter as on the fly.
"""

from pathlib import Path

from minisplat_ref.datasets.photo_files import list_images
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.images import (
    check_downscale,
    downscaled_size,
    image_size,
    read_image,
    resize_image,
    write_image,
)


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
        If there are no images, one cannot be read or would be too small, or the new folder is already there.
    """
    if factor < 2:
        raise InputError(f"--downscale is {factor}; it must be at least 2")
    files = list_images(images)
    target = images.with_name(f"{images.name}_{factor}")
    with making_folder(target) as folder:
        check_downscale(images, map(image_size, files), factor)
        for file in with_progress(files, target.name, "photographs"):
            image = read_image(file)
            small = folder / file.relative_to(images)
            small.parent.mkdir(parents=True, exist_ok=True)
            write_image(small, resize_image(image, *downscaled_size(image.shape[1], image.shape[0], factor)))
    return target
