"""Gaussians at a time: those of time 0 after the warp, and the gradient."""

from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.lucas_kanade.reference import turned, turned_vjp
from minisplat_ref.mechanisms.motion.field import basis, field, field_vjp, powers
from minisplat_ref.mechanisms.motion.velocity import Warp
from minisplat_ref.types import Floats, Gaussians, Model

CENTERS, LOG_WIDTH = "warp_centers", "warp_log_width"  # [B, 3] and [1], of the basis
SHIFTS, TURNS, GROWTHS = "warp_shifts", "warp_turns", "warp_growths"  # [B, P, 3], [B, P, 3] and [B, P, 1]


class Moved(NamedTuple):
    """Gaussians at a time, and the values that the gradient needs."""

    gaussians: Gaussians
    """At that time."""
    canonical: Gaussians
    """At time 0."""
    centers: Floats
    """[B, 3]."""
    width: float
    """World units."""
    phi: Floats
    """[N, B]."""
    coefficients: Floats
    """[B, P, 7] shifts, turns and growths."""
    tau: Floats
    """[P]."""


def warp_of(model: Model) -> Warp:
    """Return the warp of the centres.

    Raises
    ------
    InputError
        The model has none.
    """
    if SHIFTS not in model.shared:
        raise InputError(
            "a file of Gaussians has no place for their warp: give the folder of the run, or --extension core for the"
            " scene at time 0"
        )
    return Warp(model.shared[CENTERS], float(np.exp(model.shared[LOG_WIDTH][0])), model.shared[SHIFTS])


def moved(model: Model, time: float) -> Moved:
    """Return the Gaussians at a time.

    ::

        mu(t) = mu + f(mu, t),   q(t) = (1, r(mu, t) / 2) q,   ln s(t) = ln s + g(mu, t)

    with the fields f, r and g of :mod:`minisplat_ref.mechanisms.motion.field`.

    Raises
    ------
    InputError
        The model has no warp.
    """
    g, warp = model.gaussians, warp_of(model)
    coefficients = np.concatenate([model.shared[name] for name in (SHIFTS, TURNS, GROWTHS)], axis=2)
    phi, tau = basis(g.means, warp.centers, warp.width), powers(time, warp.degree)
    values = field(phi, coefficients, tau)  # [N, 7]
    there = g._replace(
        means=g.means + values[:, :3],
        quats=turned(g.quats, values[:, 3:6]),
        log_scales=g.log_scales + values[:, 6:],
    )
    return Moved(there, g, warp.centers, warp.width, phi, coefficients, tau)


def moved_vjp(tape: Moved, v: Gaussians) -> tuple[Gaussians, dict[str, Floats]]:
    """Gradient of :func:`moved` with respect to the Gaussians and the warp.

    ::

        v_f = v_mu(t),   v_r by turned_vjp,   v_g = sum of v_ln_s(t) over the axes,   v_mu = v_mu(t) + the fields' share
    """
    places = tape.canonical.means
    values = field(tape.phi, tape.coefficients, tape.tau)
    v_quats, v_turns = turned_vjp(tape.canonical.quats, values[:, 3:6], v.quats)
    v_values = np.concatenate([v.means, v_turns, v.log_scales.sum(axis=1, keepdims=True)], axis=1)
    of_field = field_vjp(places, tape.centers, tape.width, tape.phi, tape.coefficients, tape.tau, v_values)
    shared = warp_gradient(of_field.centers, of_field.log_width, of_field.coefficients)
    return v._replace(means=v.means + of_field.places, quats=v_quats), shared


def warp_gradient(v_centers: Floats, v_log_width: float, v_coefficients: Floats) -> dict[str, Floats]:
    """Return the gradient of the warp by the names of its parameters; coefficients are [B, P, 7]."""
    return {
        CENTERS: v_centers,
        LOG_WIDTH: np.array([v_log_width], v_centers.dtype),
        SHIFTS: v_coefficients[..., :3],
        TURNS: v_coefficients[..., 3:6],
        GROWTHS: v_coefficients[..., 6:],
    }
