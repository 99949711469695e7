"""The velocity of a warp in three forms, and its integral over time.

A *forward* warp maps a place at time 0, the canonical place y, to its place at time t: ``x = W(y, t)``, with the
Jacobian ``J = dW/dy``. A *backward* warp w takes the place x at time t to y, with ``J_w = dw/dx``. If each is the
inverse of the other, then

    (i)    v = dW/dt at y                  the velocity of the particle, in the world (Lagrange)
    (ii)   u = J^-1 dW/dt at y             its equivalent at time 0: W(y + u dt, t) = W(y, t + dt) + O(dt^2)
    (iii)  v = -J_w^-1 dw/dt at x          the same as (i), from the backward warp: w(x(t), t) is constant

and ``v = J u``. (ii) is the step of Lucas and Kanade, 1981, and the form after which Gaussian Splatting Lucas-Kanade is
named: the displacement before a warp that has the effect of a step of time. It is not a velocity in the world.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.motion.field import basis, field, field_jacobians, power_rates, powers
from minisplat_ref.types import Floats

NEWTON_TIMES = 4  # from 0 to the wanted one: the solution at each is where the next begins
NEWTON_STEPS = 20  # at each; 3 or 4 are taken where a warp is far from folding
NEWTON_TOLERANCE = 1e-8  # of the largest coordinate, before the last step


class Warp(NamedTuple):
    """A forward warp ``W(y, t) = y + f(y, t)`` with the field f of :mod:`.field`."""

    centers: Floats
    """[B, 3] c."""
    width: float
    """h, world units."""
    shifts: Floats
    """[B, P, 3] coefficients."""

    @property
    def degree(self) -> int:
        """P."""
        return self.shifts.shape[1]

    def at(self, places: Floats, time: float) -> Floats:
        """Return canonical places [N, 3] at a given time."""
        return places + self._field(places, powers(time, self.degree))

    def rate(self, places: Floats, time: float) -> Floats:
        """Return dW/dt at canonical places [N, 3]: form (i)."""
        return self._field(places, power_rates(time, self.degree))

    def jacobians(self, places: Floats, time: float) -> Floats:
        """Return J at canonical places, [N, 3, 3]."""
        phi = basis(places, self.centers, self.width)
        tau = powers(time, self.degree)
        return np.eye(3) + field_jacobians(places, self.centers, self.width, phi, self.shifts, tau)

    def _field(self, places: Floats, tau: Floats) -> Floats:
        return field(basis(places, self.centers, self.width), self.shifts, tau)


def canonical_velocity(jacobians: Floats, rates: Floats) -> Floats:
    """Return form (ii), ``u = J^+ dW/dt``: the least squares solution, which is the inverse where there is one.

    Parameters
    ----------
    jacobians : ndarray of shape (N, 3, 3)
        J of the forward warp.
    rates : ndarray of shape (N, 3)
        dW/dt.
    """
    u: Floats = np.einsum("nij,nj->ni", np.linalg.pinv(jacobians), rates)
    return u


def velocity_of_backward(jacobians: Floats, rates: Floats) -> Floats:
    """Return form (iii), ``v = -J_w^-1 dw/dt``.

    Parameters
    ----------
    jacobians : ndarray of shape (N, 3, 3)
        J_w of the backward warp.
    rates : ndarray of shape (N, 3)
        dw/dt at a place that does not move.
    """
    return -np.linalg.solve(jacobians, rates[..., None])[..., 0]


def invert(warp: Warp, places: Floats, time: float) -> Floats:
    """Return the backward warp ``w(x, t)``, by Newton's method: ``y <- y - J^-1 (W(y, t) - x)``.

    It begins at time 0, where y = x, because far from the solution its steps lead anywhere.

    Parameters
    ----------
    warp : Warp
    places : ndarray of shape (N, 3)
        x, float64.
    time : float

    Raises
    ------
    InputError
        Newton's method does not converge, because the warp folds space: of several canonical places it may return any.
    """
    y, tolerance = places, NEWTON_TOLERANCE * max(1.0, float(np.abs(places).max(initial=0)))
    folded = InputError(f"the warp has no inverse at time {time:g}, it folds space: take a time nearer to 0")
    for moment in time * np.arange(1, NEWTON_TIMES + 1) / NEWTON_TIMES:
        for _ in range(NEWTON_STEPS):
            residuals = warp.at(y, moment) - places
            try:
                y = y - np.linalg.solve(warp.jacobians(y, moment), residuals[..., None])[..., 0]
            except np.linalg.LinAlgError as error:
                raise folded from error
            if np.abs(residuals).max(initial=0) <= tolerance:  # the step after has squared the error
                break
        else:
            raise folded
    return y


def integrate(velocity: Callable[[Floats, float], Floats], start: Floats, time: float, step: float, n: int) -> Floats:
    """Return places after a time, by the classical Runge-Kutta method of fourth order.

    ::

        k1 = v(x, t),  k2 = v(x + h k1 / 2, t + h / 2),  k3 = v(x + h k2 / 2, t + h / 2),  k4 = v(x + h k3, t + h)
        x <- x + h (k1 + 2 k2 + 2 k3 + k4) / 6

    Parameters
    ----------
    velocity : callable
        ``velocity(x, t)`` at places of the world, [N, 3].
    start : ndarray of shape (N, 3)
        x at ``time``.
    time, step : float
        t, and the length of the integration.
    n : int
        Number of steps of length ``h = step / n``.
    """
    x, h = start, step / n
    for i in range(n):
        t = time + i * h
        k1 = velocity(x, t)
        k2 = velocity(x + h / 2 * k1, t + h / 2)
        k3 = velocity(x + h / 2 * k2, t + h / 2)
        k4 = velocity(x + h * k3, t + h)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def power_steps(time: float, step: float, n: int) -> Floats:
    """Return the integrals of the powers' derivatives by one step of Runge-Kutta, [n]: the ``tau`` of a scene flow.

    The velocity of a particle, form (i), depends on time alone once its canonical place is known, so that k2 = k3 and
    the step is Simpson's rule: ``h / 6 (tau'(t) + 4 tau'(t + h / 2) + tau'(t + h))``. Up to the fourth power this is
    ``tau(t + h) - tau(t)`` exactly.
    """
    middle = power_rates(time + step / 2, n)
    return step / 6 * (power_rates(time, n) + 4 * middle + power_rates(time + step, n))
