"""The renderer, its gradient check, and the recipe, in which every stage is a setting that names a function."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.gaustudio import alternatives, backgrounds
from minisplat_ref.extensions.gaustudio.alternatives import Primitive
from minisplat_ref.extensions.gaustudio.backgrounds import Background, white_ball
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL, clone_and_split
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.calibration import BACKDROP
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import At, Event, Every, does
from minisplat_ref.training.sky import SKY, clear_sky
from minisplat_ref.training.state import Iteration, TrainState, start_again
from minisplat_ref.types import Bools, Floats, Gaussians, Model, RenderOutput, Scene, View

SKY_RATE = 5e-3  # of sizes in 3DGS, between those of colours and of opacities
SKY_WEIGHT = 0.1


class _Tape(NamedTuple):
    renderer: Renderer
    inner: Any


def render_studio(
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


def render_studio_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
    """Gradient of :func:`render_studio`: that of the renderer that was composed."""
    return tape.renderer.render_vjp(tape.inner, v_image, v_alpha)


def extend(gaussians: Gaussians, rng: np.random.Generator, *, representation: Callable[[], Primitive]) -> Gaussians:
    """Make primitives of Gaussians."""
    return representation().extend(gaussians, rng)


def shared(scene: Scene, rng: np.random.Generator, *, background: Callable[[], Background]) -> Mapping[str, Floats]:
    """Return the initial parameter of the background."""
    return background().initial()


STUDIO = Representation(
    "gaustudio",
    extend=partial(extend, representation=alternatives.gaussians),
    shared=partial(shared, background=backgrounds.ball),
    renderer=Renderer(
        "gaustudio",
        partial(render_studio, representation=alternatives.gaussians, background=backgrounds.ball),
        render_studio_vjp,
        SPLATTING.channels,
    ),
    rates=Rates({SKY: SKY_RATE}, frozenset()),
)


SMALL: dict[str, Floats] = {
    "ball": white_ball(24).astype(float),
    "sky_map": np.full((4, 8, 3), 0.5),
    "harmonics": clear_sky(0)[SKY].astype(float),
}


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the stages; the first replaces that of the renderer as a whole, whose ball is larger."""
    chosen = [
        composed(STUDIO.name, backgrounds.ball),
        composed("gaustudio, harmonics", backgrounds.harmonics),
        composed("gaustudio, map", backgrounds.sky_map),
    ]
    return tuple(model_stage(backend, setting, representation, rng) for representation in chosen)


def composed(name: str, background: Callable[[], Background]) -> Representation:
    """Return the representation with this background, whose parameter is small."""

    def shared(scene: object, rng: object) -> Mapping[str, Floats]:
        return {SKY: SMALL[background.__name__]}

    render = partial(render_studio, representation=alternatives.gaussians, background=background)
    return STUDIO._replace(name=name, shared=shared, renderer=STUDIO.renderer._replace(render=render))


# --- losses, actions, recipe ---


def mean_opacity(alpha: Floats, is_sky: Bools) -> tuple[float, Floats]:
    """Return the mean opacity of the scene in a mask [H, W], and its derivative [H, W]: 0 where the mask is empty.

    ::

        L = 1 / |M| sum_{p in M} alpha_p,   v_alpha_p = 1 / |M| within M
    """
    n = max(int(np.count_nonzero(is_sky)), 1)
    return float(np.sum(alpha[is_sky], dtype=np.float64)) / n, (is_sky / n).astype(alpha.dtype)


def compare(
    rendered: Rendered, *, photo_loss: Callable[[Rendered], tuple[float, Cotangents]]
) -> tuple[float, Cotangents]:
    """Compare the image with the photograph."""
    return photo_loss(rendered)


def sky_opacity(
    rendered: Rendered, *, sky_mask: Callable[[View, str], Bools | None], mask_folder: str
) -> tuple[float, Cotangents]:
    """Return the mean opacity of the scene, without its background, in the sky of the photograph."""
    is_sky = sky_mask(rendered.view, mask_folder)
    if is_sky is None or not is_sky.any():
        return 0.0, Cotangents()
    value, v_alpha = mean_opacity(rendered.output.alpha, is_sky)
    return value, Cotangents(alpha=v_alpha)


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
        return event._replace(action=partial(control_density, density=alternatives.clones))
    return event


RECIPE = GS_ACCEL._replace(
    name="gaustudio",
    losses=(
        LossTerm("photometric", partial(compare, photo_loss=alternatives.l1_and_dssim), 1.0),
        LossTerm(
            "sky_opacity",
            partial(sky_opacity, sky_mask=alternatives.by_color, mask_folder=""),
            SKY_WEIGHT,
        ),
    ),
    events=(
        At(1, partial(initialise, initialiser=alternatives.points)),
        *map(_with_density, GS_ACCEL.events),
    ),
    # The sky that other recipes switch on is the background ``harmonics`` here.
    calibrations=tuple(calibration for calibration in GS_ACCEL.calibrations if calibration is not BACKDROP),
    representation=STUDIO,
)
"""``gaustudio``."""
