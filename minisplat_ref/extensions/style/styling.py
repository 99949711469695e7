"""The whole of G-Style on a trained scene: match colours, restructure, paint."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import GSPLAT_MAIN, SH_C0, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.style.method import (
    CONTENT,
    CONTENT_CLASSICAL,
    NNFM_AROUND,
    RESTRUCTURE,
    painting,
    style_of,
)
from minisplat_ref.extensions.style.reference import ColorMap, FeatureWeights, match_colors
from minisplat_ref.io.images import composite_alpha, read_image, resize_image
from minisplat_ref.mechanisms.features.bank import FeatureBank, check_size
from minisplat_ref.mechanisms.features.filters import CLASSICAL
from minisplat_ref.training.fine_tuning import fine_tune
from minisplat_ref.training.schedule import scale_recipe
from minisplat_ref.types import Floats, Gaussians, Scene, View

MIN_CONTRAST = 2 / 255
"""Standard deviation of a style's colours below which it has one colour."""
N_PIXELS = 200_000  # of the photographs, from which their colours' mean and covariance come


class Plan(NamedTuple):
    """Settings of the styling."""

    bank: FeatureBank = CLASSICAL
    weights: FeatureWeights = FeatureWeights(NNFM_AROUND, CONTENT_CLASSICAL)
    iterations: int = 1_000
    """Of each of the two stages."""
    seed: int = 0
    splits: bool = True
    """Whether Gaussians are split and shortened."""


class Styled(NamedTuple):
    """The result."""

    gaussians: Gaussians
    recolored: Gaussians
    """With matched colours, before the first stage."""
    scene: Scene
    """With the photographs in matched colours."""


def default_weights(bank: FeatureBank, nnfm: float) -> FeatureWeights:
    """Return the published weights; the content's is larger for the classical bank, whose features are smaller."""
    return FeatureWeights(nnfm, CONTENT_CLASSICAL if bank is CLASSICAL else CONTENT)


def read_style(path: Path, max_side: int) -> NDArray[np.uint8]:
    """Read a style image [H, W, 3], made smaller where a side is longer than ``max_side`` pixels.

    Raises
    ------
    InputError
        The file is no image.
    """
    pixels = read_image(path)
    pixels = composite_alpha(pixels, np.ones(3)) if pixels.shape[2] == 4 else pixels
    height, width = pixels.shape[:2]
    factor = min(1.0, max_side / max(height, width))
    return resize_image(pixels, max(1, round(factor * width)), max(1, round(factor * height))) if factor < 1 else pixels


def check_style(image: Floats, bank: FeatureBank, what: str) -> None:
    """Refuse a style image [H, W, 3] without a pattern, or too small for its features.

    Raises
    ------
    InputError
        Names the image by ``what``.
    """
    check_size(bank, image.shape[1], image.shape[0], what)
    if image.reshape(-1, 3).std(axis=0).max() < MIN_CONTRAST:
        raise InputError(f"{what} has one colour, and so no pattern to paint with: give an image with one")


def stylise(
    gaussians: Gaussians,
    scene: Scene,
    image: Floats,
    plan: Plan,
    *,
    conventions: Conventions = GSPLAT_MAIN,
    on_step: Callable[[Any], None] | None = None,
) -> Styled:
    """Return a trained scene in the style of an image.

    Parameters
    ----------
    gaussians : Gaussians
    scene : Scene
        That they were trained on.
    image : ndarray of shape (H, W, 3)
        The style, in [0, 1].
    plan : Plan
    conventions : Conventions
        Of the renderer.
    on_step : callable, optional
        Called after each iteration of both stages.

    Raises
    ------
    InputError
        The image or a photograph is too small, or the image has one colour.
    """
    check_style(image, plan.bank, "the style image")
    for view in scene.train_views:
        check_size(plan.bank, view.camera.width, view.camera.height, f"photograph {view.name}")
    scene = scene._replace(train_views=tuple(view.load() for view in scene.train_views))
    color_map = match_colors(_pixels(scene), image.reshape(-1, 3).astype(np.float64))
    scene = scene._replace(train_views=tuple(_recolor_view(view, color_map) for view in scene.train_views))
    recolored = recolor(gaussians, color_map)
    first, second = RESTRUCTURE, painting(style_of(plan.bank, image.astype(np.float32)), plan.weights)
    if not plan.splits:
        first, second = first._replace(events=()), second._replace(events=())
    rng = np.random.default_rng(plan.seed)
    found = recolored
    for recipe in (first, second):
        scaled = scale_recipe(recipe, plan.iterations)._replace(sh_milestones=(0,) * recipe.sh_degree)
        found = fine_tune(found, scene, scaled, rng, on_step, conventions=conventions)
        found = found._replace(sh_rest=np.zeros_like(found.sh_rest))
    return Styled(found, recolored, scene)


def recolor(gaussians: Gaussians, color_map: ColorMap) -> Gaussians:
    """Return Gaussians whose colours are mapped: ``c' = M (c - source) + target`` for ``c = 1/2 + C_0 dc + ...``.

    All harmonics are multiplied by M; the constant goes into ``dc``. An image of opaque Gaussians is mapped like them.
    """
    M = color_map.M
    dc = (color_map(0.5 + SH_C0 * gaussians.sh_dc.astype(np.float64)) - 0.5) / SH_C0
    rest = gaussians.sh_rest.astype(np.float64) @ M.T
    dtype = gaussians.means.dtype
    return gaussians._replace(sh_dc=dc.astype(dtype), sh_rest=rest.astype(dtype))


def _pixels(scene: Scene) -> Floats:
    """Return colours [P, 3] in [0, 1], evenly from all photographs, without masked pixels."""
    rows = [view.image.reshape(-1, 3) if view.mask is None else view.image[view.mask] for view in scene.train_views]
    stride = max(1, sum(map(len, rows)) // N_PIXELS)
    return np.concatenate([row[::stride] for row in rows]) / 255


def _recolor_view(view: View, color_map: ColorMap) -> View:
    colors = color_map(view.image / 255)
    return view._replace(image=np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8))
