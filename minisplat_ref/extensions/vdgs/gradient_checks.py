"""Stages for the gradient check: the renderer in four modes, with a small network and a small table.

ReLUs, the faces of the grid's cells and the bounds of opacity are kinks, whose sides are part of a point. The two
modes that are not here are parts of those that change both.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from minisplat_ref.extensions.vdgs import modes
from minisplat_ref.extensions.vdgs.method import (
    CENTER,
    NAME,
    RADIUS,
    TABLE,
    VIEW_DEPENDENT,
    Tape,
    as_seen,
    levels_of,
    n_outputs,
    render,
)
from minisplat_ref.mechanisms.networks.contraction import contract
from minisplat_ref.mechanisms.networks.mlp import make_network, to_shared
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats

HIDDEN, N_LEVELS, N_ROWS = 3, 1, 8  # one coarse level: between many faces, steps are so small that they round
MODES = (modes.opacity_times, modes.colors_plus, modes.both_times, modes.both_plus)


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return one stage for each mode; the first replaces that of the renderer as a whole."""
    return tuple(_stage(backend, setting, modulation, rng) for modulation in MODES)


def small_shared(modulation: Callable[[], modes.Mode], n_colors: int, rng: np.random.Generator) -> dict[str, Floats]:
    """Return a network and a table of which every number can be checked."""
    mode = modulation()
    n = mode.opacity + n_colors * mode.colors
    network = make_network((3 + N_LEVELS, HIDDEN, min(n, n_outputs(mode))), rng)
    shared = {name: 0.3 * array for name, array in to_shared(NAME, network).items()}
    table = rng.normal(size=(N_LEVELS, N_ROWS, 1))
    return {**shared, TABLE: table, CENTER: np.zeros(3), RADIUS: np.array([2.0])}


def _stage(backend: Backend, setting: Setting, modulation: Callable[[], modes.Mode], rng: np.random.Generator) -> Stage:
    shared = small_shared(modulation, 3 * (1 + setting.gaussians.sh_rest.shape[1]), rng)
    is_first = modulation is MODES[0]
    representation = VIEW_DEPENDENT._replace(
        name=VIEW_DEPENDENT.name if is_first else f"{VIEW_DEPENDENT.name}, {modulation.__name__}",
        shared=lambda scene, rng: shared,
        renderer=VIEW_DEPENDENT.renderer._replace(render=partial(render, modulation=modulation)),
    )
    return model_stage(backend, setting, representation, rng, sides_of=lambda drawn: _sides(drawn.tape[1]))


def _sides(tape: Tape) -> tuple[Any, ...]:
    """Return the ReLUs that are on, the cells of the grid, and which opacities are at no bound."""
    means, shared = tape.model.gaussians.means, tape.model.shared
    places = (contract((means - shared[CENTER]) / shared[RADIUS]) + 2) / 4
    cells = [np.floor(places * n) for n in levels_of(shared[TABLE]).resolutions]
    bounds = () if tape.opacities is None else (tape.opacities.is_free,)
    hidden = as_seen(tape.model, tape.camera, tape.mode, IN_NUMPY)[1].inputs[1]  # kernels keep them otherwise
    return (hidden > 0, *cells, *bounds)
