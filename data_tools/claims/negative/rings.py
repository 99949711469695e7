"""Claim ``negative/rings``: differences of two Gaussians against sums of positive ones, without compositing.

The paper is NegGS, arXiv 2405.18163. This is the setting of the paper's argument. In a plane, ``f(x) = sum_k s_k w_k
exp(-|L_k (x - m_k)|^2 / 2)`` has given signs s_k, and everything else is fitted to the image of a ring by least
squares. The fit is not convex, so it starts several times, and the best result counts.

The quality of a pair depends on the allowed heights of its two Gaussians. The best pair of all consists of two huge
ones that almost cancel, the derivative of a Gaussian with respect to its width; so the pair is fitted with two bounds
of the heights.
"""

import argparse
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import least_squares
from scipy.special import erf, expit, logit

from data_tools.claims import kit
from data_tools.claims.kit.figures import plot_band, show, with_deviation
from minisplat_ref.interface.palette import BLUE, LIGHT_BLUE, MIDDLE_BLUE, OCHRE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.types import Floats

OUTER = 0.7  # radius; the image is the square from -1 to 1
THICKNESSES = (0.9, 0.75, 0.6, 0.45, 0.3, 0.2)  # of the ring, in units of its outer radius
BLUR = 0.04  # standard deviation of the edges
SIZE = 32  # samples per side
PARAMETERS = ("a", "m_x", "m_y", "L_xx", "L_yy", "L_yx")
EVALUATIONS = 200  # at most, of one fit


class Sum(NamedTuple):
    """The Gaussians of a sum."""

    signs: tuple[int, ...]
    height_max: float  # of each; the ring's is 1
    color: str  # of the curve


MODELS = {
    "pair, heights to 2": Sum((1, -1), 2.0, OCHRE),
    "pair, heights to 100": Sum((1, -1), 100.0, RED),
    "2 positive": Sum((1,) * 2, 100.0, LIGHT_BLUE),
    "3 positive": Sum((1,) * 3, 100.0, MIDDLE_BLUE),
    "4 positive": Sum((1,) * 4, 100.0, BLUE),
}
PAIRS, POSITIVES = tuple(MODELS)[:2], tuple(MODELS)[2:]


class Fit(NamedTuple):
    """The best of several fits."""

    psnr: float  # dB, peak 1, over the square
    image: Floats  # [SIZE, SIZE]
    heights: tuple[float, ...]  # s_k w_k


def grid() -> Floats:
    """Return the centres of the samples [SIZE^2, 2], row by row."""
    axis = (np.arange(SIZE) + 0.5) * (2 / SIZE) - 1
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def ring(thickness: float) -> Floats:
    """Return the image [SIZE^2] of a ring with soft edges; the thickness is in units of the outer radius."""
    radii = np.linalg.norm(grid(), axis=1)
    inside, outside = (erf((radii - r) / (np.sqrt(2) * BLUR)) for r in (OUTER * (1 - thickness), OUTER))
    return 0.5 * (inside - outside)


def hills(parameters: Floats, model: Sum, points: Floats) -> tuple[Floats, Floats]:
    """Return the terms ``s_k w_k exp(-|L_k (x - m_k)|^2 / 2)``, and their derivatives.

    The height is ``w = w_max sigmoid(a)``. With ``y = L (x - m)`` and the value f of the term::

        df/da = f (1 - sigmoid(a)),   df/dm = f L^T y,   df/dL = -f y (x - m)^T

    Parameters
    ----------
    parameters : ndarray of shape (K, 6)
        In the order of ``PARAMETERS``; L is lower triangular, and its entries may have any sign.
    model : Sum
        Signs and bounds of the heights.
    points : ndarray of shape (P, 2)
        x.

    Returns
    -------
    values : ndarray of shape (K, P)
    jacobian : ndarray of shape (K, 6, P)
    """
    a, m_x, m_y, L_xx, L_yy, L_yx = parameters.T[:, :, None]  # [K, 1] each
    x, y = points[:, 0] - m_x, points[:, 1] - m_y  # [K, P]
    u, v = L_xx * x, L_yx * x + L_yy * y  # [K, P]
    f = _heights(parameters, model)[:, None] * np.exp(-0.5 * (u * u + v * v))  # [K, P]
    jacobian = np.stack(
        [f * expit(-a), f * (L_xx * u + L_yx * v), f * L_yy * v, -f * u * x, -f * v * y, -f * v * x], axis=1
    )
    return f, jacobian


def _heights(parameters: Floats, model: Sum) -> Floats:
    """Return s_k w_k [K]."""
    return np.array(model.signs) * model.height_max * expit(parameters[:, 0])


def fit_ring(target: Floats, model: Sum, n_starts: int, rng: np.random.Generator) -> Fit:
    """Return the best of ``n_starts`` least-squares fits to an image [SIZE^2]."""
    points, n = grid(), len(model.signs)

    def residuals(flat: Floats) -> Floats:
        return hills(flat.reshape(n, -1), model, points)[0].sum(axis=0) - target

    def jacobian(flat: Floats) -> Floats:
        return hills(flat.reshape(n, -1), model, points)[1].reshape(flat.size, -1).T

    fits = [
        least_squares(residuals, _start(model, rng).ravel(), jacobian, method="lm", max_nfev=EVALUATIONS)
        for _ in range(n_starts)
    ]
    best = min(fits, key=lambda fit: fit.cost)
    image = (best.fun + target).reshape(SIZE, SIZE)
    heights = _heights(best.x.reshape(n, -1), model)  # [K]
    return Fit(float(-10 * np.log10(np.mean(best.fun**2))), image, tuple(heights.tolist()))


def _start(model: Sum, rng: np.random.Generator) -> Floats:
    """Draw parameters [K, 6] of round Gaussians anywhere in the ring, of a third to all of its size and height 0.7."""
    n = len(model.signs)
    L = np.exp(rng.uniform(0, np.log(3), n)) / OUTER  # [K]
    centres = rng.uniform(-OUTER, OUTER, (n, 2)) / np.sqrt(2)
    return np.column_stack([np.full(n, logit(0.7 / model.height_max)), centres, L, L, np.zeros(n)])


def measure(n_seeds: int, n_starts: int) -> dict[float, dict[str, list[Fit]]]:
    """Return the fits by thickness and model, one per seed."""
    return {
        thickness: {
            name: [fit_ring(ring(thickness), model, n_starts, np.random.default_rng(seed)) for seed in range(n_seeds)]
            for name, model in MODELS.items()
        }
        for thickness in kit.with_progress(THICKNESSES, "rings")
    }


def crossings(pair: list[float], other: list[float]) -> list[float]:
    """Return the thicknesses at which one of two curves of PSNR over ``THICKNESSES`` crosses the other."""
    leads, ends = np.subtract(pair, other), np.array(THICKNESSES)
    steps = np.flatnonzero(leads[:-1] * leads[1:] < 0)
    parts = leads[steps] / (leads[steps] - leads[steps + 1])  # linear between two rings
    places: list[float] = (ends[steps] + parts * (ends[steps + 1] - ends[steps])).tolist()
    return places


def run(args: argparse.Namespace) -> kit.Report:
    """Fit rings of several thicknesses with one pair and with 2 to 4 positive Gaussians."""
    fits = measure(args.seeds, args.starts)
    psnrs = {name: [[fit.psnr for fit in fits[t][name]] for t in THICKNESSES] for name in MODELS}
    means = {name: [float(np.mean(values)) for values in rows] for name, rows in psnrs.items()}
    crossed = {pair: {name: crossings(means[pair], means[name]) for name in POSITIVES} for pair in PAIRS}
    heights = {pair: [[fit.heights for fit in fits[t][pair]] for t in THICKNESSES] for pair in PAIRS}
    result = {**kit.settings_of(args, "seeds", "starts"), "thicknesses": list(THICKNESSES), "psnr": psnrs}
    result |= {"mean_psnr": means, "crossings": crossed, "heights": heights}
    rows = [
        [f"{thickness}", *(with_deviation(psnrs[name][t], 1) for name in MODELS)]
        for t, thickness in enumerate(THICKNESSES)
    ]
    text = "PSNR (dB) of the best fit: mean over the seeds ± standard deviation\n\n"
    text += markdown_table(["thickness / outer radius", *MODELS], rows) + "\n"
    for pair, others in crossed.items():
        places = [f"{name} at {', '.join(f'{x:.2f}' for x in xs) or 'no thickness'}" for name, xs in others.items()]
        text += f"\n{pair}: crosses {'; '.join(places)}"
    return kit.Report(result, draw(fits), text, arms=psnrs)


def draw(fits: dict[float, dict[str, list[Fit]]]) -> Figure:
    """Draw the PSNR over the thickness, and the fits of a thick and of a thin ring."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1, 1.35))[0]
    axes = left.subplots()
    for name, model in MODELS.items():
        values = np.array([[fit.psnr for fit in fits[thickness][name]] for thickness in THICKNESSES])  # [T, seeds]
        plot_band(axes, THICKNESSES, values.T, model.color, name)
    axes.set(title="best fit, PSNR (dB)", xlabel="thickness of the ring / outer radius")
    axes.set_ylim(bottom=axes.get_ylim()[0] - 2)  # room for the legend
    axes.legend(loc="lower center", ncols=2)
    colors = {"cmap": "RdBu_r", "vmin": -1, "vmax": 1}
    for row, thickness in zip(right.subplots(2, len(MODELS)), (0.75, 0.2), strict=True):
        show(row[0], ring(thickness).reshape(SIZE, SIZE), f"ring of {thickness}", **colors)
        for ax, name in zip(row[1:], (*PAIRS, *POSITIVES[1:]), strict=True):
            fit = fits[thickness][name][0]
            show(ax, fit.image, f"{name}\n{fit.psnr:.1f} dB", **colors)
    return figure
