"""A sheet of masses and springs that falls: forces, energies, and the step of Stoermer and Verlet.

Vertices have masses m, springs pull with ``k (l - l0)`` along themselves, gravity g pulls everything, a floor pushes
back what is below it with ``k_f`` times its depth, and drag slows everything down, ``dv/dt = -c v``. Pinned vertices do
not move. The forces other than drag are minus the gradient of

    elastic + floor + gravity = sum_s k (l - l0)^2 / 2  +  sum_v k_f depth^2 / 2  -  sum_v m g . x

A step of length h is symmetric: half a step of drag, half a kick, a drift, half a kick, half a step of drag,

    v <- e^(-c h/2) v;   v <- v + h/2 f(x)/m;   x <- x + h v;   v <- v + h/2 f(x)/m;   v <- e^(-c h/2) v

The middle is velocity Verlet: second order, exact in free fall, and symplectic, so that its error of the energy is of
order h^2 and does not grow with time. Drag is solved exactly, so what it takes away is known exactly: kinetic, elastic,
floor and gravity energies and what was dissipated add up to the energy at the start, to within that error. This is
the check of a simulation. Verlet is stable for ``h < 2 / omega`` with the highest frequency of the sheet, which
:func:`longest_step` bounds.

Why not implicit Euler, as most cloth simulations: it may take long steps because it damps, by an amount that depends on
the step and that nothing accounts for. Left out: collisions of the sheet with itself and with other things; friction
but for the drag on the floor; strain limits.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.proxies.springs import Springs
from minisplat_ref.types import Bools, Floats


class Floor(NamedTuple):
    """A plane across gravity, which pushes up what is below it."""

    height: float
    """Along the direction opposite to gravity, world units."""
    stiffness: float
    """Force per depth, of each vertex."""
    drag: float
    """1 / time, for vertices that are below the floor, besides the drag of all: friction and loss together."""


class Sheet(NamedTuple):
    """What moves, and what acts on it."""

    masses: Floats
    """[P]."""
    springs: Springs
    """Between the P vertices."""
    is_pinned: Bools
    """[P] True where a vertex does not move."""
    gravity: Floats
    """[3] acceleration, world frame; not zero if there is a floor."""
    drag: float = 0.0
    """c, 1 / time."""
    floor: Floor | None = None
    """None for none."""


class State(NamedTuple):
    """A sheet at a moment."""

    positions: Floats
    """[P, 3] world frame."""
    velocities: Floats
    """[P, 3]."""
    dissipated: float = 0.0
    """Energy that drag has taken away so far."""


class Energies(NamedTuple):
    """Where the energy of a sheet is."""

    kinetic: float
    elastic: float
    floor: float
    gravity: float
    dissipated: float

    @property
    def total(self) -> float:
        """What stays the same."""
        return sum(self)


def depths(positions: Floats, sheet: Sheet) -> Floats:
    """Return how far each vertex [P] is below the floor, 0 above it and where there is none."""
    if sheet.floor is None:
        return np.zeros(len(positions))
    return np.maximum(0, sheet.floor.height + positions @ _down(sheet))


def energies(state: State, sheet: Sheet) -> Energies:
    """Return the energies of a moment."""
    stretched = np.linalg.norm(sheet.springs.incidence @ state.positions, axis=1) - sheet.springs.rest_lengths  # [S]
    floor = sheet.floor.stiffness if sheet.floor else 0.0
    return Energies(
        kinetic=float(np.sum(sheet.masses[:, None] * state.velocities**2) / 2),
        elastic=float(np.sum(sheet.springs.stiffness * stretched**2) / 2),
        floor=float(floor * np.sum(depths(state.positions, sheet) ** 2) / 2),
        gravity=float(-np.sum(sheet.masses * (state.positions @ sheet.gravity))),
        dissipated=state.dissipated,
    )


def forces(positions: Floats, sheet: Sheet) -> Floats:
    """Return minus the gradient of the energies with respect to the positions; of pinned vertices, zero.

    With ``d = x_a - x_b`` and ``l = |d|`` of a spring, ``f_a = -k (1 - l0 / l) d = -f_b``. A spring of length zero has
    no direction, and no force.

    Parameters
    ----------
    positions : ndarray of shape (P, 3)
        World frame.
    sheet : Sheet

    Returns
    -------
    ndarray of shape (P, 3)
    """
    springs = sheet.springs
    d = springs.incidence @ positions  # [S, 3]
    lengths = np.linalg.norm(d, axis=1)  # [S]
    ratios = np.divide(springs.rest_lengths, lengths, out=np.ones_like(lengths), where=lengths > 0)
    f = sheet.masses[:, None] * sheet.gravity - springs.incidence.T @ ((springs.stiffness * (1 - ratios))[:, None] * d)
    if sheet.floor is not None:
        f -= sheet.floor.stiffness * depths(positions, sheet)[:, None] * _down(sheet)
    f[sheet.is_pinned] = 0
    return f


def longest_step(sheet: Sheet) -> float:
    """Return a step below which Verlet is stable, ``2 / omega``; infinite if nothing vibrates.

    By Gershgorin's circles of ``M^-1 K``, a row of which holds k / m for each spring of a vertex on the diagonal and
    again beside it: ``omega^2 <= max_v (2 sum_s k_s + k_f) / m_v``. This holds as long as no spring is pressed to less
    than half its length.
    """
    around = abs(sheet.springs.incidence).T @ sheet.springs.stiffness  # [P]
    floor = sheet.floor.stiffness if sheet.floor else 0.0
    squared = ((2 * around + floor) / sheet.masses)[~sheet.is_pinned]
    return 2 / float(np.sqrt(squared.max())) if len(squared) and squared.max() > 0 else np.inf


def advanced(state: State, sheet: Sheet, step: float, n_steps: int) -> State:
    """Return the sheet after a number of steps of the length ``step``; see the top of this file.

    Parameters
    ----------
    state : State
        Pinned vertices have the velocity 0.
    sheet : Sheet
    step : float
        h, below :func:`longest_step`.
    n_steps : int
        0 or more.
    """
    half, inverse_masses = step / 2, 1 / sheet.masses[:, None]
    x, v, dissipated = state.positions.copy(), state.velocities.copy(), state.dissipated
    acceleration = inverse_masses * forces(x, sheet)
    for _ in range(n_steps):
        dissipated += _slow_down(x, v, sheet, half)
        v += half * acceleration
        x += step * v
        acceleration = inverse_masses * forces(x, sheet)
        v += half * acceleration
        dissipated += _slow_down(x, v, sheet, half)
    return State(x, v, dissipated)


def _slow_down(positions: Floats, velocities: Floats, sheet: Sheet, time: float) -> float:
    """Multiply velocities by ``e^(-c time)``, in place, and return the kinetic energy that this takes away."""
    if sheet.drag == 0 and (sheet.floor is None or sheet.floor.drag == 0):
        return 0.0
    rates = np.full(len(positions), sheet.drag)
    if sheet.floor is not None:
        rates += np.where(depths(positions, sheet) > 0, sheet.floor.drag, 0.0)
    kept = np.exp(-rates * time)[:, None]  # [P, 1]
    lost = float(np.sum(sheet.masses[:, None] * (1 - kept * kept) * velocities**2) / 2)
    velocities *= kept
    return lost


def _down(sheet: Sheet) -> Floats:
    return sheet.gravity / np.linalg.norm(sheet.gravity)
