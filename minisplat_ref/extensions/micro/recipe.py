"""The actions of Micro-splatting, its loss term, and the recipe that schedules them."""

from functools import partial

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.micro.model import (
    are_alike,
    box_means,
    detail_map,
    trace_penalty,
    trace_penalty_vjp,
    traces,
)
from minisplat_ref.methods.gaussian_splatting import DENSIFY_LEAST_GAP, GS_ACCEL, clone_and_split
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.strategy import clone_split, simplify
from minisplat_ref.strategy.importance import mass_mask
from minisplat_ref.strategy.ops import keep, n_rows, take
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.schedule import During, Event, Every, does
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Floats, Gaussians, Ints, Scene

# The abstract gives neither lambda, tau nor beta. These were chosen on the fox at 67 x 120 pixels.
WEIGHT, LIMIT, BETA = 1e-3, 0.05, 0.5
MERGE_REACH, MERGE_COLOR = 1.0, 0.1
SCORE_MASS = 0.99


def squared_limit(scene: Scene, trace_limit: float) -> float:
    """Return tau, world units squared; ``trace_limit`` is its square root in units of the scene's extent."""
    return (trace_limit * scene.extent) ** 2


def trace(rendered: Rendered, *, trace_limit: float) -> tuple[float, Cotangents]:
    """Return the trace penalty of the population, and its gradient with respect to the scales."""
    log_scales = rendered.model.gaussians.log_scales
    limit = squared_limit(rendered.scene, trace_limit)
    v_log_scales = trace_penalty_vjp(log_scales, limit)
    return trace_penalty(log_scales, limit), Cotangents(gaussians={"log_scales": v_log_scales})


def collect_detail(state: TrainState, iteration: Iteration) -> None:
    """Add the detail of the photograph under each visible Gaussian to ``stats["detail_sum"]``.

    The detail is the mean over the box of pixels that the Gaussian may touch. ``collect_gradients`` counts the views.
    """
    if "detail_sum" not in state.stats:
        state.stats["detail_sum"] = np.zeros(n_rows(state.gaussians), np.float32)
    ids = iteration.visible_ids
    g = take(state.gaussians, ids)
    opacities = 1 / (1 + np.exp(-g.opacity_logits))
    settings = iteration.render_settings
    projection = settings.backend.project(
        g.means, g.quats, np.exp(g.log_scales), opacities, iteration.view.camera, settings.conventions
    )
    state.stats["detail_sum"][ids] += box_means(detail_map(iteration.view.image), projection.boxes).astype(np.float32)


def clone_and_split_by_detail(
    state: TrainState, iteration: Iteration, *, threshold: float, size_fraction: float, beta: float
) -> str | None:
    """Densify as 3DGS does, with the threshold ``tau0 / (1 + beta g)`` for a Gaussian in front of detail g.

    g is the mean of the detail over the views that see the Gaussian; it is 1 where edges are as strong as on average.
    """
    g = state.stats.pop("detail_sum") / np.maximum(state.stats["view_count"], 1)  # [N]
    gradients = state.stats["gradient_sum"]
    state.stats["gradient_sum"] = gradients * (1 + beta * g).astype(gradients.dtype)
    return clone_and_split(state, iteration, threshold=threshold, size_fraction=size_fraction)


def halve_children(gaussians: Gaussians, parent_ids: Ints, rng: np.random.Generator) -> Gaussians:
    """Return two children with half the parent's covariance each, whose centres are drawn from the other half.

    So the children's covariance and that of their centres add up to the parent's in expectation. Their cross-sections
    add up to the parent's, too, and they keep its opacity, so they stop as much light.

    Parameters, result and order of rows are those of :func:`minisplat_ref.strategy.clone_split.random_children`.
    """
    parents = take(gaussians, np.tile(parent_ids, clone_split.N_CHILDREN))
    dtype = parents.means.dtype
    log_scales = parents.log_scales - dtype.type(0.5 * np.log(2))
    offsets = np.exp(log_scales) * rng.standard_normal(parents.means.shape).astype(dtype)  # [2P, 3] own axes
    rotations = rotation_matrices(parents.quats)  # [2P, 3, 3]
    return parents._replace(means=parents.means + (rotations @ offsets[:, :, None])[:, :, 0], log_scales=log_scales)


def halve_large(state: TrainState, iteration: Iteration, *, trace: float, trace_limit: float) -> str | None:
    """Replace every Gaussian with a trace penalty by two of half the covariance.

    Nothing happens where the weight ``trace`` of the penalty is zero; ``--set trace=0`` reaches both by their common
    name.
    """
    if trace == 0:
        return "nothing done: the trace penalty has no weight"
    n = n_rows(state.gaussians)
    edit = clone_split.clone_and_split(
        state.gaussians,
        np.zeros(n, np.float32),
        threshold=np.inf,
        size_limit=np.inf,
        rng=state.rng,
        is_blurred=traces(state.gaussians.log_scales) > squared_limit(iteration.scene, trace_limit),
        draw_children=halve_children,
    )
    apply_edit(state, edit)
    return None


def prune_least(state: TrainState, iteration: Iteration, *, score_mass: float) -> str | None:
    """Keep the Gaussians of the largest scores, opacity times size, that together carry this fraction of the sum.

    The size is ``sqrt(tr(Sigma))``. With a ``score_mass`` of 1 all are kept.
    """
    g = state.gaussians
    opacities = 1 / (1 + np.exp(-g.opacity_logits.astype(np.float64)))
    scores = opacities * np.sqrt(traces(g.log_scales.astype(np.float64)))
    if score_mass == 1 or not np.isfinite(scores).all():
        return "nothing done: all are kept"
    apply_edit(state, keep(g, np.flatnonzero(mass_mask(scores, score_mass))))
    return None


def clusters(gaussians: Gaussians, *, reach: float, color_reach: float) -> Ints:
    """Return labels [N] for merging: mutual nearest neighbours that are similar share one, all others are distinct."""
    labels = np.arange(n_rows(gaussians))
    if len(labels) < 2:
        return labels
    means = gaussians.means.astype(np.float64)
    first, second = simplify.mutual_neighbours(means).T  # [P]
    pairs = np.stack([first, second], axis=1)  # [P, 2]
    sizes, colors = np.sqrt(traces(gaussians.log_scales.astype(np.float64))), SH_C0 * gaussians.sh_dc  # [N], [N, 3]
    distances: Floats = np.linalg.norm(means[first] - means[second], axis=1)
    is_merged = are_alike(distances, sizes[pairs], colors[pairs], reach=reach, color_reach=color_reach)
    labels[second[is_merged]] = first[is_merged]
    return np.unique(labels, return_inverse=True)[1]


def merge_alike(state: TrainState, iteration: Iteration, *, merge_reach: float, merge_color: float) -> str | None:
    """Merge pairs of nearly equal neighbours into one Gaussian with their moments (``merge_clusters``)."""
    labels = clusters(state.gaussians, reach=merge_reach, color_reach=merge_color)
    n = n_rows(state.gaussians)
    if n == 0 or labels.max() + 1 == n:
        return "nothing done: no two neighbours are alike"
    masses = np.maximum(simplify.optical_masses(state.gaussians), np.finfo(np.float64).tiny)
    apply_edit(state, simplify.merge_clusters(state.gaussians, masses, labels))
    return None


def _with_detail(event: Event) -> Event:
    """Return an event of 3DGS, with the thresholds of this method if it is densification."""
    if not does(event, clone_and_split):
        return event
    assert isinstance(event.action, partial)
    return event._replace(action=partial(clone_and_split_by_detail, **event.action.keywords, beta=BETA))


_collect, *_others = GS_ACCEL.events
# From the first occasion after densification on, also in shorter runs.
_in_stage_two = partial(Every, 1_000, start=14_999, stop=25_000, min_gap=DENSIFY_LEAST_GAP)

MICRO = GS_ACCEL._replace(
    name="micro",
    losses=(*GS_ACCEL.losses, LossTerm("trace", partial(trace, trace_limit=LIMIT), weight=WEIGHT)),
    events=(
        _collect,
        During(collect_detail, stop=15_000),
        *map(_with_detail, _others),
        Every(
            100,
            partial(halve_large, trace=WEIGHT, trace_limit=LIMIT),
            start=500,
            stop=15_000,
            min_gap=DENSIFY_LEAST_GAP,
        ),
        _in_stage_two(partial(prune_least, score_mass=SCORE_MASS)),
        _in_stage_two(partial(merge_alike, merge_reach=MERGE_REACH, merge_color=MERGE_COLOR)),
    ),
)
"""The recipe ``micro``: 3DGS with small Gaussians, more of them in front of detail, and fewer duplicates."""
