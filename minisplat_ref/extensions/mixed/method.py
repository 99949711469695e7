"""How ellipses, lines and triangles are drawn, and the recipe that trains them."""

from functools import partial

import numpy as np

from minisplat_ref.extensions.mixed.kernels import response_for
from minisplat_ref.extensions.mixed.kinds import promote_kinds, simplify_kinds
from minisplat_ref.extensions.mixed.population import MixedGaussians, counts, group_gaussians
from minisplat_ref.extensions.mixed.projection import Hulls, footprints_of, footprints_vjp
from minisplat_ref.extensions.mixed.response import RESPONSE, HullFootprints
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.payload.renderer import Payload, PayloadGradient, Projected, payload_renderer
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.training.schedule import Every
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Bools, Floats, Projection

BOUNDLESS = np.array([1e-12, 0.0, 1e-12])  # px^-2: a million pixels


def _is_plain(g: MixedGaussians) -> bool:
    return bool(np.all(counts(g) == 1))


def _hulls(projected: Projected) -> Hulls:
    g: MixedGaussians = projected.gaussians
    return Hulls(projected.primitives, g.vertices, counts(g))


def _footprints(projected: Projected) -> HullFootprints:
    return footprints_of(_hulls(projected), projected.projection, projected.camera, projected.conventions)


def _footprints_vjp(projected: Projected, v: tuple[Floats, ...]) -> PayloadGradient:
    """Gradient of :func:`_footprints` for that with respect to the vertices in the image."""
    (v_vertices,) = v
    found = footprints_vjp(_hulls(projected), projected.camera, projected.conventions, v_vertices)
    fields = {"vertices": found.vertices, "n_vertices": np.zeros_like(projected.gaussians.n_vertices)}
    v_scales = np.zeros_like(projected.primitives.scales)
    return PayloadGradient(fields, found.means, found.quats, v_scales, found.cam_from_world_R, found.cam_from_world_t)


def _list_boxes(footprints: HullFootprints) -> Projection:
    """Return the projection with ellipses that reach all tiles under the boxes of lines and triangles."""
    projection = footprints.projection
    conics = np.where((footprints.n_vertices > 1)[:, None], BOUNDLESS, projection.conics)
    return projection._replace(conics=conics)


PAYLOAD = Payload(
    "lines and triangles", RESPONSE, response_for, _is_plain, _footprints, _footprints_vjp, listed=_list_boxes
)


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
    """Replace the population; what has changed its shape loses the moments of its shape."""
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
    renderer=payload_renderer("mixed", PAYLOAD),
    rates=Rates({"vertices": 2e-4, "n_vertices": 0.0}, frozenset({"vertices"})),
)

_changing = partial(Every, 500, stop=15_000, min_gap=100)

MIXED = GS_ACCEL._replace(
    name="mixed",
    events=(
        *GS_ACCEL.events,
        _changing(partial(simplify_hulls, least=0.5, min_height=0.5), start=1_000),
        _changing(partial(promote, ratio=6.0, size_fraction=0.01), start=1_000),
    ),
)
"""``mixed``: 3DGS with ellipses, lines and triangles."""
