"""3DGS (Kerbl et al. 2023): its density control and opacity reset as actions, and their schedule.

The mathematics is in :mod:`minisplat_ref.strategy.clone_split`; an action takes its arguments from the training state
and stores the result there. ``3dgs`` is the method as released, ``3dgs-accel`` the same with the authors' later
optimiser.
"""

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from minisplat_ref.strategy import clone_split
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.adam import AdamRule
from minisplat_ref.training.losses import LossTerm, photometric
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.schedule import At, During, Every, Recipe
from minisplat_ref.training.state import Iteration, TrainState, apply_edit, n_pixels
from minisplat_ref.types import Floats, Gaussians


def collect_gradients(state: TrainState, iteration: Iteration) -> None:
    """Add the view's positional gradients to ``stats["gradient_sum"]`` and count it in ``stats["view_count"]``.

    While views are culled (Mini-Splatting2), ``stats["gradient_factor"]`` is the fraction of its views in which a
    Gaussian is still rendered; gradients are multiplied by it, so that their mean, like the threshold, refers to all
    views.
    """
    n = n_rows(state.gaussians)
    if "gradient_sum" not in state.stats:
        state.stats["gradient_sum"] = np.zeros(n, iteration.v_means2d.dtype)
        state.stats["view_count"] = np.zeros(n, np.int32)
    ids, camera = iteration.visible_ids, iteration.view.camera
    norms = clone_split.screen_gradient_norms(iteration.v_means2d[ids], camera.width, camera.height)
    if "gradient_factor" in state.stats:
        norms = norms * state.stats["gradient_factor"][ids]
    state.stats["gradient_sum"][ids] += norms
    state.stats["view_count"][ids] += 1


def clone_and_split(
    state: TrainState,
    iteration: Iteration,
    *,
    threshold: float,
    size_fraction: float,
    draw_children: Callable[..., Gaussians] = clone_split.random_children,
    max_per_pixel: float = math.inf,
) -> str | None:
    """Densify where the mean of the collected gradients reaches ``threshold``, and reset the collected gradients.

    Gaussians larger than ``size_fraction`` of the scene's extent are split, the others cloned; those that
    ``stats["is_blurred"]`` marks are split whatever their size and gradient (Mini-Splatting). While there are
    ``max_per_pixel`` Gaussians or more for each pixel of the training views, gradients are only collected.
    """
    if n_rows(state.gaussians) >= max_per_pixel * n_pixels(iteration.scene):
        return "paused: as many Gaussians as max_per_pixel allows"
    means = state.stats.pop("gradient_sum") / np.maximum(state.stats.pop("view_count"), 1)
    is_blurred = state.stats.pop("is_blurred", None)
    edit = clone_split.clone_and_split(
        state.gaussians,
        means,
        is_blurred=is_blurred,
        threshold=threshold,
        size_limit=size_fraction * iteration.scene.extent,
        draw_children=draw_children,
        rng=state.rng,
    )
    apply_edit(state, edit)
    return None


def prune_faint(state: TrainState, iteration: Iteration, *, min_opacity: float) -> None:
    """Remove Gaussians of opacity below ``min_opacity``."""
    apply_edit(state, clone_split.prune_faint(state.gaussians, min_opacity=min_opacity))


def prune_large(state: TrainState, iteration: Iteration, *, size_fraction: float) -> None:
    """Remove Gaussians larger than ``size_fraction`` of the scene's extent."""
    size_limit = size_fraction * iteration.scene.extent
    apply_edit(state, clone_split.prune_large(state.gaussians, size_limit=size_limit))


def reset_opacity(state: TrainState, iteration: Iteration, *, ceiling: float) -> None:
    """Lower all opacities to at most ``ceiling`` and forget their moments, which point back up."""
    lower_opacities(state, clone_split.cap_opacity_logits(state.gaussians.opacity_logits, ceiling=ceiling))


def lower_opacities(state: TrainState, opacity_logits: Floats) -> None:
    """Set the logits [N] of the opacities and forget their moments."""
    state.gaussians = state.gaussians._replace(opacity_logits=opacity_logits)
    for moment in (state.adam.first, state.adam.second):
        moment.opacity_logits[:] = 0


def reset_opacity_on_white(state: TrainState, iteration: Iteration, *, ceiling: float) -> str | None:
    """Do :func:`reset_opacity` if the background is white, where early floaters hide best."""
    if not np.all(iteration.scene.background == 1.0):
        return "nothing done: the background is not white"
    reset_opacity(state, iteration, ceiling=ceiling)
    return None


# Densification needs the mean gradient over nearly all views, and time to settle: each event up to doubles the number
# of Gaussians, so it would explode if events were compressed to every few iterations. After an opacity reset, Gaussians
# need a few hundred iterations to become opaque again.
DENSIFY_LEAST_GAP = 100
_densifying = partial(Every, 100, stop=15_000, min_gap=DENSIFY_LEAST_GAP)

GS = Recipe(
    name="3dgs",
    iterations=30_000,
    learning_rates=Rates(
        {
            "means": LogLinear(1.6e-4, 1.6e-6, 30_000),
            "quats": 1e-3,
            "log_scales": 5e-3,
            "opacity_logits": 5e-2,
            "sh_dc": 2.5e-3,
            "sh_rest": 2.5e-3 / 20,
        }
    ),
    adam=AdamRule(is_visible_only=False, has_bias_correction=True),
    sh_degree=3,
    sh_milestones=(1_000, 2_000, 3_000),
    losses=(LossTerm("photometric", partial(photometric, dssim_weight=0.2), weight=1.0),),
    has_random_background=False,
    events=(
        During(collect_gradients, stop=15_000, reads_parameters=False),
        _densifying(partial(clone_and_split, threshold=2e-4, size_fraction=0.01), start=500),
        _densifying(partial(prune_faint, min_opacity=0.005), start=500),
        _densifying(partial(prune_large, size_fraction=0.1), start=3_000),
        Every(3_000, partial(reset_opacity, ceiling=0.01), stop=15_000, min_gap=300),
        At(500, partial(reset_opacity_on_white, ceiling=0.01)),
    ),
)
"""``3dgs``."""

FINE_TUNING = GS._replace(
    name="fine-tuning",
    learning_rates=GS.learning_rates.change(**GS.learning_rates.at(GS.iterations, extent=1.0)),
    sh_milestones=(0, 0, 0),
    events=(),
)
"""3DGS after its last iteration: the means at their last rate, all harmonics, and the number of Gaussians stays."""

GS_ACCEL = GS._replace(
    name="3dgs-accel",
    learning_rates=GS.learning_rates.change(opacity_logits=2.5e-2),
    adam=AdamRule(is_visible_only=True, has_bias_correction=False),
)
"""``3dgs-accel``."""
