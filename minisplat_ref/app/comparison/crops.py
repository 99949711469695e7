"""Crops of test views for inspection: where the recipes differ most, and where there is most detail."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.app.reports.images import Image8, to_8_bits
from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.types import Floats, Scene, View

N_CROPS = 4  # half of them chosen where the recipes differ, which alone would show only failures
CROP_FRACTION = 0.3  # of a view's width and height


class Crop(NamedTuple):
    """One part of a test view, the same in truth and renders."""

    view: str
    """Name of the view."""
    reason: str
    """The reason why it is shown."""
    truth: Image8
    """[h, w, 3] photograph, sRGB."""
    renders: tuple[Image8, ...]
    """[h, w, 3] renders, sRGB, per model."""


class Scored(NamedTuple):
    """A crop, and its score in the search."""

    score: float
    crop: Crop


def choose_crops(models: Sequence[Trained], scene: Scene) -> list[Crop]:
    """Return at most N_CROPS crops, each of another test view.

    Parameters
    ----------
    models : sequence of Trained
        One per recipe.
    scene : Scene
        Its test views are shown.
    """
    pairs = [_best_crops(models, view.load()) for view in scene.test_views]
    n_different = (min(N_CROPS, len(pairs)) + 1) // 2 if len(models) > 1 else 0
    pairs.sort(key=lambda pair: pair[0].score, reverse=True)
    different, others = pairs[:n_different], pairs[n_different:]
    others.sort(key=lambda pair: pair[1].score, reverse=True)
    return [pair[0].crop for pair in different] + [pair[1].crop for pair in others[: N_CROPS - n_different]]


def _best_crops(models: Sequence[Trained], view: View) -> tuple[Scored, Scored]:
    """Return the crop of a view in which the recipes differ most, and that with the most detail."""
    renders = [to_8_bits(model.render(view).image) for model in models]
    return (
        _best_crop(view, renders, difference(view.image, renders), "where the recipes differ most"),
        _best_crop(view, renders, detail(view.image), "where there is most detail"),
    )


def _best_crop(view: View, renders: Sequence[Image8], values: Floats, reason: str) -> Scored:
    height, width = (max(1, round(CROP_FRACTION * length)) for length in values.shape)
    row, column, score = best_window(values, height, width)
    window = np.s_[row : row + height, column : column + width]
    return Scored(
        score, Crop(view.name, reason, view.image[window].copy(), tuple(image[window].copy() for image in renders))
    )


def difference(truth: Image8, renders: Sequence[Image8]) -> Floats:
    """Return per pixel [H, W] the range of the errors of the renders, in levels of 8 bits."""
    errors = np.array([np.abs(image.astype(np.float64) - truth).mean(axis=2) for image in renders])  # [M, H, W]
    return errors.max(axis=0) - errors.min(axis=0)


def detail(truth: Image8) -> Floats:
    """Return per pixel [H, W] how steeply the photograph changes, in levels per pixel."""
    down, right = np.gradient(truth.mean(axis=2))  # [H, W] each
    return np.hypot(down, right)


def best_window(values: Floats, height: int, width: int) -> tuple[int, int, float]:
    """Return row and column of the window with the largest mean, and that mean; of equal ones the first.

    Parameters
    ----------
    values : ndarray of shape (H, W)
    height, width : int
        Of the window, at most those of ``values``.
    """
    sums = np.zeros((values.shape[0] + 1, values.shape[1] + 1))  # of all values above and to the left
    sums[1:, 1:] = values.cumsum(axis=0).cumsum(axis=1)
    totals = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    row, column = np.unravel_index(np.argmax(totals), totals.shape)
    return int(row), int(column), float(totals[row, column] / (height * width))
