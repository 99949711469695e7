"""The warp as shared parameters, the renderer that moves Gaussians by it, and the recipe."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.lucas_kanade.losses import depth_order, flow
from minisplat_ref.extensions.lucas_kanade.moving import (
    CENTERS,
    GROWTHS,
    LOG_WIDTH,
    SHIFTS,
    TURNS,
    Moved,
    moved,
    moved_vjp,
)
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.motion.field import choose_centers
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.types import Floats, Model, RenderOutput, Scene, View


class _Tape(NamedTuple):
    inner: Any  # of the renderer of 3DGS
    moved: Moved


def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, _Tape]:
    """Render the scene at the time of the view."""
    there = moved(model, view.time)
    output, tape = SPLATTING.render(model._replace(gaussians=there.gaussians), view, request)
    return output, _Tape(tape, there)


def render_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
    """Gradient of :func:`render`: that of 3DGS, propagated to the Gaussians of time 0 and to the warp."""
    v = SPLATTING.render_vjp(tape.inner, v_image, v_alpha)
    gaussians, shared = moved_vjp(tape.moved, v.gaussians)
    return v._replace(gaussians=gaussians, shared={**v.shared, **shared})


def first_warp(scene: Scene, rng: np.random.Generator, *, n_centers: int, degree: int) -> Mapping[str, Floats]:
    """Return a warp that moves nothing, with centres among the points of the scene.

    Parameters
    ----------
    scene : Scene
    rng : numpy.random.Generator
    n_centers : int
        B, at most.
    degree : int
        P, of the polynomials of time.

    Raises
    ------
    InputError
        All photographs have the same time, or a number is below 1.
    """
    if n_centers < 1 or degree < 1:
        raise InputError(f"n_centers={n_centers} and degree={degree} are numbers from 1 on")
    times = {view.time for view in scene.train_views}
    if len(scene.train_views) > 1 and len(times) == 1:
        raise InputError(
            f"scene {scene.name} is no sequence: all its photographs have the time {times.pop():g}; give each frame of"
            ' transforms.json a "time", or train 3dgs-accel'
        )
    points = scene.points if len(scene.points) else scene.extent * rng.uniform(-1, 1, size=(8 * n_centers, 3))
    centers, width = choose_centers(points, n_centers, rng)
    b = len(centers)
    return {
        CENTERS: centers.astype(np.float32),
        LOG_WIDTH: np.array([np.log(width)], np.float32),
        SHIFTS: np.zeros((b, degree, 3), np.float32),
        TURNS: np.zeros((b, degree, 3), np.float32),
        GROWTHS: np.zeros((b, degree, 1), np.float32),
    }


WARPED = Representation(
    "warped Gaussians",
    shared=partial(first_warp, n_centers=32, degree=3),
    renderer=Renderer("lucas-kanade", render, render_vjp, SPLATTING.channels),
    # Adam moves a coefficient by about its rate per iteration. A body moves by a tenth of the extent or so in one unit
    # of time, and turns by a radian: 1,000 iterations go ten times as far. Centres move as the means do.
    rates=Rates(
        {
            CENTERS: LogLinear(1.6e-4, 1.6e-6, 30_000),
            LOG_WIDTH: LogLinear(1e-3, 1e-5, 30_000),
            SHIFTS: LogLinear(1e-3, 1e-5, 30_000),
            TURNS: LogLinear(2e-3, 2e-5, 30_000),
            GROWTHS: LogLinear(1e-3, 1e-5, 30_000),
        },
        frozenset({CENTERS, SHIFTS}),
    ),
    units={**WORLD_UNITS, CENTERS: Unit.PLACE, LOG_WIDTH: Unit.LOG_LENGTH, SHIFTS: Unit.LENGTH},
)

LUCAS_KANADE = GS_ACCEL._replace(
    name="lucas-kanade",
    losses=(
        *GS_ACCEL.losses,
        LossTerm("flow", partial(flow, flows=""), 5.0),
        LossTerm("depth_order", partial(depth_order, depths="", margin=0.01), 0.0, frozenset({"depth"})),
    ),
)
"""``lucas-kanade``: 3DGS with a warp, and with a loss that compares its flow with that of the photographs."""
