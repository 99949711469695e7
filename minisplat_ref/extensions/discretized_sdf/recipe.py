"""The losses of discretised signed distances, the density control, and the recipe.

::

    L_proj   = sum |z(x_0) - D| / n    over surfels for which this is below ``reach``; n: all that have a pixel
    L_med    = max(0, gamma_ref - gamma),   gamma_ref = ln(3 + 2 sqrt 2) / median |s|, 4.549 for small medians
    L_mask   = -mean (m ln A + (1 - m) ln(1 - A))
    L_smooth = sum over maps X of mean m (|S_x X| + |S_y X|)      X: roughness, metallic share, the mean of the albedo
    L_light  = mean |E - (E_r + E_g + E_b) / 3|                   E: texels of the environment

S_x and S_y are Sobel's filters. z is the depth of the projected centre ``x_0 = mu - s n``, and D the rendered depth at
its pixel. D and gamma_ref are held constant in the derivatives. Between the centres of pixels, the inverse of D is
interpolated.
"""

from functools import partial
from typing import Any

import numpy as np
from scipy.ndimage import convolve, correlate

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.discretized_sdf.model import (
    LOG_WIDTH,
    NO_COLORS,
    opacity_logits,
    projected,
    projected_vjp,
    reference_sharpness,
    tint,
    tint_vjp,
)
from minisplat_ref.mechanisms.depth_maps.reprojection import sample_depth
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.training import NORMALS
from minisplat_ref.mechanisms.surfels.losses import distortion
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL, reset_opacity, reset_opacity_on_white
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.reference.pinhole import pinhole, pose, with_principal_point
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.schedule import During, Event, does
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats

Z_MIN = 0.01  # world units: points nearer to the camera's plane have no pixel
SOBEL = np.array([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]])
ALPHA_MARGIN = 1e-6  # of A from 0 and 1, where the cross entropy is infinite


def projection(rendered: Rendered, *, reach: float) -> tuple[float, Cotangents]:
    """Return L_proj and its derivatives.

    ::

        v_x0 = R_3^T sign(z - D) / n        R_3: third row of cam_from_world_R

    Parameters
    ----------
    rendered : Rendered
        With the channel ``depth``.
    reach : float
        World units; published as 0.1.
    """
    g, depth = rendered.model.gaussians, rendered_depths(rendered.constant)
    R, t = pose(rendered.view.camera, g.means.dtype)
    z = projected(g.means, g.quats, g.distances) @ R[2] + t[2]
    error = z - depth
    counts, n = (depth > 0) & (np.abs(error) < reach), int(np.sum(depth > 0))
    if not counts.any():
        return 0.0, Cotangents()
    v_points = np.where(counts, np.sign(error) / n, 0).astype(g.means.dtype)[:, None] * R[2]
    v_means, v_quats, v_distances = projected_vjp(g.quats, g.distances, v_points)
    value = float(np.sum(np.abs(error[counts]), dtype=np.float64) / n)
    return value, Cotangents(gaussians={"means": v_means, "quats": v_quats, "distances": v_distances})


def rendered_depths(rendered: Rendered) -> Floats:
    """Return the rendered depth [N] at the pixel of each projected centre; 0 where there is none."""
    g = rendered.model.gaussians
    camera = with_principal_point(rendered.view.camera, rendered.request.conventions)
    R, t = pose(camera, g.means.dtype)
    x = projected(g.means, g.quats, g.distances) @ R.T + t
    is_ahead = x[:, 2] > Z_MIN
    pixels = pinhole(np.where(is_ahead[:, None], x, x.dtype.type(1)), camera)
    map_ = expected_depth(rendered.channel("depth")[..., 0], rendered.output.alpha)
    return np.where(is_ahead, sample_depth(map_, pixels), 0).astype(g.means.dtype)


def median(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return L_med and its derivative ``v_omega = gamma`` where gamma is too small; ``gamma = exp(-omega)``."""
    log_width = rendered.model.shared[LOG_WIDTH]
    gamma = float(np.exp(-log_width[0]))
    wanted = reference_sharpness(rendered.constant.model.gaussians.distances)
    if gamma >= wanted:
        return 0.0, Cotangents()
    return wanted - gamma, Cotangents(shared={LOG_WIDTH: np.full_like(log_width, gamma)})


def silhouette(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return L_mask, the cross entropy of alpha and the photograph's mask; 0 without a mask.

    ::

        v_A = (A - m) / (A (1 - A)) / pixels        where A is not within the margin
    """
    mask, alpha = rendered.view.mask, rendered.output.alpha
    if mask is None:
        return 0.0, Cotangents()
    if mask.shape != alpha.shape:
        raise InputError(f"the mask of {rendered.view.name} has the shape {mask.shape}, its image {alpha.shape}")
    A = np.clip(alpha.astype(np.float64), ALPHA_MARGIN, 1 - ALPHA_MARGIN)
    value = -float(np.mean(np.where(mask, np.log(A), np.log1p(-A))))
    v = np.where(A == alpha, (A - mask) / (A * (1 - A)) / A.size, 0)
    return value, Cotangents(alpha=v.astype(alpha.dtype))


def base_smoothness(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return L_smooth and its derivatives: Sobel's transposed filters of ``sign(S X) m / pixels``; no mask is m = 1."""
    alpha, mask = rendered.output.alpha, rendered.view.mask
    share = (np.ones_like(alpha) if mask is None else mask.astype(alpha.dtype)) / alpha.dtype.type(alpha.size)
    value, v_maps = 0.0, {}
    for name in ("albedo", "metallic", "roughness"):
        map_ = rendered.channel(name)
        X, v = map_.mean(axis=2), np.zeros_like(alpha)
        for filter_ in (SOBEL, SOBEL.T):
            slope = correlate(X, filter_, mode="constant")
            value += float(np.sum(np.abs(slope) * share, dtype=np.float64))
            v += convolve(np.sign(slope) * share, filter_, mode="constant")
        v_maps[name] = np.repeat(v[..., None], map_.shape[2], axis=2) / map_.dtype.type(map_.shape[2])
    return value, Cotangents(v_maps)


def neutral_light(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return L_light and its derivative."""
    log_environment = rendered.model.shared[ENVIRONMENT]
    return tint(log_environment), Cotangents(shared={ENVIRONMENT: tint_vjp(log_environment)})


def refresh_opacities(state: TrainState, iteration: Iteration) -> None:
    """Write the opacities of the distances into the population, where other actions and files read them."""
    g = state.gaussians
    g.opacity_logits[:] = opacity_logits(g.distances, state.shared[LOG_WIDTH])


def reset_distances(state: TrainState, iteration: Iteration, *, ceiling: float) -> None:
    """Move centres away from the surface, without moving them, until no opacity is above ``ceiling``.

    ``|s|`` becomes at least ``2 arsinh(exp(-l / 2)) / gamma`` with the logit l of the ceiling. Signs stay, and the
    moments of the distances are forgotten, because they point back.
    """
    g, width = state.gaussians, np.exp(state.shared[LOG_WIDTH].astype(np.float64))
    least = 2 * width * np.arcsinh(np.sqrt((1 - ceiling) / ceiling))
    sign = np.where(g.distances < 0, -1, 1)
    g.distances[:] = sign * np.maximum(np.abs(g.distances), least)
    for moment in (state.adam.first, state.adam.second):
        moment.distances[:] = 0
    refresh_opacities(state, iteration)


def reset_distances_on_white(state: TrainState, iteration: Iteration, *, ceiling: float) -> str | None:
    """Do :func:`reset_distances` if the background is white, where early floaters hide best."""
    if not np.all(iteration.scene.background == 1.0):
        return "nothing done: the background is not white"
    reset_distances(state, iteration, ceiling=ceiling)
    return None


def _of_distances(event: Event) -> Event:
    """Return an event of 3DGS, with distances reset where it resets opacities."""
    for action, own in ((reset_opacity, reset_distances), (reset_opacity_on_white, reset_distances_on_white)):
        if does(event, action):
            bound: Any = event.action
            return event._replace(action=partial(own, **bound.keywords))
    return event


RECIPE = GS_ACCEL._replace(
    name="discretized-sdf",
    learning_rates=GS_ACCEL.learning_rates.change(opacity_logits=0.0, log_scales=0.035, quats=0.002, **NO_COLORS),
    losses=(
        *GS_ACCEL.losses,
        NORMALS._replace(weight=0.2),
        LossTerm("distortion", distortion, 100.0, frozenset({"spread"}), start=1_000),
        LossTerm("projection", partial(projection, reach=0.1), 5.0, frozenset({"depth"}), start=1_000),
        LossTerm("median", median, 1.0, start=1_000),
        LossTerm("silhouette", silhouette, 0.2),
        LossTerm("base_smoothness", base_smoothness, 0.02, frozenset({"albedo", "metallic", "roughness"})),
        LossTerm("neutral_light", neutral_light, 0.001),
    ),
    has_random_background=True,
    events=(During(refresh_opacities), *map(_of_distances, GS_ACCEL.events)),
)
"""``discretized-sdf``: shading per pixel from the start, opacities of distances, and the losses on these.

Weights are those of the released script for shiny objects, but for the distortion, whose 2,000 there is 100 by default.
"""
