"""Gaussians with velocities: the population, the formula beside its gradient, the renderer, and the recipe."""

from typing import NamedTuple

import numpy as np

from minisplat_ref.io.frames import Unit
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Inputs, RenderGradient, Request, wrap
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.types import Floats, Gaussians, Model, View


class MovingGaussians(NamedTuple):
    """Gaussians that move: the fields of :class:`Gaussians`, and one more."""

    means: Floats
    """[N, 3] centres at time 0, world frame."""
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    velocities: Floats
    """[N, 3] world units per unit of time."""


def at_rest(gaussians: Gaussians, rng: np.random.Generator) -> MovingGaussians:
    """Return the Gaussians with velocities of zero."""
    return MovingGaussians(**gaussians._asdict(), velocities=np.zeros_like(gaussians.means))


def move_means(means: Floats, velocities: Floats, time: float) -> Floats:
    """Return the centres at a time: ``mu(t) = mu + t nu``.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        Centres mu at time 0, world frame.
    velocities : ndarray of shape (N, 3)
        nu, world units per unit of time.
    time : float
        t.

    Returns
    -------
    ndarray of shape (N, 3)
        In the dtype of the means.
    """
    return means + means.dtype.type(time) * velocities


def move_means_vjp(time: float, v_means_at: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`move_means` with respect to means and velocities.

    ::

        v_mu = v_mu(t),   v_nu = t v_mu(t)

    Parameters
    ----------
    time : float
        t.
    v_means_at : ndarray of shape (N, 3)
        Derivative with respect to the centres at that time.

    Returns
    -------
    v_means, v_velocities : ndarray of shape (N, 3)
    """
    return v_means_at, v_means_at.dtype.type(time) * v_means_at


def freeze_gaussians(moving: MovingGaussians, time: float) -> Gaussians:
    """Return the Gaussians of 3DGS at the places of these at a time."""
    still = Gaussians(*(getattr(moving, name) for name in Gaussians._fields))
    return still._replace(means=move_means(moving.means, moving.velocities, time))


def _hold_still(model: Model, view: View, request: Request) -> tuple[Inputs, float]:
    """Return the inputs with the Gaussians at the time of the view, and that time."""
    return (model._replace(gaussians=freeze_gaussians(model.gaussians, view.time)), view, request), view.time


def _hold_still_vjp(time: float, v: RenderGradient) -> RenderGradient:
    """Gradient of :func:`_hold_still`: that of the means reaches the velocities, too."""
    v_means, v_velocities = move_means_vjp(time, v.gaussians.means)
    v_still = v.gaussians._replace(means=v_means)
    return v._replace(gaussians=MovingGaussians(**v_still._asdict(), velocities=v_velocities))


MOVING = Representation(
    "moving Gaussians",
    population=MovingGaussians,
    units={**WORLD_UNITS, "velocities": Unit.LENGTH},
    extend=at_rest,
    renderer=wrap(SPLATTING, "velocity", _hold_still, _hold_still_vjp),
    # In one unit of time a Gaussian goes as far as its velocity: the rate of the means, per extent as theirs, and five
    # times as large, since a view at time t passes only a part t of its gradient on.
    rates=Rates({"velocities": LogLinear(8e-4, 8e-6, 30_000)}, frozenset({"velocities"})),
)

VELOCITY = GS_ACCEL._replace(name="velocity")
"""``velocity``: 3DGS with linear motion."""
