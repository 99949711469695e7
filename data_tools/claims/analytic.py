"""Claim ``analytic/footprint``: alphas of one Gaussian in the pixels around it against exact integrals.

The paper is Analytic-Splatting, arXiv 2403.11056. The truth of a round Gaussian is a product of differences of error
functions; that of a needle at an angle is the mean of 48 x 48 values per pixel. Compared with it are the value at the
pixel's centre, that value with the dilation of 3DGS or with Mip-Splatting's filter, which keeps the integral, and the
integral along the footprint's axes with either distribution function.
"""

import argparse

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, number, seed
from data_tools.claims.kit.figures import set_ticks
from minisplat_ref.extensions.analytic.response import EXACT_RESPONSE, LOGISTIC, NORMAL, RESPONSE, integrals
from minisplat_ref.interface.palette import BLUE, GREEN, GREY, OCHRE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.reference.antialiasing import compensations
from minisplat_ref.reference.hits import CONIC, Response
from minisplat_ref.types import Floats, Projection

SIGMAS = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)  # px
ELONGATION = 5.0  # of the needle
REACH = 12  # pixels from the middle to the edge of the image
SAMPLES = 48  # per pixel and side
DILATION, MIP = 0.3, 0.1  # px^2
OPACITY = 0.8
METHODS = ("centre", "dilation", "Mip filter", "integral, logistic", "integral, erf")
COLORS = (GREY, RED, OCHRE, BLUE, GREEN)


def run(args: argparse.Namespace) -> kit.Report:
    """Measure the errors over sizes, for a round Gaussian and for a needle."""
    found, largest = measure(args.places, args.seed), largest_difference()
    settings = {**kit.settings_of(args, "places", "seed"), "sigmas": list(SIGMAS)}
    rows = [
        [shape, f"{sigma:g}", *(f"{methods[name][s]:.2g}" for name in METHODS)]
        for shape, methods in found.items()
        for s, sigma in enumerate(SIGMAS)
    ]
    text = "RMS error of alpha, relative to the RMS of its exact mean over the pixel\n\n"
    text += markdown_table(["shape", "sigma (px)", *METHODS], rows)
    text += f"\n\nThe distribution functions differ by {largest:.1e} at most."
    result = {**settings, "errors": found, "largest_difference_of_distributions": largest}
    return kit.Report(result, draw(found), text)


def centres() -> Floats:
    """Return the pixels' centres [P, 2], px, around the origin's pixel."""
    steps = np.arange(-REACH, REACH + 1) + 0.5
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def covariance(sigma: float, elongation: float, angle: float) -> Floats:
    """Return the covariance [2, 2], px^2, with standard deviations ``sigma`` and ``elongation`` times that."""
    cos, sin = np.cos(angle), np.sin(angle)
    R = np.array([[cos, -sin], [sin, cos]])
    return R @ np.diag([(elongation * sigma) ** 2, sigma**2]) @ R.T


def alphas_of(mean: Floats, C: Floats, response: Response, opacity: float = OPACITY) -> Floats:
    """Return the alphas [P] of one Gaussian under a response."""
    conic = np.linalg.inv(C)[[0, 0, 1], [0, 1, 1]]
    ones = np.ones((1, 2), np.int32)
    projection = Projection(mean[None], np.ones(1), conic[None], np.array([opacity]), ones, np.zeros((1, 4), np.int32))
    alphas: Floats = response.hit(projection, np.zeros(1, int), centres()).unclamped[0]
    return alphas


def truth(mean: Floats, C: Floats) -> Floats:
    """Return the mean alpha [P] of each pixel, by error functions if C is round, otherwise by many samples."""
    offsets = mean - centres()  # [P, 2]
    if C[0, 1] == 0:
        rates = 1 / np.sqrt(np.diag(C))
        return OPACITY * 2 * np.pi / rates.prod() * integrals(offsets, rates, NORMAL).prod(axis=1)
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    points = offsets[:, None] + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, -1, 2)  # [P, S, 2]
    exponents = np.einsum("psi,ij,psj->ps", points, np.linalg.inv(C), points)
    means: Floats = OPACITY * np.exp(-0.5 * exponents).mean(axis=1)
    return means


def approximations(mean: Floats, C: Floats) -> dict[str, Floats]:
    """Return the alphas [P] by each method."""
    mip = C + MIP * np.eye(2)
    compensated = OPACITY * float(compensations(C[None], mip[None])[0])
    return {
        "centre": alphas_of(mean, C, CONIC),
        "dilation": alphas_of(mean, C + DILATION * np.eye(2), CONIC),
        "Mip filter": alphas_of(mean, mip, CONIC, compensated),
        "integral, logistic": alphas_of(mean, C, RESPONSE),
        "integral, erf": alphas_of(mean, C, EXACT_RESPONSE),
    }


def errors(sigma: float, elongation: float, n: int, rng: np.random.Generator) -> dict[str, float]:
    """Return the relative RMS errors over pixels and ``n`` positions of the centre; needles have random angles."""
    squared, total = dict.fromkeys(METHODS, 0.0), 0.0
    for _ in range(n):
        mean, angle = rng.uniform(0, 1, 2), 0.0 if elongation == 1 else rng.uniform(0, np.pi)
        C = covariance(sigma, elongation, angle)
        exact = truth(mean, C)
        total += float(np.sum(exact**2))
        for name, alphas in approximations(mean, C).items():
            squared[name] += float(np.sum((alphas - exact) ** 2))
    return {name: float(np.sqrt(value / total)) for name, value in squared.items()}


def measure(n: int, seed: int) -> dict[str, dict[str, list[float]]]:
    """Return the errors over ``SIGMAS``, by shape and method."""
    found: dict[str, dict[str, list[float]]] = {}
    for shape, elongation, places in (("round", 1.0, n), ("needle", ELONGATION, max(1, n // 8))):
        rng = np.random.default_rng(seed)
        rows = [errors(sigma, elongation, places, rng) for sigma in kit.with_progress(SIGMAS, shape)]
        found[shape] = {name: [row[name] for row in rows] for name in METHODS}
    return found


def largest_difference() -> float:
    """Return the largest difference between the two distribution functions."""
    x = np.linspace(-6, 6, 24_001)
    return float(np.abs(LOGISTIC.cdf(x) - NORMAL.cdf(x)).max())


def draw(found: dict[str, dict[str, list[float]]]) -> Figure:
    """Draw the errors against sigma for a round Gaussian and for a needle."""
    figure = Figure(figsize=(9.5, 3.6), layout="constrained")
    titles = {"round": "round Gaussian", "needle": f"needle, {ELONGATION:g} times as long, at random angles"}
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (shape, methods) in zip(panels, found.items(), strict=True):
        for name, color in zip(METHODS, COLORS, strict=True):
            axes.loglog(SIGMAS, np.maximum(methods[name], 1e-6), "o-", ms=4, color=color, label=name)
        axes.set(title=titles[shape], xlabel="standard deviation (px)", ylim=(1e-4, 100))
        set_ticks(axes, (0.1, 0.3, 1, 3), ("0.1", "0.3", "1", "3"))
    panels[0].set_ylabel("RMS error / RMS of the integral")
    panels[1].legend()
    return figure


CLAIMS = (
    declare(
        "footprint",
        "alpha of one Gaussian against its integral over pixels",
        run,
        OUT,
        number("--places", 64, "positions within a pixel"),
        seed("of positions and angles"),
    ),
)
