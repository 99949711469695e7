"""Views whose mask leaves no pixel: found when a scene is loaded, and set aside.

Such a view teaches nothing and cannot be measured. Usually its mask is of values that hardly differ from black: 0 and 1
instead of 0 and 255, labels of classes, 8 bits in a file of 16. The message therefore describes the file's content.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.images import MASK_THRESHOLD, decode_pixels, has_transparency, open_image, read_mask, white_level
from minisplat_ref.io.stored_views import StoredView
from minisplat_ref.types import View

NAMED_MAX = 3  # files that a message names
TRAIN_VIEWS_MIN = 2  # from which a scene can be trained


class MaskFiles(NamedTuple):
    """The files that the mask of a view comes from."""

    image: Path
    """The photograph, whose alpha channel may be a mask."""
    mask: Path | None
    """The mask file, if there is one."""
    alpha_is_mask: bool
    """Whether an alpha channel counts as a mask."""

    @property
    def may_mask(self) -> bool:
        """Whether there is a mask at all; the pixels are not read."""
        return self.mask is not None or (self.alpha_is_mask and has_transparency(self.image))


def find_empty(views: Sequence[View], files: Sequence[MaskFiles]) -> list[int]:
    """Return the indices of the views whose mask leaves no pixel; views on disk are read if they have a mask."""
    return [i for i, (view, file) in enumerate(zip(views, files, strict=True)) if _is_empty(view, file)]


def _is_empty(view: View, files: MaskFiles) -> bool:
    if isinstance(view, StoredView) and not files.may_mask:
        return False
    mask = view.mask
    return mask is not None and not mask.any()


def report_empty(
    source: Path, views: Sequence[View], files: Sequence[MaskFiles], empty: Sequence[int], n_train: int
) -> None:
    """Warn of views that are set aside.

    Parameters
    ----------
    source : Path
        The scene.
    views : sequence of View
        All of it.
    files : sequence of MaskFiles
        Of each view.
    empty : sequence of int
        Indices of the views whose mask leaves no pixel.
    n_train : int
        How many of the views, from the first, are for training.

    Raises
    ------
    InputError
        Fewer than two training views would be left.
    """
    if not empty:
        return
    reasons = [_reason(views[i], files[i]) for i in empty[:NAMED_MAX]]
    more = f" and {len(empty) - NAMED_MAX} more" if len(empty) > NAMED_MAX else ""
    what = f"the masks of {len(empty)} of {len(views)} views leave no pixel: {', '.join(reasons)}{more}"
    if n_train - sum(i < n_train for i in empty) < TRAIN_VIEWS_MIN:
        raise InputError(
            f"{source}: {what}, and training needs at least {TRAIN_VIEWS_MIN} views; white marks what counts: make the"
            " masks black and white, or remove them"
        )
    warnings.warn(one_line(f"{source}: {what}; these views are set aside"), InputWarning, stacklevel=2)


def _reason(view: View, files: MaskFiles) -> str:
    """Name the file, and explain why none of its pixels count."""
    if files.mask is None:
        return f"{files.image} (transparent everywhere)"
    if not read_mask(files.mask).any():
        return f"{files.mask} ({describe_levels(files.mask)})"
    at_size = f"at {view.camera.width} x {view.camera.height} pixels"
    has_both = files.alpha_is_mask and has_transparency(files.image)
    return f"{files.mask} ({at_size}{' and where the photograph is opaque' if has_both else ''})"


def describe_levels(path: Path) -> str:
    """Describe the values of a mask file, and the level from which a pixel counts."""
    with open_image(path) as image:
        white = white_level(image)
        levels = np.asarray(image) if white != 255.0 else decode_pixels(image)  # [H, W] or [H, W, 3 or 4]
    if levels.ndim == 3 and levels[..., 3:].size and (alpha := levels[..., 3].max()) < MASK_THRESHOLD:
        return f"its alpha goes up to {alpha}, from {MASK_THRESHOLD} on a pixel is opaque"
    colors = levels[..., :3] if levels.ndim == 3 else levels
    return f"values from {colors.min():g} to {colors.max():g}, white is {white:g}"
