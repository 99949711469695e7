"""The renderer of anchors, the pruning by significance, and the recipe."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.cus.decoding import Decoded, decode, decode_vjp
from minisplat_ref.extensions.cus.growth import THRESHOLD, collect_gradients_of_children, grow_anchors
from minisplat_ref.extensions.cus.losses import anchor_scale, feature_loss
from minisplat_ref.extensions.cus.population import ANCHOR_RATES, FIXED, UNITS, Anchors, as_anchors, initial_shared
from minisplat_ref.mechanisms.networks.networks import networks_for
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request, activate
from minisplat_ref.strategy.ops import keep, n_rows
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import During, Every
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import BlendStats, Floats, Gaussians, Model, RenderOutput, View

LARGE = 0.9  # quantile of the volumes of Gaussians that counts as 1


class Tape(NamedTuple):
    """The values that :func:`render` keeps for :func:`render_vjp`."""

    inner: Any
    decoded: Decoded


def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, Tape]:
    """Decode the anchors for the view, and render their Gaussians as 3DGS does; statistics are those of anchors."""
    k = model.gaussians.n_children
    decoded = decode(model, view, networks_for(request.backend))
    is_visible = None if request.is_visible is None else np.repeat(request.is_visible, k)
    asked = request._replace(is_visible=is_visible, sh_degree=0)
    output, inner = SPLATTING.render(Model(decoded.gaussians), view, asked)
    return _of_anchors(output, k), Tape(inner, decoded)


def _of_anchors(output: RenderOutput, k: int) -> RenderOutput:
    """Return the output with rows of anchors instead of those of their K Gaussians: sums, or the largest."""
    if output.stats is not None:
        s = output.stats
        stats = BlendStats(
            blend_weight_sum=s.blend_weight_sum.reshape(-1, k).sum(axis=1),
            blend_weight_max=s.blend_weight_max.reshape(-1, k).max(axis=1),
            hit_count=s.hit_count.reshape(-1, k).sum(axis=1, dtype=s.hit_count.dtype),
            dominant_count=s.dominant_count.reshape(-1, k).sum(axis=1, dtype=s.dominant_count.dtype),
            dominant_ids=s.dominant_ids // k,  # -1 stays
        )
        output = output._replace(stats=stats)
    if "removal_changes" in output.extras:
        changes = output.extras["removal_changes"].reshape(-1, k).sum(axis=1)
        output = output._replace(extras={**output.extras, "removal_changes": changes})
    assert output.visible_ids is not None, "3DGS says which rows a view sees"
    return output._replace(visible_ids=np.unique(output.visible_ids // k))


def render_vjp(tape: Tape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render`: that of 3DGS, carried on to the anchors and the networks."""
    v = SPLATTING.render_vjp(tape.inner, v_image, v_alpha)
    found = decode_vjp(tape.decoded, v.gaussians)
    k = tape.decoded.model.gaussians.n_children
    return v._replace(
        gaussians=found.anchors,
        cam_from_world_R=v.cam_from_world_R + found.cam_from_world_R,
        cam_from_world_t=v.cam_from_world_t + found.cam_from_world_t,
        means2d=v.means2d.reshape(-1, 2 * k),
        shared={**v.shared, **found.shared},
    )


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


CHILDREN, LATENT = 10, 32  # Gaussians of a voxel, and numbers of its latent

ANCHORS = Representation(
    "anchors",
    population=Anchors,
    extend=partial(as_anchors, voxel=1.0, children=CHILDREN, latent=LATENT),
    shared=partial(
        initial_shared,
        children=CHILDREN,
        latent=LATENT,
        hidden=32,
        embedding=32,
        query=15,
        features="",
        similarity=0.9,
    ),
    renderer=Renderer("cus", render, render_vjp, SPLATTING.channels),
    rates=ANCHOR_RATES,
    units=UNITS,
)

CUS = GS_ACCEL._replace(
    name="cus",
    learning_rates=GS_ACCEL.learning_rates.change(
        **{name: rate for name, rate in FIXED.items() if name in Gaussians._fields}
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
