"""The stage ``sky_mask``: the pixels of a photograph that show the sky.

GauStudio takes masks from a network. Here they are an input, or derived from the colours: from the upper edge of the
photograph down, pixels that are bright and more blue than red, or white. That takes for sky whatever looks like it.
"""

from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.ndimage import label

from minisplat_ref.errors import InputError
from minisplat_ref.io.images import read_mask, resize_mask
from minisplat_ref.types import Bools, View

BRIGHT = 110  # of 255, in blue
BLUER = 1.1  # times the red: in the shade roads are bluish, too. Chosen on photographs with a sky and without
WHITE = 225  # of 255, in the darkest channel: a cloud, whatever its tint
ASPECT = 0.02  # relative difference of the ratios of sides beyond which a mask is not of this photograph


def by_color(view: View, mask_folder: str) -> Bools:
    """What is bright and blue, or white, and reaches the upper edge."""
    red, green, blue = view.image.astype(np.float32).transpose(2, 0, 1)
    is_blue = (blue >= BRIGHT) & (blue >= BLUER * red) & (blue >= green)
    is_like_sky = is_blue | (view.image.min(axis=2) >= WHITE)
    regions, _ = label(is_like_sky)
    at_top = np.unique(regions[0])
    return np.isin(regions, at_top[at_top > 0])


def left_out(view: View, mask_folder: str) -> Bools | None:
    """What the photograph's own mask leaves out; no colours are learned there."""
    return None if view.mask is None else ~view.mask


def from_files(view: View, mask_folder: str) -> Bools | None:
    """White pixels of NAME.png in the folder of --set mask_folder=DIR.

    Raises
    ------
    InputError
        There is no folder, no such file, or the mask is of another shape.
    """
    if not mask_folder:
        raise InputError("sky_mask=from_files has no folder to read: add --set mask_folder=DIR")
    return read_for(Path(mask_folder) / f"{view.name}.png", view.camera.width, view.camera.height)


@lru_cache(maxsize=4096)
def read_for(path: Path, width: int, height: int) -> Bools:
    """Return a mask file at the size of a view."""
    if not path.is_file():
        raise InputError(
            f"{path}: there is no such mask; minisplat-ref gaustudio masks SCENE --out {path.parent} writes one for"
            " each photograph"
        )
    mask = read_mask(path)
    if abs(mask.shape[1] * height / (mask.shape[0] * width) - 1) > ASPECT:
        raise InputError(
            f"{path} has {mask.shape[1]} x {mask.shape[0]} pixels, which is not the shape of the photograph, {width} x"
            f" {height}: give the mask of this photograph"
        )
    return resize_mask(mask, width, height)
