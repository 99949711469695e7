"""The losses on features and on the size of anchors, the growing and pruning of anchors, and the recipe.

Anchors grow by the rule of Scaffold-GS (Lu et al. 2023, arXiv 2312.00109, section 3.3), from which CUS-GS has its
anchors. In every iteration the gradient of the loss with respect to the projected centre of each Gaussian is collected,
in normalised device coordinates as in 3DGS. Every hundred iterations space is divided into voxels at three levels, of
sides that become smaller and thresholds that become higher::

    eps_m = eps / 4^(m-1),   tau_m = tau 2^(m-1),   m = 1, 2, 3;   eps = 16 l

A voxel gets an anchor at its centre if the mean gradient of the Gaussians in it exceeds ``tau_m``, if it has no anchor
yet, and if it survives a random elimination. At the third level voxels are as large as those of the first anchors,
whose side is l.

The paper gives no share of the random elimination; in its release a half, a quarter and an eighth go. Nor does it
define the start of a new anchor: here it has latent and colour of the anchor whose Gaussian has the largest gradient in
the voxel. Gradients are those of the photometric loss.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.cus.memory import Reading, at_pixels, feature_error, feature_map, read, read_vjp
from minisplat_ref.extensions.cus.model import (
    ADAPTER,
    FIXED,
    KEYS,
    MEMORY,
    Anchors,
    Decoded,
    at_rest,
    decode,
    decode_vjp,
    steps,
    voxel_side,
)
from minisplat_ref.mechanisms.features.blending import BlendTape, blend_channels, blend_channels_vjp
from minisplat_ref.mechanisms.features.filters import CLASSICAL
from minisplat_ref.mechanisms.networks.networks import networks_for
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Request, activate, activate_vjp
from minisplat_ref.strategy.clone_split import screen_gradient_norms
from minisplat_ref.strategy.initialization import initial_gaussians
from minisplat_ref.strategy.ops import Edit, concat, keep, n_rows
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.schedule import During, Every
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Floats, Gaussians, Ints, Model, View

UNIT = 0.01  # of the scene's extent: the side of voxels in the paper
N_LEVELS = 3
COARSEST = 16  # eps, in units of l
FINER, STEEPER = 4, 2  # from one level to the next: what sides are divided by, and thresholds multiplied with
THRESHOLD = 2e-4  # tau of the release, that of 3DGS
SUM, COUNT = "children_gradient_sum", "children_view_count"
LARGE = 0.9  # quantile of the volumes of Gaussians that counts as 1


# --- losses ---


class FeatureTape(NamedTuple):
    """The values that :func:`blended_queries` keeps for its gradient."""

    decoded: Decoded
    blended: BlendTape


def blended_queries(model: Model, view: View, request: Request) -> tuple[Floats, FeatureTape]:
    """Return the queries that a view blends, [H, W, d]."""
    decoded = decode(model, view, networks_for(request.backend), with_queries=True)
    is_visible = None
    if request.is_visible is not None:
        is_visible = np.repeat(request.is_visible, model.gaussians.n_children)
    assert decoded.queries is not None, "with_queries"
    image, tape = blend_channels(activate(decoded.gaussians, is_visible), decoded.queries, view.camera, request)
    return image, FeatureTape(decoded, tape)


def blended_queries_vjp(tape: FeatureTape, v_image: Floats) -> tuple[Anchors, dict[str, Floats]]:
    """Gradient of :func:`blended_queries` with respect to the anchors and the shared parameters.

    ::

        v_k and those of means, quaternions, scales and opacities by blending;   from these by decoding
    """
    v_queries, v = blend_channels_vjp(tape.blended, v_image)
    g = tape.decoded.gaussians
    v_log_scales, v_logits = activate_vjp(tape.blended.primitives, g.opacity_logits, v.scales, v.opacities)
    v_gaussians = Gaussians(v.means, v.quats, v_log_scales, v_logits, np.zeros_like(g.sh_dc), np.zeros_like(g.sh_rest))
    found = decode_vjp(tape.decoded, v_gaussians, v_queries)
    return found.anchors, found.shared


def read_memory(queries: Floats, shared: Any) -> tuple[Floats, Reading]:
    """Return the features [B, D] that queries [B, d] read in the memory of a model."""
    memory, keys, adapter = (shared[name].astype(queries.dtype, copy=False) for name in (MEMORY, KEYS, ADAPTER))
    return read(queries, memory, keys, adapter)


def feature_loss(rendered: Rendered, *, features: str, samples: int) -> tuple[float, Cotangents]:
    """Compare features that the blended queries read with those of the photograph: ``L2 + (1 - cos)``.

    Photographs that are smaller than the classical bank's filters have none, and no error.

    Parameters
    ----------
    rendered : Rendered
    features : str
        Folder of the maps; empty for the classical ones.
    samples : int
        Pixels that are compared in an iteration, at most; they are drawn at random.

    Raises
    ------
    InputError
        The map of the photograph cannot be read, or has another number of channels than the memory.
    """
    view, model = rendered.view, rendered.model
    if not features and min(view.camera.width, view.camera.height) < CLASSICAL.min_side:
        return 0.0, Cotangents()
    target = feature_map(view, features)
    if target.shape[2] != model.shared[MEMORY].shape[1]:
        raise InputError(
            f"features={features}: the map of photograph {view.name} has {target.shape[2]} channels, those that the"
            f" training began with {model.shared[MEMORY].shape[1]}; give the same maps"
        )
    pixels = draw_pixels(view, samples, rendered.step)
    if not len(pixels):
        return 0.0, Cotangents()
    wanted = at_pixels(target, pixels, view.camera.height, view.camera.width)
    return error_at_pixels(model, view, rendered.request, pixels, wanted)


def error_at_pixels(
    model: Model, view: View, request: Request, pixels: Ints, wanted: Floats
) -> tuple[float, Cotangents]:
    """Return the error of the features that a view reads at pixels, and its derivatives.

    Parameters
    ----------
    model, view, request
        As for :func:`blended_queries`.
    pixels : ndarray of shape (B, 2)
        Rows and columns.
    wanted : ndarray of shape (B, D)
        Features of the photograph there.
    """
    image, tape = blended_queries(model, view, request)
    rows, columns = pixels.T
    found, reading = read_memory(image[rows, columns], model.shared)
    value, v_found = feature_error(found, wanted.astype(found.dtype))
    v_queries, v_memory, v_keys, v_adapter = read_vjp(reading, v_found)
    v_image = np.zeros_like(image)
    v_image[rows, columns] = v_queries
    v_anchors, v_shared = blended_queries_vjp(tape, v_image)
    fields = ("means", "quats", "log_scales", "opacity_logits", "latents", "offsets")
    return value, Cotangents(
        gaussians={name: getattr(v_anchors, name) for name in fields},
        shared={**v_shared, MEMORY: v_memory, KEYS: v_keys, ADAPTER: v_adapter},
    )


def draw_pixels(view: View, n: int, step: int) -> Ints:
    """Return at most n pixels [B, 2], rows and columns, that the mask of a view lets count."""
    is_counted = np.ones((view.camera.height, view.camera.width), bool) if view.mask is None else view.mask
    pixels = np.argwhere(is_counted)
    if len(pixels) <= n:
        return pixels
    return pixels[np.random.default_rng(step).choice(len(pixels), n, replace=False)]


def anchor_scale(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the mean volume of anchors, ``mean_v prod_a s_va / u``, with u a hundredth of the scene's extent.

    ::

        v_ln s_va = prod_a (s_va / u) / N
    """
    log_scales = rendered.model.gaussians.log_scales
    unit = log_scales.dtype.type(np.log(UNIT * rendered.scene.extent))
    volumes = np.exp(np.sum(log_scales - unit, axis=1))
    v = np.repeat(volumes[:, None], 3, axis=1) / len(volumes)
    return float(volumes.mean()), Cotangents(gaussians={"log_scales": v})


# --- growing ---


def collect_gradients_of_children(state: TrainState, iteration: Iteration, *, growth_threshold: float | None) -> None:
    """Add the positional gradient of each Gaussian to ``stats[SUM]`` [N, K], and count the view in ``stats[COUNT]``.

    A Gaussian without a gradient was not seen. Without a threshold nothing grows, and nothing is collected.
    """
    if growth_threshold is None:
        return
    n, k = len(state.gaussians.means), state.gaussians.n_children
    if SUM not in state.stats:
        state.stats[SUM] = np.zeros((n, k), iteration.v_means2d.dtype)
        state.stats[COUNT] = np.zeros((n, k), np.int32)
    camera = iteration.view.camera
    norms = screen_gradient_norms(iteration.v_means2d.reshape(n * k, 2), camera.width, camera.height).reshape(n, k)
    state.stats[SUM] += norms
    state.stats[COUNT] += norms > 0


class Candidates(NamedTuple):
    """Voxels of one level whose mean gradient exceeds the threshold, in lexicographic order of their places."""

    centers: Floats
    """[C, 3] world frame."""
    parent_ids: Ints
    """[C] row, among the given points, of that with the largest gradient in the voxel."""


def find_candidates(points: Floats, gradients: Floats, anchors: Floats, side: float, threshold: float) -> Candidates:
    """Return the voxels without an anchor in which the mean gradient of the points exceeds a threshold.

    The centres of voxels are the multiples of their side.

    Parameters
    ----------
    points : ndarray of shape (P, 3)
        Centres of the Gaussians that were seen, world frame.
    gradients : ndarray of shape (P,)
        Mean length of the positional gradient of each over the views that saw it, normalised device coordinates.
    anchors : ndarray of shape (N, 3)
    side : float
        eps_m, world units.
    threshold : float
        tau_m.
    """
    cells, voxel_ids = np.unique(_cells(points, side), axis=0, return_inverse=True)
    voxel_ids = voxel_ids.ravel()
    n = len(cells)
    counts = np.bincount(voxel_ids, minlength=n)
    is_steep = np.bincount(voxel_ids, weights=gradients, minlength=n) > threshold * counts
    taken = {tuple(cell) for cell in _cells(anchors, side)}
    is_free = np.array([tuple(cell) not in taken for cell in cells], bool)
    steepest = np.zeros(n, np.int64)
    order = np.argsort(gradients, kind="stable")
    steepest[voxel_ids[order]] = order  # the last that is written is the largest
    chosen = np.flatnonzero(is_steep & is_free)
    return Candidates(cells[chosen] * side, steepest[chosen])


def _cells(points: Floats, side: float) -> Ints:
    return np.round(points.astype(np.float64) / side).astype(np.int64)


def grow(anchors: Anchors, gradients: Floats, side: float, threshold: float, rng: np.random.Generator) -> Edit:
    """Return the anchors with the new ones behind them.

    Parameters
    ----------
    anchors : Anchors
    gradients : ndarray of shape (N, K)
        Mean length of the positional gradient of each Gaussian; NaN if no view saw it.
    side : float
        l, world units.
    threshold : float
        tau.
    rng : numpy.random.Generator
        For the eliminated anchors, and the offsets of the new ones.
    """
    n, k = gradients.shape
    is_seen = ~np.isnan(gradients)
    points = (anchors.means[:, None] + steps(anchors).reshape(n, k, 3))[is_seen]
    owners = np.repeat(np.arange(n), k).reshape(n, k)[is_seen]
    parent_ids = np.arange(n)
    grown: Any = anchors
    for level in range(N_LEVELS):
        side_here = side * COARSEST / FINER**level
        found = find_candidates(points, gradients[is_seen], grown.means, side_here, threshold * STEEPER**level)
        survives = rng.random(len(found.centers)) >= 0.5 ** (level + 1)
        parents = owners[found.parent_ids[survives]]
        new = at_rest(found.centers[survives], anchors.sh_dc[parents], anchors.latents[parents], side_here, k, rng)
        grown, parent_ids = concat(grown, new), np.concatenate([parent_ids, parents])
    return Edit(grown, parent_ids, np.arange(len(parent_ids)) >= n)


def grow_anchors(
    state: TrainState, iteration: Iteration, *, voxel: float, growth_threshold: float | None
) -> str | None:
    """Apply :func:`grow` with the gradients collected since the last time, and reset them.

    Parameters
    ----------
    state : TrainState
    iteration : Iteration
    voxel : float
        Side of the first voxels in units of the points' median scale, as for :func:`.model.as_anchors`.
    growth_threshold : float or None
        tau; None: there is no growing.
    """
    if growth_threshold is None:
        return "nothing done: growth_threshold is none"
    counts, sums = state.stats.pop(COUNT), state.stats.pop(SUM)
    gradients = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    first = initial_gaussians(iteration.scene, 0, np.random.default_rng(0))  # draws only where there are no points
    edit = grow(state.gaussians, gradients, voxel_side(first, voxel), growth_threshold, state.rng)
    n_new = int(edit.is_new.sum())
    apply_edit(state, edit)
    return None if n_new else "nothing done: no voxel has a gradient above its threshold"


# --- pruning ---


def significance(latents: Floats, v_latents: Floats, contributions: Floats) -> Floats:
    """Return the significance of anchors, ``S_v = 2 |z_v| + 8 |dL/dz_v| + sum_n contribution``.

    The three have different units, so each is divided by its mean over the anchors first.

    Parameters
    ----------
    latents, v_latents : ndarray of shape (N, L)
        z, and the gradient of the loss with respect to it.
    contributions : ndarray of shape (N,)
        Of :func:`contributions_of`, summed over views.
    """
    parts = (np.linalg.norm(latents, axis=1), np.linalg.norm(v_latents, axis=1), contributions)
    weighted = (w * part / (part.mean() or 1.0) for w, part in zip((2.0, 8.0, 1.0), parts, strict=True))
    total: Floats = np.sum(np.stack(list(weighted)), axis=0)
    return total


def contributions_of(gaussians: Gaussians, hit_count: Any, k: int) -> Floats:
    """Return the contribution of the K Gaussians of each anchor to a view, [N].

    ``sum_n h_n o_n min(V_n / V_90, 1)`` with the pixels h that a Gaussian hits, its opacity o, and its volume V in
    units of the 90 % quantile of all.
    """
    opacities = activate(gaussians).opacities.astype(np.float64)
    log_volumes = gaussians.log_scales.astype(np.float64).sum(axis=1)
    shares = np.exp(np.minimum(log_volumes - np.quantile(log_volumes, LARGE), 0))
    found: Floats = (hit_count * opacities * shares).reshape(-1, k).sum(axis=1)
    return found


def prune_insignificant(state: TrainState, iteration: Iteration, *, share: float) -> str | None:
    """Remove the given share of anchors, at least one, those of the least :func:`significance`.

    The gradient is Adam's running mean; contributions are those to all training views.
    """
    g = state.gaussians
    n = n_rows(g)
    n_pruned = min(n - 1, int(np.ceil(share * n)))
    if n_pruned < 1:
        return "nothing done: there is but one anchor, or the share is 0"
    settings, contributions = iteration.render_settings, np.zeros(n)
    networks = networks_for(settings.backend)
    for view in iteration.scene.train_views:
        decoded = decode(state.model, view, networks)
        request = settings.request(frozenset({"stats"}), sh_degree=0)
        output, _ = SPLATTING.render(Model(decoded.gaussians), view, request)
        assert output.stats is not None
        contributions += contributions_of(decoded.gaussians, output.stats.hit_count, g.n_children)
    scores = significance(g.latents, state.adam.first.latents, contributions)
    apply_edit(state, keep(g, np.sort(np.argsort(scores, kind="stable")[n_pruned:])))
    return None


# --- recipe ---


CUS = GS_ACCEL._replace(
    name="cus",
    learning_rates=GS_ACCEL.learning_rates.change(
        log_scales=7e-3, **{name: rate for name, rate in FIXED.items() if name in Gaussians._fields}
    ),
    sh_degree=0,
    sh_milestones=(),
    losses=(
        *GS_ACCEL.losses,
        LossTerm("feature_loss", partial(feature_loss, features="", samples=2_048), 0.1),
        LossTerm("anchor_scale", anchor_scale, 0.01),
    ),
    events=(
        During(partial(collect_gradients_of_children, growth_threshold=THRESHOLD), start=500, stop=15_000),
        # before the growing, as new anchors have no mean gradient yet by which to be judged
        Every(1_000, partial(prune_insignificant, share=0.001), start=1_500, stop=15_000, min_gap=100),
        Every(100, partial(grow_anchors, voxel=1.0, growth_threshold=THRESHOLD), start=1_500, stop=15_000, min_gap=100),
    ),
)
"""``cus``: anchors with networks, and the features of the photographs."""
