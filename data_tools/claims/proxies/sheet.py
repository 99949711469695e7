"""Claim ``proxies/sheet`` (ours; binding as in arXiv 2402.01459): a sheet of masses and springs against closed forms.

- *Free fall*: nothing is held, and only gravity acts. Every Gaussian bound to the sheet is at ``x + v t + g t^2 / 2``,
  and its shape does not change. Verlet is exact here up to rounding.
- *Hanging*: a sheet of length L is held at two sides that are D < L apart, and drag brings it to rest. A sheet that
  neither stretches nor resists folding hangs in a catenary: the point at the arc length s from the middle is

      x = a asinh(s / a),   y = a cosh(D / 2a) - sqrt(a^2 + s^2)  below the supports,   2 a sinh(D / 2a) = L

  Reported is the largest distance of a vertex from its place over L, by number of cells and by stretch under the
  sheet's own weight.
- *Energy*: a sheet held at one side swings down without drag, with drag, and onto a floor. Reported is the
  largest change of the sum of all energies over the largest sum of kinetic and dissipated energy, by the length of the
  step.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

from data_tools.claims import kit
from data_tools.claims.kit.figures import set_ticks, show, table_of
from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.proxies.binding import bind, rebuild
from minisplat_ref.extensions.proxies.cage import grid
from minisplat_ref.extensions.proxies.fall import Setting, make_sheet
from minisplat_ref.extensions.proxies.mass_spring import (
    Energies,
    Sheet,
    State,
    choose_stiffness,
    energies,
    integrate,
    longest_step,
    make_springs,
    vertex_masses,
)
from minisplat_ref.interface.palette import BLUE, GREEN, RED
from minisplat_ref.mechanisms.meshes.mesh import Mesh
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.rendering import render
from minisplat_ref.types import Camera, Floats, Gaussians

GRAVITY = np.array([0.0, 9.81, 0.0])
G = 9.81
LENGTH, SPAN, WIDTH = 1.0, 0.7, 0.25  # of the hanging sheet; world units
STRETCHES = (1e-2, 1e-3, 1e-4)
CELLS = (8, 16, 32)
SETTLING, SETTLING_DRAG = 4.0, 10.0  # time, and 1 / time: about critical for the slowest swing
SETTLING_STEP = 0.5  # of the longest stable step; at rest the step does not matter
STEPS = (0.8, 0.4, 0.2, 0.1, 0.05)  # of the longest stable step
SWING_CELLS, SWING_TIME, SAMPLES = 12, 0.8, 40
FRAMES = (0.0, 0.15, 0.3, 0.5, 0.9)  # seconds, of the figure
SIZE = 180  # pixels a side


class Swing(NamedTuple):
    """Conditions under which the sheet swings."""

    drag: float
    drop: float | None  # of the floor below the sheet


SWINGS = {"no drag": Swing(0.0, None), "drag": Swing(1.0, None), "drag, onto a floor": Swing(1.0, 0.4)}


def level_sheet(n_cells: int) -> Mesh:
    """Return a unit square at y = 0, perpendicular to gravity."""
    return grid(np.array([-0.5, 0.0, -0.5]), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), (n_cells, n_cells))


def free_fall(seed: int) -> dict[str, float]:
    """Return the largest errors of Gaussians on a sheet that is thrown up and falls freely for one second."""
    gaussians, mesh = carpet(seed), level_sheet(8)
    sheet = make_sheet(mesh, Setting(GRAVITY, np.zeros(len(mesh.vertices), bool), 0.01, 0.0, None))
    n_steps = int(np.ceil(1 / (0.2 * longest_step(sheet))))
    velocity = np.array([0.3, -2.0, 0.1])
    state = State(mesh.vertices, np.broadcast_to(velocity, mesh.vertices.shape))
    after = rebuild(Mesh(integrate(state, sheet, 1 / n_steps, n_steps).positions, mesh.faces), bind(gaussians, mesh))
    sigma, sigma_after = (covariances(g.quats, np.exp(g.log_scales)) for g in (gaussians, after))
    return {
        "steps": n_steps,
        "distance": float(np.linalg.norm(velocity + GRAVITY / 2)),
        "centre": float(np.abs(after.means - (gaussians.means + velocity + GRAVITY / 2)).max()),
        "covariance": float(np.abs(sigma_after - sigma).max() / np.abs(sigma).max()),
    }


def catenary(s: Floats) -> Floats:
    """Return the points [P, 2] at arc lengths s from the middle: across, and below the supports."""
    a = brentq(lambda a: 2 * a * np.sinh(SPAN / 2 / a) - LENGTH, 0.05, 10.0, xtol=1e-15)
    return np.column_stack([a * np.arcsinh(s / a), a * np.cosh(SPAN / 2 / a) - np.sqrt(a * a + s * s)])


def hang_sheet(n_cells: int, stretch: float) -> tuple[Floats, Floats]:
    """Return the vertices [P, 2] of a sheet at rest, across and below, and the catenary's points [P, 2]."""
    rest = grid(
        np.array([-LENGTH / 2, 0.0, 0.0]),
        np.array([LENGTH, 0.0, 0.0]),
        np.array([0.0, 0.0, WIDTH]),
        (n_cells, max(1, round(n_cells * WIDTH / LENGTH))),
    )
    s = rest.vertices[:, 0]
    half_angle = brentq(lambda t: np.sin(t) / t - SPAN / LENGTH, 1e-3, 3.1)
    r = LENGTH / 2 / half_angle  # it starts as a circular arc, which is neither stretched nor at rest
    start = np.column_stack([r * np.sin(s / r), r * np.cos(s / r) - r * np.cos(half_angle), rest.vertices[:, 2]])
    masses = vertex_masses(rest, 1.0)
    stiffness = choose_stiffness(rest, float(masses.sum()) * G, stretch)._replace(bend=0.0)
    is_pinned = np.abs(np.abs(s) - LENGTH / 2) < 1e-9
    sheet = Sheet(masses, make_springs(rest, stiffness), is_pinned, GRAVITY, SETTLING_DRAG)
    step = SETTLING_STEP * longest_step(sheet)
    end = integrate(State(start, np.zeros_like(start)), sheet, step, int(SETTLING / step))
    return end.positions[:, :2], catenary(s)


def swing_sheet(swing: Swing, fraction: float) -> list[Energies]:
    """Return the energies over time of a sheet held at one side; a step is ``fraction`` of the longest stable one."""
    mesh = level_sheet(SWING_CELLS)
    is_pinned = mesh.vertices[:, 0] < -0.5 + 1e-9
    sheet = make_sheet(mesh, Setting(GRAVITY, is_pinned, 0.01, swing.drag, swing.drop))
    n_steps = int(np.ceil(SWING_TIME / SAMPLES / (fraction * longest_step(sheet))))
    state = State(mesh.vertices, np.zeros_like(mesh.vertices))
    found = [energies(state, sheet)]
    for _ in range(SAMPLES):
        state = integrate(state, sheet, SWING_TIME / SAMPLES / n_steps, n_steps)
        found.append(energies(state, sheet))
    return found


def energy_error(found: list[Energies]) -> float:
    """Return the largest change of the total energy over the largest sum of kinetic and dissipated energy."""
    return max(abs(e.total - found[0].total) for e in found) / max(e.kinetic + e.dissipated for e in found)


def measure(seed: int) -> dict[str, Any]:
    """Run all simulations and return their errors."""
    hanging = {f"{stretch:g}": dict.fromkeys(map(str, CELLS), 0.0) for stretch in STRETCHES}
    energy = {name: dict.fromkeys(map(str, STEPS), 0.0) for name in SWINGS}
    jobs: list[tuple[Any, float]] = [(stretch, n) for stretch in STRETCHES for n in CELLS]
    jobs += [(name, fraction) for name in SWINGS for fraction in STEPS]
    for key, number in kit.with_progress(jobs, "sheets"):
        if isinstance(key, str):
            energy[key][str(number)] = energy_error(swing_sheet(SWINGS[key], number))
        else:
            found, expected = hang_sheet(int(number), key)
            hanging[f"{key:g}"][str(number)] = float(np.linalg.norm(found - expected, axis=1).max() / LENGTH)
    return {"free_fall": free_fall(seed), "hanging": hanging, "energy": energy}


def run(args: argparse.Namespace) -> kit.Report:
    """Let sheets fall, hang and swing."""
    result = {"seed": args.seed, **measure(args.seed)}
    fall = result["free_fall"]
    text = (
        f"free fall for 1 s in {fall['steps']} steps, over {fall['distance']:.1f} units: centres off by"
        f" {fall['centre']:.1e}, covariances by {fall['covariance']:.1e} of the largest\n\n"
        "a hanging sheet: largest distance from the catenary over the sheet's length\n\n"
        f"{table_of('stretch under its own weight', result['hanging'], unit=' cells')}\n\n"
        "a swinging sheet: largest change of the total energy over the kinetic and dissipated energy\n\n"
        f"{table_of('step over the longest stable one', result['energy'])}"
    )
    return kit.Report(result, draw(result, args.seed), text)


def carpet(seed: int) -> Gaussians:
    """Return a checkered unit square of flat Gaussians at y = 0, with three balls of Gaussians on top of it."""
    rng, n = np.random.default_rng(seed), 48
    axis = (np.arange(n) + 0.5) / n - 0.5
    x, z = (values.ravel() for values in np.meshgrid(axis, axis))
    is_dark = (np.floor(6 * x) + np.floor(6 * z)) % 2 == 0
    tones = np.where(is_dark[:, None], [0.1, 0.25, 0.6], [0.95, 0.85, 0.6])
    balls, ball_colors = [], []
    for centre, color in (
        ((0.15, 0.2), (0.85, 0.15, 0.1)),
        ((-0.2, -0.1), (0.1, 0.55, 0.2)),
        ((0.3, -0.3), (0.9, 0.6, 0)),
    ):
        d = rng.normal(size=(150, 3))
        d *= 0.07 / np.linalg.norm(d, axis=1, keepdims=True)
        balls.append(d + np.array([centre[0], -0.07, centre[1]]))
        ball_colors.append(np.array(color) * (1 - 3 * d[:, 1:2]))  # lighter above
    n_balls = sum(map(len, balls))
    scales = np.concatenate([np.tile([0.011, 0.001, 0.011], (n * n, 1)), np.full((n_balls, 3), 0.012)])
    colors = np.concatenate([tones, *ball_colors])
    return Gaussians(
        means=np.concatenate([np.column_stack([x, np.zeros(n * n), z]), *balls]),
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (len(colors), 1)),
        log_scales=np.log(scales),
        opacity_logits=np.full(len(colors), 3.0),
        sh_dc=(colors - 0.5) / SH_C0,
        sh_rest=np.zeros((len(colors), 0, 3)),
    )


def render_swing(seed: int) -> list[Floats]:
    """Return images [SIZE, SIZE, 3] of a carpet that is held at two corners and swings down."""
    gaussians, mesh = carpet(seed), level_sheet(20)
    is_pinned = np.isclose(mesh.vertices[:, 0], -0.5) & np.isclose(np.abs(mesh.vertices[:, 2]), 0.5)
    sheet = make_sheet(mesh, Setting(GRAVITY, is_pinned, 0.05, 1.0, None))
    step = 0.3 * longest_step(sheet)
    binding, state, time, images = bind(gaussians, mesh), State(mesh.vertices, np.zeros_like(mesh.vertices)), 0.0, []
    angle = 0.45  # of the camera, which looks down
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # from the free side
    R = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]]) @ turn
    target, distance = np.array([-0.25, 0.4, 0.0]), 2.6
    camera = Camera(R, -R @ target + [0, 0, distance], 1.55 * SIZE, 1.55 * SIZE, SIZE / 2, SIZE / 2, SIZE, SIZE)
    for moment in FRAMES:
        n_steps = round((moment - time) / step)
        state, time = integrate(state, sheet, step, n_steps), time + n_steps * step
        moved = rebuild(Mesh(state.positions, mesh.faces), binding)
        images.append(np.clip(render(moved, camera, background=np.ones(3))[0].image, 0, 1))
    return images


def draw(result: dict[str, Any], seed: int) -> Figure:
    """Draw the carpet at several times, and below it the catenary, the energies and their error."""
    figure = Figure(figsize=(9.6, 5.0), layout="constrained")
    n = len(FRAMES)
    places = figure.add_gridspec(2, 3 * n, height_ratios=[1, 1.25])
    for i, (image, moment) in enumerate(zip(render_swing(seed), FRAMES, strict=True)):
        axes = figure.add_subplot(places[0, 3 * i : 3 * i + 3])
        show(axes, image, f"{moment:g} s")
    hanging, shares, errors = (figure.add_subplot(places[1, n * i : n * i + n]) for i in range(3))
    for stretch, color in zip(STRETCHES[:2], (RED, BLUE), strict=True):
        found, _ = hang_sheet(CELLS[0], stretch)
        hanging.plot(*found[: CELLS[0] + 1].T, "o", color=color, ms=4, label=f"{CELLS[0]} cells, stretch {stretch:g}")
    hanging.plot(*catenary(np.linspace(-LENGTH / 2, LENGTH / 2, 200)).T, "k", lw=0.8, label="catenary")
    hanging.invert_yaxis()
    hanging.set_aspect("equal")
    hanging.set_xlabel("across and below the supports, world units", fontsize=8)
    hanging.set_title("a sheet that hangs from two sides", fontsize=9)
    swing = swing_sheet(SWINGS["drag, onto a floor"], STEPS[2])
    times = np.linspace(0, SWING_TIME, len(swing))
    for name in Energies._fields:
        values = np.array([getattr(e, name) for e in swing])
        shares.plot(times, values - values[0], label=name, lw=1.2)
    shares.plot(times, [e.total - swing[0].total for e in swing], "k", label="total", lw=1.2)
    shares.set_title("energies of a sheet that falls\nonto a floor, less their initial values", fontsize=9)
    shares.set_xlabel("seconds", fontsize=8)
    for (name, by_step), color in zip(result["energy"].items(), (BLUE, GREEN, RED), strict=True):
        errors.loglog(STEPS, list(by_step.values()), "o-", color=color, ms=4, label=name)
    least = result["energy"]["no drag"][str(STEPS[-1])]
    errors.loglog(STEPS, [least * (f / STEPS[-1]) ** 2 for f in STEPS], "k:", lw=1, label="square of the step")
    set_ticks(errors, STEPS, [str(f) for f in STEPS])
    errors.set_xlabel("step over the longest stable one", fontsize=8)
    errors.set_title("error of the energy balance", fontsize=9)
    for axes in (hanging, shares, errors):
        axes.tick_params(labelsize=7)
    hanging.legend(fontsize=7)
    shares.legend(fontsize=7, loc=(0.5, 0.1))
    errors.legend(fontsize=7)
    return figure
