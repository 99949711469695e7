"""The recipe of MVG-Splatting: surfels that are also inserted where the depth maps of several views agree."""

from functools import partial

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.mvg.insertion import Insertions, Photographed, Rules, propose, smooth_map, uncovered
from minisplat_ref.extensions.mvg.losses import depth_steps, filtered_normals
from minisplat_ref.mechanisms.depth_maps.reprojection import DepthView, Tolerances
from minisplat_ref.mechanisms.surfels.discs import DISC_EVENTS, LOG_THICKNESS
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.clone_split import logit
from minisplat_ref.strategy.initialization import INITIAL_OPACITY
from minisplat_ref.strategy.ops import NO_PARENT, Edit, concat, n_rows
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.schedule import Every
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Floats, Gaussians, Model, View

ALPHA_MIN = 0.5  # of a pixel that shows a surface
DEPTH = frozenset({"depth"})
INSERT_LEAST_GAP = 20  # iterations: the surfels of the last insertion have to become opaque to show a depth


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
    found = uncovered(propose(views, rules, state.rng), g.means)
    if len(found.points) == 0:
        return "nothing done: no pixel that views agree on is uncovered"
    new = surfels_at(found, g)
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


def surfels_at(found: Insertions, like: Gaussians) -> Gaussians:
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
