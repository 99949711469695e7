"""The two stages of G-Style as recipes: split and retrain on matched colours, then paint.

Both begin with a trained scene. The photographs are those of the run with the colours of the style. The published
numbers are G-Style's (section and code as in ``tests/extensions/test_published.py``); the others are ours.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.style.reference import FeatureWeights, feature_loss, total_variation, unit_rows
from minisplat_ref.extensions.style.splitting import cut_stretch, largest, split, split_large
from minisplat_ref.mechanisms.features.bank import FeatureBank
from minisplat_ref.methods.gaussian_splatting import FINE_TUNING
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.schedule import At, Every, Recipe
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Floats

AREA_FACTOR, AREA_GROWTH, MAX_SHARE = 1.0, 1.125, 0.1  # published ranges: 1 to 1.1, 1 to 1.125, 0.05 to 0.1
N_CHILDREN = 4  # published: 4 to 8
MAX_RATIO = 1.5
COLOR_SHARE = 0.05  # published: 0.02 to 0.05
NNFM_AROUND, NNFM_FORWARD = 10.0, 100.0  # cameras all around, or facing forward
CONTENT, TOTAL_VARIATION = 0.05, 1e-4
CONTENT_CLASSICAL = 5.0
"""Ours: VGG's features are about ten times those of the classical bank, and the loss is quadratic."""
PERIOD, N_ROUNDS, ITERATIONS = 200, 4, 1_000  # ours
COLOR_RATE = 0.01  # ours: four times that of 3DGS, whose photographs are already nearly right
N_STYLE_ROWS = 2_000  # ours: of the style's features at each scale


class Style(NamedTuple):
    """The features of the style image that the losses need."""

    bank: FeatureBank
    maps: tuple[Floats, ...]
    """[Q, C] units of features at each scale."""


def style_of(bank: FeatureBank, image: Floats) -> Style:
    """Return the style of an image [H, W, 3] in [0, 1]: its features, at most N_STYLE_ROWS a scale, evenly spread."""
    maps, _ = bank.features(image)
    return Style(bank, tuple(unit_rows(evenly(map_.reshape(-1, map_.shape[2])))[0] for map_ in maps))


def evenly(rows: Floats) -> Floats:
    """Return at most N_STYLE_ROWS of the rows, evenly spaced."""
    n = min(len(rows), N_STYLE_ROWS)
    return rows[np.arange(n) * len(rows) // max(n, 1)]


# --- losses ---


def style_features(rendered: Rendered, *, style: Style, weights: FeatureWeights) -> tuple[float, Cotangents]:
    """Return NNFM and content of the rendered image: ``w_n NNFM + w_c content``, by the features of ``style.bank``.

    The content is that of the photograph.
    """
    image = rendered.channel("rgb")
    content, _ = style.bank.features((rendered.view.image / 255).astype(image.dtype))
    maps, tape = style.bank.features(image)
    styles: Sequence[Floats] = [units.astype(image.dtype, copy=False) for units in style.maps]
    value, v_maps = feature_loss(maps, content, styles, weights)
    return value, Cotangents({"rgb": style.bank.features_vjp(tape, v_maps)})


def smoothness(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the total variation of the rendered image."""
    value, v_image = total_variation(rendered.channel("rgb"))
    return value, Cotangents({"rgb": v_image})


# --- actions ---


def split_by_area(
    state: TrainState, iteration: Iteration, *, factor: float, max_share: float, n_children: int, max_ratio: float
) -> str | None:
    """Split Gaussians whose area is above ``mean + factor std``, then shorten long ones."""
    edit = split_large(state.gaussians, factor=factor, max_share=max_share, n_children=n_children)
    apply_edit(state, edit)
    state.gaussians.log_scales[...] = cut_stretch(state.gaussians.log_scales, max_ratio)
    return None if edit.is_new.any() else "no Gaussian is that large"


def split_by_color_gradient(
    state: TrainState, iteration: Iteration, *, max_share: float, n_children: int
) -> str | None:
    """Split the Gaussians whose colour has the largest gradients: they would need more than one colour.

    The gradient is the root of the second moment that Adam keeps of the base colour, its root mean square over recent
    views.
    """
    norms = np.sqrt(state.adam.second.sh_dc.astype(np.float64).sum(axis=1))
    edit = split(state.gaussians, largest(norms, 0.0, max_share), n_children)
    apply_edit(state, edit)
    return None if edit.is_new.any() else "no colour has a gradient"


# --- recipes ---

_split_by_area = partial(split_by_area, max_share=MAX_SHARE, n_children=N_CHILDREN, max_ratio=MAX_RATIO)
RESTRUCTURE = FINE_TUNING._replace(
    name="style-restructure",
    iterations=ITERATIONS,
    events=tuple(
        At((k + 1) * PERIOD, partial(_split_by_area, factor=AREA_FACTOR * AREA_GROWTH**k)) for k in range(N_ROUNDS)
    ),
)
"""The first stage: photographs with the style's colours, and four rounds of splitting and cutting."""


def painting(style: Style, weights: FeatureWeights) -> Recipe:
    """Return the second stage: only base colours are trained, by the losses on features, and colours split."""
    fixed = dict.fromkeys(("means", "quats", "log_scales", "opacity_logits", "sh_rest"), 0.0)
    return FINE_TUNING._replace(
        name="style-paint",
        iterations=ITERATIONS,
        learning_rates=Rates({**fixed, "sh_dc": COLOR_RATE}, frozenset()),
        losses=(
            LossTerm("style_features", partial(style_features, style=style, weights=weights), 1.0),
            LossTerm("smoothness", smoothness, TOTAL_VARIATION),
        ),
        events=(
            Every(
                PERIOD,
                partial(split_by_color_gradient, max_share=COLOR_SHARE, n_children=N_CHILDREN),
                stop=N_ROUNDS * PERIOD + 1,
            ),
        ),
    )
