"""Rules that ``adaptive`` does not have: ``study adaptive --candidates`` compares it with itself and one of them more.

===================  ==================================================================================================
``near cameras``     Gaussians that are near a training camera and cover much of its photograph are removed
``opacities``        a loss on the mean opacity, as 3DGS-MCMC has it
``scales``           a loss on the mean standard deviation, in units of the scene's extent, likewise
``anti-aliasing``    opacities are compensated from the first iteration, whatever the photographs say
===================  ==================================================================================================
"""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from minisplat_ref.strategy.ops import keep, n_rows
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.schedule import Every, Recipe, configured
from minisplat_ref.training.state import Iteration, TrainState, apply_edit

WEIGHT = 0.01  # of both losses, 3DGS-MCMC


def remove_near_cameras(state: TrainState, iteration: Iteration, *, nearness: float, part: float) -> str:
    """Remove Gaussians that float near a training camera and cover much of its photograph.

    Parameters
    ----------
    state, iteration
        As for every action.
    nearness : float
        Near is what has less than this fraction of the median depth of all Gaussians in front of the camera.
    part : float
        Much is a disc of two standard deviations that covers more than this part of the photograph.
    """
    g, n = state.gaussians, n_rows(state.gaussians)
    radii, is_veil = 2.0 * np.exp(g.log_scales).max(axis=1), np.zeros(n, bool)
    for camera in (view.camera for view in iteration.scene.train_views):
        x, y, z = (g.means @ camera.cam_from_world_R.T + camera.cam_from_world_t).T
        in_front = z > iteration.render_settings.conventions.near_plane
        if not in_front.any():
            continue
        is_near = in_front & (z < nearness * np.median(z[in_front]))
        z = np.where(in_front, z, 1.0)
        is_inside = (np.abs(camera.fx * x / z) < 0.5 * camera.width) & (np.abs(camera.fy * y / z) < 0.5 * camera.height)
        covered = np.pi * camera.fx * camera.fy * (radii / z) ** 2 / (camera.width * camera.height)
        is_veil |= is_near & is_inside & (covered > part)
    apply_edit(state, keep(g, ~is_veil))
    return f"{n - n_rows(state.gaussians)} removed"


def mean_opacity(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the mean of the opacities o = sigmoid(l) and its derivative, ``o (1 - o) / N``."""
    logits = rendered.model.gaussians.opacity_logits
    opacities = 1 / (1 + np.exp(-logits))
    v_logits = opacities * (1 - opacities) / len(logits)
    return float(opacities.mean()), Cotangents(gaussians={"opacity_logits": v_logits})


def mean_scale(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the mean of ``s / extent`` over Gaussians and axes, and its derivative with respect to ``log s``."""
    log_scales = rendered.model.gaussians.log_scales
    relative = np.exp(log_scales) / log_scales.dtype.type(rendered.scene.extent)
    return float(relative.mean()), Cotangents(gaussians={"log_scales": relative / relative.size})


def with_near_check(recipe: Recipe) -> Recipe:
    """Return the recipe with :func:`remove_near_cameras`."""
    event = Every(100, partial(remove_near_cameras, nearness=0.25, part=0.05), start=100)
    return recipe._replace(events=(*recipe.events, event))


def with_term(recipe: Recipe, term: LossTerm) -> Recipe:
    """Return the recipe with one more loss."""
    return recipe._replace(losses=(*recipe.losses, term))


CANDIDATES: Mapping[str, Callable[[Recipe], Recipe]] = {
    "adaptive": lambda recipe: recipe,
    "near cameras": with_near_check,
    "opacities": partial(with_term, term=LossTerm("mean_opacity", mean_opacity, WEIGHT)),
    "scales": partial(with_term, term=LossTerm("mean_scale", mean_scale, WEIGHT)),
    "anti-aliasing": lambda recipe: configured(recipe, antialiasing=True),
}
