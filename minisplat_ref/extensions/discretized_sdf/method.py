"""The renderer, the density control and the recipe of surfels with signed distances."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.discretized_sdf.losses import median, projection, silhouette
from minisplat_ref.extensions.discretized_sdf.population import (
    LOG_WIDTH,
    WIDTH,
    SDFSurfels,
    first_shared,
    with_distances,
)
from minisplat_ref.extensions.discretized_sdf.reference import opacity_logits, opacity_logits_vjp
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.gbuffer import renderer as shaded
from minisplat_ref.mechanisms.gbuffer.training import NORMALS, SHADING_EVENTS, SHADING_RATES
from minisplat_ref.mechanisms.surfels.discs import DISC_EVENTS
from minisplat_ref.mechanisms.surfels.losses import distortion
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL, reset_opacity, reset_opacity_on_white
from minisplat_ref.rendering import Renderer, RenderGradient, Request
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.training.schedule import During, Event, does
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats, Model, RenderOutput, View


class SDFTape(NamedTuple):
    """The values that :func:`render` keeps for :func:`render_vjp`."""

    shaded: shaded.ReflectiveTape
    distances: Floats  # [N]
    log_width: Floats  # [1]


def render(
    model: Model, view: View, request: Request, visibility: Floats | None = None, *, mirrors: bool
) -> tuple[RenderOutput, SDFTape]:
    """Render surfels with the opacities of their distances, as :mod:`minisplat_ref.mechanisms.gbuffer.renderer`.

    Raises
    ------
    InputError
        The model has no gamma.
    """
    if LOG_WIDTH not in model.shared:
        raise InputError("a file of surfels with distances has no place for gamma and light: render the run's folder")
    g, log_width = model.gaussians, model.shared[LOG_WIDTH]
    opaque = model._replace(gaussians=g._replace(opacity_logits=opacity_logits(g.distances, log_width)))
    output, tape = shaded.render_reflective(opaque, view, request, visibility, mirrors=mirrors)
    return output, SDFTape(tape, g.distances, log_width)


def render_vjp(tape: SDFTape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render`: that of the logits passes to distances and gamma."""
    v = shaded.render_reflective_vjp(tape.shaded, v_image, v_alpha)
    v_logits = v.gaussians.opacity_logits
    v_distances, v_log_width = opacity_logits_vjp(tape.distances, tape.log_width, v_logits)
    gaussians = v.gaussians._replace(opacity_logits=np.zeros_like(v_logits), distances=v_distances)
    shared = {**v.shared, LOG_WIDTH: v_log_width.astype(tape.log_width.dtype)}
    return v._replace(gaussians=gaussians, shared=shared)


def refresh_opacities(state: TrainState, iteration: Iteration) -> None:
    """Write the opacities of the distances into the population, where other actions and files read them."""
    g = state.gaussians
    g.opacity_logits[:] = opacity_logits(g.distances, state.shared[LOG_WIDTH])


def reset_distances(state: TrainState, iteration: Iteration, *, ceiling: float) -> None:
    """Move centres away from the surface, without moving them, until no opacity is above ``ceiling``.

    ``|s|`` becomes at least ``2 arsinh(exp(-l / 2)) / gamma`` with the logit l of the ceiling. Signs stay, and the
    moments of the distances are forgotten, because they point back.
    """
    g, width = state.gaussians, np.exp(state.shared[LOG_WIDTH].astype(np.float64))
    least = 2 * width * np.arcsinh(np.sqrt((1 - ceiling) / ceiling))
    sign = np.where(g.distances < 0, -1, 1)
    g.distances[:] = sign * np.maximum(np.abs(g.distances), least)
    for moment in (state.adam.first, state.adam.second):
        moment.distances[:] = 0
    refresh_opacities(state, iteration)


def reset_distances_on_white(state: TrainState, iteration: Iteration, *, ceiling: float) -> str | None:
    """Do :func:`reset_distances` if the background is white, where early floaters hide best."""
    if not np.all(iteration.scene.background == 1.0):
        return "nothing done: the background is not white"
    reset_distances(state, iteration, ceiling=ceiling)
    return None


def _of_distances(event: Event) -> Event:
    """Return an event of surfels, with distances reset where it resets opacities."""
    for action, own in ((reset_opacity, reset_distances), (reset_opacity_on_white, reset_distances_on_white)):
        if does(event, action):
            bound: Any = event.action
            return event._replace(action=partial(own, **bound.keywords))
    return event


RENDERER = Renderer("surfels with distances", partial(render, mirrors=True), render_vjp, shaded.channels)
RATES = SHADING_RATES.join(Rates({"distances": 0.025 * WIDTH, LOG_WIDTH: 1e-3, "opacity_logits": 0.0}, frozenset()))
DISTANCED = Representation(
    "surfels with distances",
    population=SDFSurfels,
    extend=partial(with_distances, foreground=0.5),
    shared=first_shared,
    renderer=RENDERER,
    rates=RATES,
    units={**WORLD_UNITS, "distances": Unit.LENGTH, LOG_WIDTH: Unit.LOG_LENGTH},
)
RECIPE = GS_ACCEL._replace(
    name="discretized-sdf",
    learning_rates=GS_ACCEL.learning_rates.change(opacity_logits=0.0),
    losses=(
        *GS_ACCEL.losses,
        NORMALS._replace(weight=0.2),
        LossTerm("distortion", distortion, 100.0, frozenset({"spread"}), start=3_000),
        LossTerm("projection", partial(projection, reach=0.1), 1.0, frozenset({"depth"})),
        LossTerm("median", median, 100.0, start=1_000),
        LossTerm("silhouette", silhouette, 1e-3),
    ),
    events=(During(refresh_opacities), *map(_of_distances, DISC_EVENTS), *SHADING_EVENTS),
)
"""``discretized-sdf``: Ref-Gaussian's stages with the opacities of distances, and the losses on these."""
