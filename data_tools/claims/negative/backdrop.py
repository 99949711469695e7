"""Claim ``negative/backdrop`` (NegGS, arXiv 2405.18163): what a negative colour does, and does not do, in compositing.

A wide Gaussian and a smaller one in front of it are fitted to the image of an opaque ring, with colours clamped at
zero as in 3DGS and with colours of either sign; four clamped Gaussians side by side are the alternative. Behind the
ring is a wall. It is black, so that the hole of the ring is a matter of colour, or it has dots, which should be visible
through the hole. Truth and fits are rendered by this package in float64; everything that is not fitted is fixed.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import minimize
from scipy.special import erf

from data_tools.claims import kit
from data_tools.claims.kit.figures import show
from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.negative.model import SIGNED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.metrics import psnr
from minisplat_ref.rendering import SPLATTING, Renderer, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.strategy.ops import concat
from minisplat_ref.types import Camera, Floats, Gaussians, Model, View, view_from

SIZE = 64  # pixels a side
FOCAL = 64.0  # pixels
WALL_Z, BACK_Z, FRONT_Z = 4.0, 3.0, 2.9  # camera z, world units
N_DOTS = 16  # per side of the wall
INNER, OUTER, BLUR = 9.0, 22.0, 1.5  # radii of the ring and standard deviation of its edges, pixels
COLOR = np.array([0.95, 0.6, 0.2])  # of the ring
FITTED = ("means", "log_scales", "opacity_logits", "sh_dc")
EVALUATIONS = 300  # at most, of one fit


class Case(NamedTuple):
    """A renderer and a number of Gaussians to make the ring with."""

    renderer: Renderer
    n: int  # Gaussians


CASES = {
    "2, clamped": Case(SPLATTING, 2),
    "2, either sign": Case(SIGNED.renderer, 2),
    "4, clamped": Case(SPLATTING, 4),
}
WALLS = ("black", "dots")


class Fit(NamedTuple):
    """The best of several fits."""

    image: Floats  # [SIZE, SIZE, 3] clipped to [0, 1]
    psnr: float  # dB, whole image
    hole_psnr: float  # dB, inside the ring
    see_through: float  # mean transmittance of the ring's Gaussians inside the ring; 1 in truth


def view() -> View:
    """Return the view of a camera at the origin that looks along z."""
    return view_from(Camera(np.eye(3), np.zeros(3), FOCAL, FOCAL, SIZE / 2, SIZE / 2, SIZE, SIZE))


def balls(means: Floats, scales: Floats, opacities: Floats, colors: Floats) -> Gaussians:
    """Return round Gaussians without view dependence, [M, 3], [M], [M] and [M, 3], in float64."""
    n = len(means)
    return Gaussians(
        means=means,
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        log_scales=np.tile(np.log(scales)[:, None], (1, 3)),
        opacity_logits=np.log(opacities) - np.log1p(-opacities),
        sh_dc=(colors - 0.5) / SH_C0,
        sh_rest=np.zeros((n, 0, 3)),
    )


def wall(name: str) -> Gaussians:
    """Return the Gaussians of a wall: none for ``black``, dots of random colours for ``dots``."""
    n = 0 if name == "black" else N_DOTS
    half = 0.5 * SIZE / FOCAL * WALL_Z  # half the wall's width, world units
    places = ((np.arange(n) + 0.5) / max(n, 1) * 2 - 1) * half  # [n]
    x, y = np.meshgrid(places, places)
    means = np.column_stack([x.ravel(), y.ravel(), np.full(n * n, WALL_Z)])
    colors = np.random.default_rng(0).uniform(0.1, 0.9, (n * n, 3))
    return balls(means, np.full(n * n, half / N_DOTS), np.full(n * n, 0.95), colors)


def radii() -> Floats:
    """Return the distance [SIZE, SIZE] of each pixel's centre from the middle, pixels."""
    axis = np.arange(SIZE) + 0.5 - SIZE / 2
    return np.hypot(axis, axis[:, None])


def truth(behind: Gaussians) -> Floats:
    """Return the image [SIZE, SIZE, 3] of the ring in front of a wall."""
    image = SPLATTING.render(Model(behind), view(), Request())[0].image
    inside, outside = (erf((radii() - r) / (np.sqrt(2) * BLUR)) for r in (INNER, OUTER))
    alpha = 0.5 * (inside - outside)[:, :, None]  # [SIZE, SIZE, 1]
    return alpha * COLOR + (1 - alpha) * image


def start(n: int, rng: np.random.Generator) -> Gaussians:
    """Return a dark Gaussian in front of a bright one if n is 2, or n along the ring; all slightly displaced."""
    unit = BACK_Z / FOCAL  # world units a pixel
    if n == 2:
        centres, scales = np.zeros((2, 2)), np.array([OUTER, INNER]) / 2
        colors = np.stack([COLOR, np.full(3, 0.1)])
    else:
        angles = 2 * np.pi * (np.arange(n) + rng.uniform()) / n  # [n]
        centres = 0.5 * (INNER + OUTER) * np.column_stack([np.cos(angles), np.sin(angles)])  # [n, 2] pixels
        scales, colors = np.full(n, (OUTER - INNER) / 2), np.tile(COLOR, (n, 1))
    z = np.linspace(BACK_Z, FRONT_Z, n)
    centres = centres + rng.normal(size=centres.shape)  # by a pixel
    scales = scales * np.exp(0.2 * rng.normal(size=n))
    return balls(np.column_stack([unit * centres, z]), unit * scales, np.full(n, 0.8), colors)


def fit_behind(behind: Gaussians, target: Floats, case: Case, n_starts: int, rng: np.random.Generator) -> Fit:
    """Return the best of several fits of the Gaussians in front of a wall, by the renderer's gradient and L-BFGS.

    Means move parallel to the image plane, so that the order stays; scales, opacities and colours are free.
    """
    fits = [_fit_once(behind, target, case.renderer, start(case.n, rng)) for _ in range(n_starts)]
    _, ring = min(fits, key=lambda fit: fit[0])
    image = np.clip(_render(case.renderer, ring, behind)[0].image, 0, 1)
    alone, _ = _render(case.renderer, ring, wall("black"))
    is_hole = radii() < INNER - 2 * BLUR  # [SIZE, SIZE]
    return Fit(
        image,
        psnr(image, target),
        psnr(image, target, is_hole),
        float(1 - alone.alpha[is_hole].mean()),
    )


def _fit_once(behind: Gaussians, target: Floats, renderer: Renderer, first: Gaussians) -> tuple[float, Gaussians]:
    n = len(first.means)
    is_free = {name: np.ones(getattr(first, name).shape, bool) for name in FITTED}
    is_free["means"][:, 2] = False

    def unpacked(flat: Floats) -> Gaussians:
        fields, rest = {}, flat
        for name, mask in is_free.items():
            field = getattr(first, name).copy()
            field[mask], rest = rest[: mask.sum()], rest[mask.sum() :]
            fields[name] = field
        return first._replace(**fields)

    def loss(flat: Floats) -> tuple[float, Floats]:
        output, tape = _render(renderer, unpacked(flat), behind)
        residual = output.image - target  # [SIZE, SIZE, 3], not clipped, as in training
        v = renderer.render_vjp(tape, 2 * residual / residual.size, None).gaussians
        v_flat = np.concatenate([getattr(v, name)[:n][mask] for name, mask in is_free.items()])
        return float(np.mean(residual**2)), v_flat

    flat = np.concatenate([getattr(first, name)[mask] for name, mask in is_free.items()])
    best = minimize(loss, flat, jac=True, method="L-BFGS-B", options={"maxfun": EVALUATIONS, "maxiter": EVALUATIONS})
    return float(best.fun), unpacked(best.x)


def _render(renderer: Renderer, ring: Gaussians, behind: Gaussians) -> Any:
    return renderer.render(Model(concat(ring, behind)), view(), Request(backend=CPU))


def measure(n_starts: int, seed: int) -> dict[str, dict[str, Fit]]:
    """Return the fits by wall and case."""
    return {
        name: {
            case_name: fit_behind(wall(name), truth(wall(name)), case, n_starts, np.random.default_rng(seed))
            for case_name, case in kit.with_progress(CASES.items(), f"fits before {name}")
        }
        for name in WALLS
    }


def run(args: argparse.Namespace) -> kit.Report:
    """Fit a ring in front of a black wall and of a dotted one."""
    fits = measure(args.starts, args.seed)
    walls = {
        name: {case: {k: v for k, v in fit._asdict().items() if k != "image"} for case, fit in row.items()}
        for name, row in fits.items()
    }
    rows = [
        [name, case, f"{fit.psnr:.2f}", f"{fit.hole_psnr:.2f}", f"{fit.see_through:.1%}"]
        for name, cases in fits.items()
        for case, fit in cases.items()
    ]
    heading = ["wall", "Gaussians of the ring", "PSNR (dB)", "in the hole", "transmittance of the hole"]
    result = {**kit.settings_of(args, "seed", "starts"), "walls": walls}
    return kit.Report(result, draw(fits), markdown_table(heading, rows))


def draw(fits: dict[str, dict[str, Fit]]) -> Figure:
    """Draw truth and fits, one row per wall."""
    figure = Figure(figsize=(8.4, 4.9), layout="constrained")
    for row, (name, cases) in zip(figure.subplots(len(WALLS), 1 + len(CASES)), fits.items(), strict=True):
        show(row[0], truth(wall(name)), "ring, the truth")
        row[0].set_ylabel(f"wall: {name}", fontsize=9)
        for axes, (case, fit) in zip(row[1:], cases.items(), strict=True):
            hole = f"hole {fit.hole_psnr:.1f} dB, transmits {fit.see_through:.0%}"
            show(axes, fit.image, f"{case}: {fit.psnr:.1f} dB\n{hole}")
    return figure
