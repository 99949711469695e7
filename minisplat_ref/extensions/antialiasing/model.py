"""Mip-Splatting's 3D filter (Yu et al. 2023, equations 7 to 9) with its gradient, its renderer, and its recipe.

A camera samples a Gaussian once per pixel, so detail finer than the finest pixel that saw it is not supported by the
photographs. Convolution with a round Gaussian of that size removes such detail; each Gaussian has its own filter.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.sampling import sampling_intervals
from minisplat_ref.methods.gaussian_splatting import (
    DENSIFY_LEAST_GAP,
    GS_ACCEL,
    lower_opacities,
    reset_opacity,
    reset_opacity_on_white,
)
from minisplat_ref.rendering import SPLATTING, Inputs, Renderer, RenderGradient, Request, wrap
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.training.schedule import Action, At, Every, action_name
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats, Gaussians, Model, RenderOutput, View

VARIANCE = 0.2  # of the 3D filter, in units of the squared sampling interval
EPS2D = 0.1  # px^2, the variance of Mip-Splatting's 2D filter; that of a pixel is 1/12
EXPONENT_MAX = 80.0  # of e^l, which float32 holds up to e^88; an opacity within 1e-35 of 1 has no gradient left


def smooth(log_scales: Floats, opacity_logits: Floats, sigmas: Floats) -> tuple[Floats, Floats]:
    """Return scales and opacities of Gaussians convolved with round ones; their integrals do not change.

    ::

        s'^2 = s^2 + sigma^2,   o' = rho o,   rho = prod_j s_j / s'_j

    In logarithms and logits, with ``t_j = sigma^2 / s_j^2``, nothing is rounded where sigma is 0::

        log s'_j = log s_j + log(1 + t_j) / 2
        log rho  = -sum_j log(1 + t_j) / 2
        l'       = l + log rho - log(1 + (1 - rho) e^l)

    Parameters
    ----------
    log_scales : ndarray of shape (N, 3)
        log s, world units.
    opacity_logits : ndarray of shape (N,)
        l, with o = 1 / (1 + e^-l).
    sigmas : ndarray of shape (N,)
        Standard deviations of the filters, world units; their sign does not matter.

    Returns
    -------
    log_scales : ndarray of shape (N, 3)
    opacity_logits : ndarray of shape (N,)
        In the dtype of the inputs.
    """
    growths = 0.5 * np.log1p(_ratios(log_scales, sigmas))  # [N, 3] log(1 + t) / 2
    log_rhos = -growths.sum(axis=1)  # [N]
    return log_scales + growths, opacity_logits + log_rhos - np.logaddexp(0, _lost_logits(opacity_logits, log_rhos))


def smooth_vjp(
    log_scales: Floats, opacity_logits: Floats, sigmas: Floats, v_log_scales: Floats, v_logits: Floats
) -> tuple[Floats, Floats, Floats]:
    """Gradient of :func:`smooth` with respect to its three arguments.

    With ``E = (1 - rho) e^l`` and ``d E / d log rho = -rho e^l``::

        v_l       = v_l' / (1 + E)
        v_log_rho = v_l' (1 + e^l) / (1 + E)
        v_log_s_j = v_log_s'_j / (1 + t_j) + v_log_rho t_j / (1 + t_j)
        v_sigma   = sum_j (v_log_s'_j - v_log_rho) sigma / (s_j^2 (1 + t_j))

    Parameters
    ----------
    log_scales, opacity_logits, sigmas
        As for the forward function.
    v_log_scales : ndarray of shape (N, 3)
    v_logits : ndarray of shape (N,)
        Derivatives with respect to its results.

    Returns
    -------
    v_log_scales : ndarray of shape (N, 3)
    v_opacity_logits, v_sigmas : ndarray of shape (N,)
    """
    t = _ratios(log_scales, sigmas)  # [N, 3]
    shares = t / (1 + t)
    log_rhos = -0.5 * np.log1p(t).sum(axis=1)  # [N]
    log_1_E = np.logaddexp(0, _lost_logits(opacity_logits, log_rhos))  # log(1 + E)
    v_l = v_logits * np.exp(-log_1_E)
    v_log_rho = v_logits * np.exp(np.minimum(np.logaddexp(0, opacity_logits) - log_1_E, EXPONENT_MAX))  # [N]
    v_log_s = v_log_scales / (1 + t) + v_log_rho[:, None] * shares
    is_filtered = sigmas != 0
    per_sigma = shares / np.where(is_filtered, sigmas, 1)[:, None]  # sigma / (s^2 (1 + t))
    return v_log_s, v_l, np.sum((v_log_scales - v_log_rho[:, None]) * per_sigma, axis=1)


def cap_smoothed_logits(log_scales: Floats, opacity_logits: Floats, sigmas: Floats, ceiling: float) -> Floats:
    """Return the logits with which smoothed Gaussians have at most the opacity ``ceiling``: Mip-Splatting's reset.

    A filtered opacity is ``o' = rho o``, so o may be up to ``ceiling / rho``, whose logit is ``log(ceiling / (rho -
    ceiling))``; where the filter alone makes a Gaussian as faint, with rho at most ``ceiling``, nothing changes.

    Parameters
    ----------
    log_scales, opacity_logits, sigmas
        As for :func:`smooth`.
    ceiling : float
        In (0, 1).

    Returns
    -------
    ndarray of shape (N,)
        In the dtype of the inputs.
    """
    rhos = np.exp(-0.5 * np.log1p(_ratios(log_scales, sigmas)).sum(axis=1))  # [N]
    with np.errstate(divide="ignore"):
        most = np.where(rhos > ceiling, np.log(ceiling) - np.log(np.maximum(rhos - ceiling, 0)), np.inf)
    return np.minimum(opacity_logits, most.astype(opacity_logits.dtype))


def _ratios(log_scales: Floats, sigmas: Floats) -> Floats:
    """Return t = sigma^2 / s^2 [N, 3], at most the largest finite number."""
    with np.errstate(over="ignore"):
        t = (np.abs(sigmas)[:, None] * np.exp(-log_scales)) ** 2
    return np.minimum(t, np.finfo(t.dtype).max)


def _lost_logits(opacity_logits: Floats, log_rhos: Floats) -> Floats:
    """Return log((1 - rho) e^l) [N]; -inf where rho is 1."""
    with np.errstate(divide="ignore"):
        return opacity_logits + np.log(-np.expm1(log_rhos))


class FilteredGaussians(NamedTuple):
    """Gaussians with 3D filters: the fields of :class:`Gaussians` and one more."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    filter_sigmas: Floats
    """[N] standard deviation of the 3D filter, world units; 0 for no filter. An event sets it; it has no gradient."""


def add_filters(gaussians: Gaussians, rng: np.random.Generator) -> FilteredGaussians:
    """Return the Gaussians with filters of size zero, which an event measures later."""
    return FilteredGaussians(**gaussians._asdict(), filter_sigmas=np.zeros_like(gaussians.opacity_logits))


def apply_filters(g: FilteredGaussians) -> Gaussians:
    """Return the Gaussians of 3DGS after the 3D filter."""
    log_scales, opacity_logits = smooth(g.log_scales, g.opacity_logits, g.filter_sigmas)
    return Gaussians(g.means, g.quats, log_scales, opacity_logits, g.sh_dc, g.sh_rest)


def _filter_in_space(model: Model, view: View, request: Request) -> tuple[Inputs, FilteredGaussians]:
    """Return the inputs with filtered Gaussians, and the Gaussians as they are."""
    return (model._replace(gaussians=apply_filters(model.gaussians)), view, request), model.gaussians


def _filter_in_space_vjp(g: FilteredGaussians, v: RenderGradient) -> RenderGradient:
    """Gradient of :func:`_filter_in_space`: that of scales and opacities passes through :func:`smooth`."""
    v_log_scales, v_logits, v_sigmas = smooth_vjp(
        g.log_scales, g.opacity_logits, g.filter_sigmas, v.gaussians.log_scales, v.gaussians.opacity_logits
    )
    v_plain = v.gaussians._replace(log_scales=v_log_scales, opacity_logits=v_logits)
    return v._replace(gaussians=FilteredGaussians(**v_plain._asdict(), filter_sigmas=v_sigmas))


def with_3d_filter(inner: Renderer) -> Renderer:
    """Return a renderer that filters the Gaussians in space before ``inner`` renders them."""
    return wrap(inner, f"{inner.name} with 3D filter", _filter_in_space, _filter_in_space_vjp)


def with_2d_filter(inner: Renderer) -> Renderer:
    """Return a renderer that blurs footprints by ``EPS2D`` and keeps their integrals; 3DGS dilates by 0.3 px^2."""

    def render_blurred(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
        conventions = request.conventions._replace(eps2d=EPS2D, is_antialiased=True)
        return inner.render(model, view, request._replace(conventions=conventions))

    return Renderer(
        f"{inner.name} with 2D filter", render_blurred, inner.render_vjp, inner.channels, inner.scales_opacities
    )


def measure_filters(state: TrainState, iteration: Iteration, *, variance: float) -> None:
    """Set each filter's variance to ``variance`` times the squared smallest sampling interval of the training views."""
    cameras = [view.camera for view in iteration.scene.train_views]
    g = state.gaussians
    sigmas = np.sqrt(variance) * sampling_intervals(g.means, cameras)
    state.gaussians = g._replace(filter_sigmas=sigmas.astype(g.filter_sigmas.dtype))


def reset_smoothed_opacity(state: TrainState, iteration: Iteration, *, ceiling: float) -> None:
    """Lower opacities until those of the filtered Gaussians are at most ``ceiling``, and forget their moments."""
    g = state.gaussians
    lower_opacities(state, cap_smoothed_logits(g.log_scales, g.opacity_logits, g.filter_sigmas, ceiling))


def reset_smoothed_opacity_on_white(state: TrainState, iteration: Iteration, *, ceiling: float) -> str | None:
    """Do :func:`reset_smoothed_opacity` if the background is white."""
    if not np.all(iteration.scene.background == 1.0):
        return "nothing done: the background is not white"
    reset_smoothed_opacity(state, iteration, ceiling=ceiling)
    return None


MIP = with_3d_filter(with_2d_filter(SPLATTING))
"""Mip-Splatting's renderer."""

FILTERED = Representation(
    "filtered Gaussians",
    population=FilteredGaussians,
    units={**WORLD_UNITS, "filter_sigmas": Unit.LENGTH},
    extend=add_filters,
    renderer=MIP,
    rates=Rates({"filter_sigmas": 0.0}, frozenset()),
)

_measure = partial(measure_filters, variance=VARIANCE)
_RESETS: dict[str, Action] = {
    reset_opacity.__name__: partial(reset_smoothed_opacity, ceiling=0.01),
    reset_opacity_on_white.__name__: partial(reset_smoothed_opacity_on_white, ceiling=0.01),
}

ANTIALIASING = GS_ACCEL._replace(
    name="antialiasing",
    events=(
        *(
            event._replace(action=_RESETS[action_name(event)]) if action_name(event) in _RESETS else event
            for event in GS_ACCEL.events
        ),
        At(1, _measure),
        Every(100, _measure, min_gap=DENSIFY_LEAST_GAP // 2),
    ),
)
"""The recipe ``antialiasing``: 3DGS with Mip-Splatting's two filters."""
