"""Training of the population: the recipe of 3DGS with the losses of 2D Gaussian Splatting, and changes of kind."""

from functools import partial

import numpy as np

from minisplat_ref.extensions.mixed.kinds import promote_kinds, simplify_kinds
from minisplat_ref.extensions.mixed.population import MixedGaussians, counts, group_gaussians
from minisplat_ref.extensions.mixed.renderer import MIXED_RENDERER
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.surfels.losses import DISTORTION, NORMAL_CONSISTENCY
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.training.schedule import Every
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Bools


def simplify_hulls(state: TrainState, iteration: Iteration, *, least: float, min_height: float) -> str:
    """Take vertices away where they make no difference, by :func:`.kinds.simplify_kinds`."""
    population, changed = simplify_kinds(state.gaussians, least=least, min_height=min_height)
    return _replace_population(state, population, changed)


def promote(state: TrainState, iteration: Iteration, *, ratio: float, size_fraction: float) -> str:
    """Make lines of needles and triangles of discs; see :func:`minisplat_ref.extensions.mixed.kinds.promote_kinds`."""
    size_limit = size_fraction * iteration.scene.extent
    population, changed = promote_kinds(state.gaussians, ratio=ratio, size_limit=size_limit)
    return _replace_population(state, population, changed)


def _replace_population(state: TrainState, population: MixedGaussians, changed: Bools) -> str:
    """Replace the population; primitives that have changed shape lose the moments of their shape."""
    state.gaussians = population
    for moment in (state.adam.first, state.adam.second):
        for name in ("means", "quats", "log_scales", "vertices"):
            getattr(moment, name)[changed] = 0
    n = np.bincount(counts(population), minlength=4)
    return f"{np.count_nonzero(changed)} changed: {n[1]} ellipses, {n[2]} lines, {n[3]} triangles"


MIXED_GAUSSIANS = Representation(
    "ellipses, lines and triangles",
    population=MixedGaussians,
    units={**WORLD_UNITS, "vertices": Unit.LENGTH},
    extend=group_gaussians,
    renderer=MIXED_RENDERER,
    rates=Rates({"vertices": 2e-4, "n_vertices": 0.0}, frozenset({"vertices"})),
)

_changing = partial(Every, 500, stop=15_000, min_gap=100)

MIXED = GS_ACCEL._replace(
    name="mixed",
    losses=(*GS_ACCEL.losses, NORMAL_CONSISTENCY, DISTORTION),
    events=(
        *GS_ACCEL.events,
        _changing(partial(simplify_hulls, least=0.5, min_height=0.5), start=1_000),
        _changing(partial(promote, ratio=6.0, size_fraction=0.01), start=1_000),
    ),
)
"""``mixed``: 3DGS with ellipses, lines and triangles, and the losses of surfels."""
