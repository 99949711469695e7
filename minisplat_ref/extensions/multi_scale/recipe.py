"""The action that inserts coarser levels, the loss of smaller images, and the recipe."""

from functools import partial
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.multi_scale.model import LEVELS, Plan, add_levels
from minisplat_ref.mechanisms.sampling import block_means, sampling_intervals, zoom_camera
from minisplat_ref.methods.gaussian_splatting import GS
from minisplat_ref.strategy.ops import NO_PARENT, Edit, n_rows
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.schedule import At
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Camera, Floats, Gaussians, view_from

FACTOR, N_LEVELS = 4, 3  # levels for images of 1/4, 1/16 and 1/64 of the size, as in the paper
COVERAGE_MIN = 4.0  # pixels, of the ellipse where alpha is at least 1/255; if opaque, a standard deviation of 0.6
INSERTION = 15_000  # iteration at which densification has ended
SIZE_MIN = 8  # pixels per side of the smallest image that is trained on


def finest_densities(means: Floats, cameras: list[Camera]) -> Floats:
    """Return the largest density [N], pixels per world unit, at which the cameras see each centre [N, 3].

    Raises
    ------
    InputError
        The cameras see no centre.
    """
    intervals = sampling_intervals(means, cameras)
    if not (intervals > 0).all():
        raise InputError("no training view sees a Gaussian, so levels have no size: give the cameras of the run")
    return 1 / intervals


def insert_levels(
    state: TrainState, iteration: Iteration, *, factor: int, n_levels: int, min_coverage: float
) -> str | None:
    """Add the coarser levels to the population."""
    n, plan = n_rows(state.gaussians), Plan(factor, n_levels, min_coverage)
    if n == 0:
        return "nothing done: there are no Gaussians"
    densities = finest_densities(state.gaussians.means, [view.camera for view in iteration.scene.train_views])
    gaussians: Any = add_levels(state.gaussians, densities, plan, iteration.render_settings.conventions)
    is_new = np.arange(n_rows(gaussians)) >= n
    apply_edit(state, Edit(gaussians, np.where(is_new, NO_PARENT, np.arange(len(is_new))), is_new))
    return None


def coarse(
    rendered: Rendered, *, factor: int, n_levels: int, period: int, dssim_weight: float
) -> tuple[float, Cotangents]:
    """Return the photometric loss of a smaller image of the view in every ``period``-th iteration, otherwise zero.

    The levels alternate, as far as images have at least ``SIZE_MIN`` pixels per side. The gradient goes to the
    Gaussians directly: this image is not the one of the other terms, and trained exposures and poses are not applied
    to it.
    """
    view, request, model = rendered.view, rendered.request, rendered.model
    sizes = [factor**level for level in range(1, n_levels + 1)]
    sizes = [n for n in sizes if min(view.camera.width, view.camera.height) // n >= SIZE_MIN]
    if rendered.step % period or not sizes:
        return 0.0, Cotangents()
    n = sizes[rendered.step // period % len(sizes)]
    mask = None if view.mask is None else block_means(view.mask[..., None].astype(np.float32), n)[..., 0] == 1
    if mask is not None and not mask.any():
        return 0.0, Cotangents()
    small = view_from(zoom_camera(view.camera, 1 / n), time=view.time)
    output, tape = LEVELS.renderer.render(model, small, request._replace(wants=frozenset()))
    target = block_means(view.image.astype(np.float32) / 255, n).astype(output.image.dtype)
    loss, loss_tape = request.backend.photometric_loss(output.image, target, dssim_weight, mask)
    v = LEVELS.renderer.render_vjp(tape, request.backend.photometric_loss_vjp(loss_tape), None)
    return loss, Cotangents(gaussians={name: getattr(v.gaussians, name) for name in Gaussians._fields})


MULTI_SCALE = GS._replace(
    name="multi-scale",
    losses=(
        *GS.losses,
        LossTerm(
            "coarse",
            partial(coarse, factor=FACTOR, n_levels=N_LEVELS, period=4, dssim_weight=0.2),
            weight=0.1,
            start=INSERTION,
        ),
    ),
    events=(
        *GS.events,
        At(INSERTION, partial(insert_levels, factor=FACTOR, n_levels=N_LEVELS, min_coverage=COVERAGE_MIN)),
    ),
)
"""The recipe ``multi-scale``: 3DGS and, from mid-training on, coarser levels trained on smaller images."""
