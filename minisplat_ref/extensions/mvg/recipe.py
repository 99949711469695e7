"""The two losses of MVG-Splatting, the insertion as an action, and the recipe.

The losses join the photometric one: on depth steps, and on normals. The depth is the expected one. Steps are in units
of the scene's extent, so that a weight serves scenes of all sizes. Normals are compared with those of the depth map
after the bilateral filter, and the gradient passes through the filter, which is linear.
"""

from functools import partial

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.mvg.insertion import (
    WIDTHS,
    Insertions,
    Photographed,
    Rules,
    drop_covered,
    propose,
    smooth_map,
)
from minisplat_ref.mechanisms.depth_maps.bilateral import joint_bilateral_depth, joint_bilateral_depth_vjp
from minisplat_ref.mechanisms.depth_maps.reprojection import DepthView, Tolerances
from minisplat_ref.mechanisms.surfels.disagreement import disagree
from minisplat_ref.mechanisms.surfels.discs import DISC_EVENTS, DISCS, LOG_THICKNESS
from minisplat_ref.mechanisms.surfels.gradient_checks import renderer_stage
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.depth import expected_depth, expected_depth_vjp
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.strategy.clone_split import logit
from minisplat_ref.strategy.initialization import INITIAL_OPACITY
from minisplat_ref.strategy.ops import NO_PARENT, Edit, concat, n_rows
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.schedule import Every
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Floats, Gaussians, Model, View

ALPHA_MIN = 0.5  # of a pixel that shows a surface
DEPTH = frozenset({"depth"})
INSERT_LEAST_GAP = 20  # iterations: the surfels of the last insertion have to become opaque to show a depth


def edge_aware_steps(depth: Floats, image: Floats, sharpness: float) -> float:
    """Return the mean size of depth steps between neighbours, where the photograph has no edge.

    ::

        L = 1 / P sum_pq |D_p - D_q| exp(-k |I_p - I_q|)

    over the pairs of a pixel and its right or lower neighbour that both have a depth; |I_p - I_q| is the mean over the
    channels, and P the number of pixels.

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        0 where there is none.
    image : ndarray of shape (H, W, 3)
        RGB in [0, 1].
    sharpness : float
        k.
    """
    return sum(float(np.sum(w * np.abs(step))) for step, w in _steps(depth, image, sharpness)) / depth.size


def edge_aware_steps_vjp(depth: Floats, image: Floats, sharpness: float) -> Floats:
    """Gradient [H, W] of :func:`edge_aware_steps`: ``v_D_q = w sign(D_q - D_p) / P``, and the opposite for p."""
    v_right, v_down = (w * np.sign(step) / depth.size for step, w in _steps(depth, image, sharpness))
    v_depth = np.zeros_like(depth)
    v_depth[:, 1:] += v_right
    v_depth[:, :-1] -= v_right
    v_depth[1:] += v_down
    v_depth[:-1] -= v_down
    return v_depth


def _steps(depth: Floats, image: Floats, sharpness: float) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Return the depth steps and weights of pairs to the right, and of pairs down."""
    has_depth = depth > 0

    def pairs(axis: int) -> tuple[Floats, Floats]:
        apart = np.mean(np.abs(np.diff(image, axis=axis)), axis=2, dtype=depth.dtype)
        both = has_depth[:, 1:] & has_depth[:, :-1] if axis == 1 else has_depth[1:] & has_depth[:-1]
        return np.diff(depth, axis=axis), np.exp(-depth.dtype.type(sharpness) * apart) * both

    return pairs(1), pairs(0)


def depth_steps(rendered: Rendered, *, sharpness: float) -> tuple[float, Cotangents]:
    """Return the edge-aware steps of the expected depth, and their derivatives."""
    sums, alpha = rendered.channel("depth")[..., 0], rendered.output.alpha
    depth, photograph, unit = expected_depth(sums, alpha), _photograph(rendered), rendered.scene.extent
    value = edge_aware_steps(depth, photograph, sharpness) / unit
    v_depth = edge_aware_steps_vjp(depth, photograph, sharpness) / depth.dtype.type(unit)
    v_sums, v_alpha = expected_depth_vjp(sums, alpha, v_depth)
    return value, Cotangents({"depth": v_sums[..., None]}, v_alpha)


def filtered_normals(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the deviation of surfels' normals from the surface through the filtered depths, and the derivatives.

    ``v_D'`` is that of :func:`minisplat_ref.mechanisms.surfels.disagreement.disagree`; ``v_D`` follows from it
    through the filter.
    """
    sums, alpha = rendered.channel("depth")[..., 0], rendered.output.alpha
    depth, photograph = expected_depth(sums, alpha), _photograph(rendered)
    found = disagree(rendered, joint_bilateral_depth(depth, photograph, WIDTHS))
    v_depth = joint_bilateral_depth_vjp(depth, photograph, found.v_depth, WIDTHS)
    v_sums, v_alpha = expected_depth_vjp(sums, alpha, v_depth)
    return found.value, Cotangents({"normal": found.v_normal, "depth": v_sums[..., None]}, v_alpha + found.v_alpha)


def _photograph(rendered: Rendered) -> Floats:
    dtype = rendered.output.alpha.dtype
    photograph: Floats = rendered.view.image.astype(dtype) / dtype.type(255)
    return photograph


def insert_consistent(
    state: TrainState,
    iteration: Iteration,
    *,
    n_views: int,
    n_sources: int,
    near_stride: int,
    far_stride: int,
) -> str | None:
    """Insert surfels at the near and far pixels on whose depth ``n_views`` of the ``n_sources`` nearest views agree."""
    settings = iteration.render_settings
    views = [photographed(state.model, view.load(), settings) for view in iteration.scene.train_views]
    rules = Rules(Tolerances(n_views=n_views), n_sources, (near_stride, 0, far_stride))
    g = state.gaussians
    found = drop_covered(propose(views, rules, state.rng), g.means)
    if len(found.points) == 0:
        return "nothing done: no pixel that views agree on is drop_covered"
    new = make_surfels(found, g)
    parents = np.concatenate([np.arange(n_rows(g)), np.full(n_rows(new), NO_PARENT)])
    apply_edit(state, Edit(concat(g, new), parents, parents == NO_PARENT))
    return None


def photographed(model: Model, view: View, settings: RenderSettings) -> Photographed:
    """Return the smoothed expected depths of a view where it is opaque and not masked, and its photograph."""
    output, _ = settings.render_view(model, view, DEPTH, sh_degree=0)
    sums = output.image[..., settings.renderer.channels(DEPTH)["depth"]][..., 0]
    is_surface = output.alpha >= ALPHA_MIN
    if view.mask is not None:
        is_surface &= view.mask
    depth = np.where(is_surface, expected_depth(sums, output.alpha), 0)
    camera = with_principal_point(view.camera, settings.conventions)
    return smooth_map(Photographed(DepthView(depth, camera), view.image.astype(depth.dtype) / depth.dtype.type(255)))


def make_surfels(found: Insertions, like: Gaussians) -> Gaussians:
    """Return a disc at each insertion, with its normal as the third axis, of the fields and dtype of a population."""
    log_scales = np.log(found.radii)
    fields = {
        "means": found.points,
        "quats": facing(found.normals),
        "log_scales": np.stack([log_scales, log_scales, np.full_like(log_scales, LOG_THICKNESS)], axis=1),
        "opacity_logits": np.full(len(found.points), logit(INITIAL_OPACITY)),
        "sh_dc": (found.colors - 0.5) / SH_C0,
        "sh_rest": np.zeros((len(found.points), *like.sh_rest.shape[1:])),
    }
    return Gaussians(**{name: field.astype(getattr(like, name).dtype) for name, field in fields.items()})


def facing(normals: Floats) -> Floats:
    """Return quaternions [M, 4] that turn the z axis to unit normals [M, 3] the shorter way.

    ``q = (1 + n_z, -n_y, n_x, 0) / |.|``; half a turn about x where n is -z.
    """
    x, y, z = normals.T
    quats = np.stack([1 + z, -y, x, np.zeros_like(x)], axis=1)
    quats[np.linalg.norm(quats, axis=1) < 1e-6] = (0, 1, 0, 0)
    unit: Floats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return unit


MVG = GS_ACCEL._replace(
    name="mvg",
    losses=(
        *GS_ACCEL.losses,
        LossTerm("filtered_normals", filtered_normals, 0.05, frozenset({"normal", "depth"}), start=7_000),
        LossTerm("depth_steps", partial(depth_steps, sharpness=10.0), 0.1, DEPTH, start=7_000),
    ),
    events=(
        *DISC_EVENTS,
        Every(
            2_500,
            partial(insert_consistent, n_views=2, n_sources=4, near_stride=4, far_stride=2),
            stop=12_000,
            min_gap=INSERT_LEAST_GAP,
        ),
    ),
)
"""``mvg``: surfels with the density control of 3DGS, to which those are added that several views agree on."""


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the surfels' renderer as a stage; the loss terms need none of their own."""
    return (renderer_stage(backend, setting, DISCS, rng),)
