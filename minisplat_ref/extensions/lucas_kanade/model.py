"""Gaussians that a warp moves: those of time 0 at a time, with the gradient, and their renderer."""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.motion.field import basis, choose_centers, field, field_vjp, powers
from minisplat_ref.rendering import SPLATTING, Inputs, RenderGradient, Request, wrap
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.types import Floats, Gaussians, Model, Scene, View

CENTERS, LOG_WIDTH = "warp_centers", "warp_log_width"  # [B, 3] and [1], of the basis
SHIFTS, TURNS, GROWTHS = "warp_shifts", "warp_turns", "warp_growths"  # [B, P, 3], [B, P, 3] and [B, P, 1]


def turned(quats: Floats, turns: Floats) -> Floats:
    """Return quaternions after a rotation about ``r`` by the angle ``2 arctan(|r| / 2)``.

    ::

        q' = (1, r / 2) q = (w - r . u / 2,  u + (w r + r x u) / 2)    with q = (w, u)

    A rotation by a small angle has that angle as |r|; no r turns by pi. At r = 0 the quaternions are as they were.

    Parameters
    ----------
    quats : ndarray of shape (N, 4)
        wxyz, any length.
    turns : ndarray of shape (N, 3)
        r, world frame.
    """
    w, u = quats[:, :1], quats[:, 1:]
    half = turns * turns.dtype.type(0.5)
    return np.concatenate([w - np.sum(half * u, axis=1, keepdims=True), u + w * half + np.cross(half, u)], axis=1)


def turned_vjp(quats: Floats, turns: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`turned` with respect to quaternions and turns.

    With the derivative ``(a, b)`` with respect to q'::

        v_w = a + r . b / 2,   v_u = b - a r / 2 + b x r / 2,   v_r = (w b - a u + u x b) / 2
    """
    w, u, a, b = quats[:, :1], quats[:, 1:], v[:, :1], v[:, 1:]
    half = turns * turns.dtype.type(0.5)
    v_quats = np.concatenate([a + np.sum(half * b, axis=1, keepdims=True), b - a * half + np.cross(b, half)], axis=1)
    return v_quats, v.dtype.type(0.5) * (w * b - a * u + np.cross(u, b))


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
    g, shared = model.gaussians, model.shared
    if SHIFTS not in shared:
        raise InputError(
            "a file of Gaussians has no place for their warp: give the folder of the run, or --extension core for the"
            " scene at time 0"
        )
    centers, width = shared[CENTERS], float(np.exp(shared[LOG_WIDTH][0]))
    coefficients = np.concatenate([shared[name] for name in (SHIFTS, TURNS, GROWTHS)], axis=2)
    phi, tau = basis(g.means, centers, width), powers(time, coefficients.shape[1])
    values = field(phi, coefficients, tau)  # [N, 7]
    there = g._replace(
        means=g.means + values[:, :3],
        quats=turned(g.quats, values[:, 3:6]),
        log_scales=g.log_scales + values[:, 6:],
    )
    return Moved(there, g, centers, width, phi, coefficients, tau)


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
    shared = {
        CENTERS: of_field.centers,
        LOG_WIDTH: np.array([of_field.log_width], of_field.centers.dtype),
        SHIFTS: of_field.coefficients[..., :3],
        TURNS: of_field.coefficients[..., 3:6],
        GROWTHS: of_field.coefficients[..., 6:],
    }
    return v._replace(means=v.means + of_field.places, quats=v_quats), shared


def _move(model: Model, view: View, request: Request) -> tuple[Inputs, Moved]:
    """Return the inputs with the Gaussians at the time of the view, and the record of :func:`moved`."""
    there = moved(model, view.time)
    return (model._replace(gaussians=there.gaussians), view, request), there


def _move_vjp(there: Moved, v: RenderGradient) -> RenderGradient:
    """Gradient of :func:`_move` with respect to the Gaussians of time 0 and to the warp."""
    gaussians, shared = moved_vjp(there, v.gaussians)
    return v._replace(gaussians=gaussians, shared={**v.shared, **shared})


def first_warp(scene: Scene, rng: np.random.Generator, *, n_centers: int, degree: int) -> Mapping[str, Floats]:
    """Return a warp that moves nothing, with centres among the points of the scene.

    Parameters
    ----------
    scene : Scene
    rng : numpy.random.Generator
    n_centers : int
        B, at most.
    degree : int
        P, of the polynomials of time.

    Raises
    ------
    InputError
        All photographs have the same time, or a number is below 1.
    """
    if n_centers < 1 or degree < 1:
        raise InputError(f"n_centers={n_centers} and degree={degree} are numbers from 1 on")
    times = {view.time for view in scene.train_views}
    if len(scene.train_views) > 1 and len(times) == 1:
        raise InputError(
            f"scene {scene.name} is no sequence: all its photographs have the time {times.pop():g}; give each frame of"
            ' transforms.json a "time", or train 3dgs-accel'
        )
    points = scene.points if len(scene.points) else scene.extent * rng.uniform(-1, 1, size=(8 * n_centers, 3))
    centers, width = choose_centers(points, n_centers, rng)
    b = len(centers)
    return {
        CENTERS: centers.astype(np.float32),
        LOG_WIDTH: np.array([np.log(width)], np.float32),
        SHIFTS: np.zeros((b, degree, 3), np.float32),
        TURNS: np.zeros((b, degree, 3), np.float32),
        GROWTHS: np.zeros((b, degree, 1), np.float32),
    }


WARPED = Representation(
    "warped Gaussians",
    shared=partial(first_warp, n_centers=32, degree=3),
    renderer=wrap(SPLATTING, "lucas-kanade", _move, _move_vjp),
    # Adam moves a coefficient by about its rate per iteration. A body moves by a tenth of the extent or so in one unit
    # of time, and turns by a radian: 1,000 iterations go ten times as far. Centres move as the means do.
    rates=Rates(
        {
            CENTERS: LogLinear(1.6e-4, 1.6e-6, 30_000),
            LOG_WIDTH: LogLinear(1e-3, 1e-5, 30_000),
            SHIFTS: LogLinear(1e-3, 1e-5, 30_000),
            TURNS: LogLinear(2e-3, 2e-5, 30_000),
            GROWTHS: LogLinear(1e-3, 1e-5, 30_000),
        },
        frozenset({CENTERS, SHIFTS}),
    ),
    units={**WORLD_UNITS, CENTERS: Unit.PLACE, LOG_WIDTH: Unit.LOG_LENGTH, SHIFTS: Unit.LENGTH},
)
