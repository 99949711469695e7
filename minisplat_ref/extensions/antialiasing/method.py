"""The population with a filter for each Gaussian, its renderer, and the recipe that trains it."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.antialiasing.reference import VARIANCE, cap_smoothed_logits, smooth, smooth_vjp
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.sampling import sampling_intervals
from minisplat_ref.methods.gaussian_splatting import (
    DENSIFY_LEAST_GAP,
    GS_ACCEL,
    lower_opacities,
    reset_opacity,
    reset_opacity_on_white,
)
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.training.schedule import Action, At, Every, action_name
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats, Gaussians, Model, RenderOutput, View

EPS2D = 0.1  # px^2, the variance of Mip-Splatting's 2D filter; that of a pixel is 1/12


class FilteredGaussians(NamedTuple):
    """Gaussians with 3D filters: the fields of :class:`Gaussians` and one more."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    filter_sigmas: Floats
    """[N] standard deviation of the 3D filter, world units; 0 for no filter. An event sets it; it has no gradient."""


class _Tape(NamedTuple):
    inner: Any  # tape of the wrapped renderer
    gaussians: FilteredGaussians


def add_filters(gaussians: Gaussians, rng: np.random.Generator) -> FilteredGaussians:
    """Return the Gaussians with filters of size zero, which an event measures later."""
    return FilteredGaussians(**gaussians._asdict(), filter_sigmas=np.zeros_like(gaussians.opacity_logits))


def apply_filters(g: FilteredGaussians) -> Gaussians:
    """Return the Gaussians of 3DGS after the 3D filter."""
    log_scales, opacity_logits = smooth(g.log_scales, g.opacity_logits, g.filter_sigmas)
    return Gaussians(g.means, g.quats, log_scales, opacity_logits, g.sh_dc, g.sh_rest)


def with_3d_filter(inner: Renderer) -> Renderer:
    """Return a renderer that filters the Gaussians in space before ``inner`` renders them."""

    def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, _Tape]:
        output, tape = inner.render(model._replace(gaussians=apply_filters(model.gaussians)), view, request)
        return output, _Tape(tape, model.gaussians)

    def render_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
        v, g = inner.render_vjp(tape.inner, v_image, v_alpha), tape.gaussians
        v_log_scales, v_logits, v_sigmas = smooth_vjp(
            g.log_scales, g.opacity_logits, g.filter_sigmas, v.gaussians.log_scales, v.gaussians.opacity_logits
        )
        v_drawn = v.gaussians._replace(log_scales=v_log_scales, opacity_logits=v_logits)
        return v._replace(gaussians=FilteredGaussians(**v_drawn._asdict(), filter_sigmas=v_sigmas))

    return Renderer(f"{inner.name} with 3D filter", render, render_vjp, inner.channels)


def with_2d_filter(inner: Renderer) -> Renderer:
    """Return a renderer that blurs footprints by ``EPS2D`` and keeps their integrals; 3DGS dilates by 0.3 px^2."""

    def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
        conventions = request.conventions._replace(eps2d=EPS2D, is_antialiased=True)
        return inner.render(model, view, request._replace(conventions=conventions))

    return Renderer(f"{inner.name} with 2D filter", render, inner.render_vjp, inner.channels)


def measure_filters(state: TrainState, iteration: Iteration, *, variance: float) -> None:
    """Set each filter's variance to ``variance`` times the squared smallest sampling interval of the training views."""
    cameras = [view.camera for view in iteration.scene.train_views]
    g = state.gaussians
    sigmas = np.sqrt(variance) * sampling_intervals(g.means, cameras)
    state.gaussians = g._replace(filter_sigmas=sigmas.astype(g.filter_sigmas.dtype))


def reset_smoothed_opacity(state: TrainState, iteration: Iteration, *, ceiling: float) -> None:
    """Lower opacities until those of the filtered Gaussians are at most ``ceiling``, and forget their moments."""
    g = state.gaussians
    lower_opacities(state, cap_smoothed_logits(g.log_scales, g.opacity_logits, g.filter_sigmas, ceiling))


def reset_smoothed_opacity_on_white(state: TrainState, iteration: Iteration, *, ceiling: float) -> str | None:
    """Do :func:`reset_smoothed_opacity` if the background is white."""
    if not np.all(iteration.scene.background == 1.0):
        return "nothing done: the background is not white"
    reset_smoothed_opacity(state, iteration, ceiling=ceiling)
    return None


MIP = with_3d_filter(with_2d_filter(SPLATTING))
"""Mip-Splatting's renderer."""

FILTERED = Representation(
    "filtered Gaussians",
    population=FilteredGaussians,
    units={**WORLD_UNITS, "filter_sigmas": Unit.LENGTH},
    extend=add_filters,
    renderer=MIP,
    rates=Rates({"filter_sigmas": 0.0}, frozenset()),
)

_measure = partial(measure_filters, variance=VARIANCE)
_RESETS: dict[str, Action] = {
    reset_opacity.__name__: partial(reset_smoothed_opacity, ceiling=0.01),
    reset_opacity_on_white.__name__: partial(reset_smoothed_opacity_on_white, ceiling=0.01),
}

ANTIALIASING = GS_ACCEL._replace(
    name="antialiasing",
    events=(
        *(
            event._replace(action=_RESETS[action_name(event)]) if action_name(event) in _RESETS else event
            for event in GS_ACCEL.events
        ),
        At(1, _measure),
        Every(100, _measure, min_gap=DENSIFY_LEAST_GAP // 2),
    ),
)
"""The recipe ``antialiasing``: 3DGS with Mip-Splatting's two filters."""
