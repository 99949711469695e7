"""The population with velocities, its renderer, and the recipe that trains it."""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.velocity.reference import means_at, means_at_vjp
from minisplat_ref.io.frames import Unit
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.types import Floats, Gaussians, Model, RenderOutput, View


class MovingGaussians(NamedTuple):
    """Gaussians that move: the fields of :class:`Gaussians`, and one more."""

    means: Floats
    """[N, 3] centres at time 0, world frame."""
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    velocities: Floats
    """[N, 3] world units per unit of time."""


class _Tape(NamedTuple):
    inner: Any  # of the renderer of 3DGS
    time: float


def at_rest(gaussians: Gaussians, rng: np.random.Generator) -> MovingGaussians:
    """Return the Gaussians with velocities of zero."""
    return MovingGaussians(**gaussians._asdict(), velocities=np.zeros_like(gaussians.means))


def still_at(moving: MovingGaussians, time: float) -> Gaussians:
    """Return the Gaussians of 3DGS at the places of these at a time."""
    still = Gaussians(*(getattr(moving, name) for name in Gaussians._fields))
    return still._replace(means=means_at(moving.means, moving.velocities, time))


def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, _Tape]:
    """Render the scene at the time of the view."""
    still = still_at(model.gaussians, view.time)
    output, tape = SPLATTING.render(model._replace(gaussians=still), view, request)
    return output, _Tape(tape, view.time)


def render_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
    """Gradient of :func:`render`: that of 3DGS, carried on to the velocities."""
    v = SPLATTING.render_vjp(tape.inner, v_image, v_alpha)
    v_means, v_velocities = means_at_vjp(tape.time, v.gaussians.means)
    v_still = v.gaussians._replace(means=v_means)
    return v._replace(gaussians=MovingGaussians(**v_still._asdict(), velocities=v_velocities))


MOVING = Representation(
    "moving Gaussians",
    population=MovingGaussians,
    units={**WORLD_UNITS, "velocities": Unit.LENGTH},
    extend=at_rest,
    renderer=Renderer("velocity", render, render_vjp, SPLATTING.channels),
    # In one unit of time a Gaussian goes as far as its velocity: the rate of the means, per extent as theirs, and five
    # times as large, since a view at time t passes only a part t of its gradient on.
    rates=Rates({"velocities": LogLinear(8e-4, 8e-6, 30_000)}, frozenset({"velocities"})),
)

VELOCITY = GS_ACCEL._replace(name="velocity")
"""``velocity``: 3DGS with linear motion."""
