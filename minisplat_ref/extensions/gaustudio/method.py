"""The recipe: 3DGS with a ball behind it, in which every stage is a setting that names one of several functions."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.gaustudio import (
    backgrounds,
    densities,
    initialisers,
    losses,
    representations,
    sky_masks,
)
from minisplat_ref.extensions.gaustudio.backgrounds import Background
from minisplat_ref.extensions.gaustudio.representations import Primitive
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL, clone_and_split
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request
from minisplat_ref.training.calibration import BACKDROP
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import At, Event, Every, does
from minisplat_ref.training.sky import SKY
from minisplat_ref.training.state import Iteration, TrainState, start_again
from minisplat_ref.types import Floats, Gaussians, Model, RenderOutput, Scene, View

SKY_RATE = 5e-3  # of sizes in 3DGS, between those of colours and of opacities
SKY_WEIGHT = 0.1


class _Tape(NamedTuple):
    renderer: Renderer
    inner: Any


def render(
    model: Model,
    view: View,
    request: Request,
    *,
    representation: Callable[[], Primitive],
    background: Callable[[], Background],
) -> tuple[RenderOutput, _Tape]:
    """Render primitives of one kind before a background of one kind."""
    renderer = background().wrap(representation().renderer)
    output, tape = renderer.render(model, view, request)
    return output, _Tape(renderer, tape)


def render_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
    """Gradient of :func:`render`: that of the renderer that was composed."""
    return tape.renderer.render_vjp(tape.inner, v_image, v_alpha)


def extend(gaussians: Gaussians, rng: np.random.Generator, *, representation: Callable[[], Primitive]) -> Gaussians:
    """Make primitives of Gaussians."""
    return representation().extend(gaussians, rng)


def shared(scene: Scene, rng: np.random.Generator, *, background: Callable[[], Background]) -> Mapping[str, Floats]:
    """Return the initial parameter of the background."""
    return background().initial()


def initialise(
    state: TrainState,
    iteration: Iteration,
    *,
    initialiser: Callable[[Gaussians, Scene, np.random.Generator], Gaussians | None],
) -> str | None:
    """Start again with other Gaussians, if the initialiser has any; the first iteration showed those of the points."""
    begun = initialiser(state.gaussians, iteration.scene, state.rng)
    if begun is None:
        return "nothing done: begins with the points"
    start_again(state, iteration, begun)
    return None


def control_density(
    state: TrainState, iteration: Iteration, *, density: Callable[[TrainState, Iteration], str | None]
) -> str | None:
    """Densify."""
    return density(state, iteration)


def _with_density(event: Event) -> Event:
    """Return an event of 3DGS; its densification becomes that of the stage, at the same dates."""
    if isinstance(event, Every) and does(event, clone_and_split):
        return event._replace(action=partial(control_density, density=densities.clones))
    return event


STUDIO = Representation(
    "gaustudio",
    extend=partial(extend, representation=representations.gaussians),
    shared=partial(shared, background=backgrounds.ball),
    renderer=Renderer(
        "gaustudio",
        partial(render, representation=representations.gaussians, background=backgrounds.ball),
        render_vjp,
        SPLATTING.channels,
    ),
    rates=Rates({SKY: SKY_RATE}, frozenset()),
)
RECIPE = GS_ACCEL._replace(
    name="gaustudio",
    losses=(
        LossTerm("photometric", partial(losses.compare, photo_loss=losses.l1_and_dssim), 1.0),
        LossTerm(
            "sky_opacity",
            partial(losses.sky_opacity, sky_mask=sky_masks.by_color, mask_folder=""),
            SKY_WEIGHT,
        ),
    ),
    events=(
        At(1, partial(initialise, initialiser=initialisers.points)),
        *map(_with_density, GS_ACCEL.events),
    ),
    # The sky that other recipes switch on is the background ``harmonics`` here.
    calibrations=tuple(calibration for calibration in GS_ACCEL.calibrations if calibration is not BACKDROP),
    representation=STUDIO,
)
"""``gaustudio``."""
