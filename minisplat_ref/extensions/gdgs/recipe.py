"""The start, the loss terms and the density control of GDGS, and the recipe that schedules them."""

from functools import partial

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.gdgs.model import (
    Regions,
    Weights,
    attract,
    contract,
    densest,
    disperse,
    predict_centers,
    regions_of,
    unevenness,
)
from minisplat_ref.mechanisms.oriented.planes import fit_planes, flatten_on_planes
from minisplat_ref.methods.gaussian_splatting import (
    DENSIFY_LEAST_GAP,
    GS_ACCEL,
    clone_and_split,
    collect_gradients,
)
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.strategy.ops import Edit, concat, n_rows, take
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import At, Event, Every, SmallerViews, does
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Gaussians

N_POINTS_LEAST = 3  # of a plane
PERIOD = 100
N_CELLS, N_TOP = 5, 20
WEIGHTS = Weights(distance=1.0, angle=0.01, spacing=0.0)


def on_planes(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return Gaussians at the predictor's centres, flattened onto the planes of their neighbours."""
    if n_rows(gaussians) < N_POINTS_LEAST:
        return gaussians
    return flatten_on_planes(gaussians, predict_centers(gaussians.means.astype(np.float64), rng))


def surface_attraction(rendered: Rendered, *, weights: Weights, offset: float, period: int) -> tuple[float, Cotangents]:
    """Return the attraction to the planes of the scene's points, in one of ``period`` iterations.

    Raises
    ------
    InputError
        The scene has too few points for a plane.
    """
    scene, population = rendered.scene, rendered.model.gaussians
    if (rendered.step - 1) % period:
        return 0.0, Cotangents()
    if len(scene.points) < N_POINTS_LEAST:
        raise InputError(f"scene {scene.name} has {len(scene.points)} points: train with --set surface_attraction=0")
    found = attract(population, fit_planes(scene.points), weights, offset, scene.extent)
    return found.value, Cotangents(gaussians={"means": found.means, "quats": found.quats})


def crowding(
    rendered: Rendered, *, n_cells: int, n_top: int, is_printed: bool, period: int
) -> tuple[float, Cotangents]:
    """Return the term on the densest regions: the printed one, which contracts, or the one that disperses."""
    points, g = rendered.scene.points, rendered.model.gaussians
    if (rendered.step - 1) % period or len(points) == 0:
        return 0.0, Cotangents()
    regions, means = regions_of(points, n_cells), g.means.astype(np.float64)
    members = densest(means, regions, n_top)
    if not members:
        return 0.0, Cotangents()
    value, v = contract(means, members, regions.side) if is_printed else disperse(means, members, spacing_of(regions))
    return value, Cotangents(gaussians={"means": v.astype(g.means.dtype)})


def spacing_of(regions: Regions) -> float:
    """Return h, over which Gaussians repel each other: an eighth of a region's side."""
    return regions.side / 8


def control_by_region(
    state: TrainState, iteration: Iteration, *, threshold: float, n_cells: int, min_unevenness: float, jitter: float
) -> str | None:
    """Clone Gaussians of large gradients in regions of uneven density, and reset the collected gradients.

    A clone lies ``jitter`` standard deviations from its parent. In even regions :func:`crowding` acts instead.
    """
    gradients = state.stats.pop("gradient_sum") / np.maximum(state.stats.pop("view_count"), 1)
    g, points = state.gaussians, iteration.scene.points
    if len(points) == 0 or n_rows(g) == 0:
        return "nothing done: the scene has no points"
    regions = regions_of(points, n_cells)
    is_uneven = unevenness(g.means, regions) > min_unevenness
    rows = np.flatnonzero((gradients >= threshold) & is_uneven[regions.ids_of(g.means)])
    if len(rows) == 0:
        return "nothing done: no region is uneven where gradients are large"
    clones = take(g, rows)
    own = jitter * np.exp(clones.log_scales) * state.rng.standard_normal(clones.means.shape)
    offsets = (rotation_matrices(clones.quats) @ own[:, :, None])[:, :, 0]
    clones = clones._replace(means=(clones.means + offsets).astype(g.means.dtype))
    parents = np.concatenate([np.arange(n_rows(g)), rows])
    apply_edit(state, Edit(concat(g, clones), parents, np.arange(len(parents)) >= n_rows(g)))
    return None


def _dated(event: Event) -> Event:
    """Return an event of 3DGS with the dates of this method: gradients to the end, its densification to 10,000."""
    if isinstance(event, At | SmallerViews):
        return event
    if does(event, collect_gradients):
        return event._replace(stop=None)
    return event._replace(stop=10_000) if does(event, clone_and_split) else event


SURFACED = Representation("gdgs", extend=on_planes)
_crowding = partial(crowding, n_cells=N_CELLS, n_top=N_TOP, period=PERIOD)
GDGS = GS_ACCEL._replace(
    name="gdgs",
    losses=(
        *GS_ACCEL.losses,
        LossTerm(
            "surface_attraction",
            partial(surface_attraction, weights=WEIGHTS, offset=0.0, period=PERIOD),
            1.0,
            start=5_000,
        ),
        LossTerm("dispersion", partial(_crowding, is_printed=False), 1e-3, start=10_000),
        LossTerm("contraction", partial(_crowding, is_printed=True), 0.0, start=10_000),
    ),
    events=(
        *map(_dated, GS_ACCEL.events),
        Every(
            100,
            partial(control_by_region, threshold=2e-4, n_cells=N_CELLS, min_unevenness=1.0, jitter=0.1),
            start=9_999,
            stop=30_000,
            min_gap=DENSIFY_LEAST_GAP,
        ),
    ),
)
"""``gdgs``: 3DGS that starts on local planes, is pulled to them, and from iteration 10,000 on densifies by regions."""
