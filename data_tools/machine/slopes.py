"""Scaling of cost: views of the same random scene from few Gaussians to many, and from small images to large.

The cost of a renderer close to its limit is proportional to *hits*, the pairs (pixel, Gaussian) that contribute to the
image; that of a naive one to all Gaussians times all pixels. The slope is that of a straight line through the
logarithms: 1 is proportional, 0 is constant. Time is forward and backward together, float32, all threads, the least of
its runs; views are timed alternately, so that a slow minute of the machine affects all of them.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.bench.interleaving import time_interleaved
from minisplat_ref.bench.workloads import Workload, synth
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.oracle.tolerances import BENCH_FLIPPED_PIXELS, BENCH_FLOAT32_IMAGE
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Floats, Gaussians

FOCAL_OF_WIDTH = 400 / 480  # of ``synth``: a larger image shows the same at a higher resolution
SMALL, MIDDLE, LARGE = (480, 270), (960, 540), (1920, 1080)
VIEWS: tuple[tuple[int, tuple[int, int]], ...] = (
    (12_500, SMALL),
    (25_000, SMALL),
    (50_000, SMALL),
    (100_000, SMALL),
    (200_000, SMALL),
    (50_000, MIDDLE),
    (50_000, LARGE),
    (200_000, LARGE),
)
"""Number of Gaussians, and size of the image in pixels."""


class View(NamedTuple):
    """A view to time."""

    workload: Workload
    n_hits: int
    flipped: float
    """Fraction of the pixels that differ from float64 by more than float32's tolerance."""
    draw: Callable[[], object]
    """Draws and differentiates it."""


def slope_cases(repeats: int, report: Callable[[str], None] = lambda _: None) -> list[Case]:
    """Time every view and fit the slopes.

    Parameters
    ----------
    repeats : int
        Runs of each.
    report : callable
        Called with a line about the progress.

    Returns
    -------
    list of Case
        One per view, which fails if the image is not that of the float64 kernels, then the slopes.
    """
    views = []
    for n, (width, height) in VIEWS:
        report(f"slopes: {n:,} Gaussians, {width} x {height}")
        views.append(_view(synth(n, width, height, FOCAL_OF_WIDTH * width)))
    report("slopes: taking turns")
    [times] = time_interleaved([[view.draw for view in views]], 1, repeats)
    least = [view.minimum for view in times]
    cases = [_case(view, seconds) for view, seconds in zip(views, least, strict=True)]
    sizes = [(len(v.workload.gaussians.means), v.workload.camera.width * v.workload.camera.height) for v in views]
    hits = [view.n_hits for view in views]
    passed = all(case.passed for case in cases)
    note = "" if passed else "an image is wrong"
    for name, costs in (("hits", hits), ("N x pixels", [n * pixels for n, pixels in sizes])):
        slope, spread = fit_slope(costs, least)
        cases.append(Case(f"slope/time against {name}", passed, {"slope": slope, "spread": spread}, note))
    return cases


def fit_slope(costs: Sequence[float], seconds: Sequence[float]) -> tuple[float, float]:
    """Fit ``log seconds = slope log costs + constant``.

    Returns
    -------
    slope : float
        1 where time is proportional to cost.
    spread : float
        Largest factor between a time and the line.
    """
    x, y = np.log(costs), np.log(seconds)
    slope, constant = np.polyfit(x, y, 1)
    return float(slope), float(np.exp(np.abs(slope * x + constant - y).max()))


def flipped_pixels(image: Floats, exact: Floats) -> float:
    """Return the fraction of pixels that differ by more than float32 explains, or are not finite."""
    return float(np.mean(~(np.abs(image - exact).max(axis=2) <= BENCH_FLOAT32_IMAGE)))


def _view(workload: Workload) -> View:
    gaussians = Gaussians._make(field.astype(np.float32) for field in workload.gaussians)
    v_image = workload.v_image.astype(np.float32)
    output, _ = render(gaussians, workload.camera, with_stats=True)
    assert output.stats is not None
    n_hits = int(output.stats.hit_count.sum(dtype=np.int64))
    exact, _ = render(workload.gaussians, workload.camera, backend=CPU)
    workload = workload._replace(v_image=v_image)  # the float64 one is large, and no longer needed

    def draw() -> object:
        return render_vjp(render(gaussians, workload.camera)[1], v_image)

    return View(workload, n_hits, flipped_pixels(output.image, exact.image), draw)


def _case(view: View, seconds: float) -> Case:
    camera, n = view.workload.camera, len(view.workload.gaussians.means)
    figures: dict[str, Figure] = {
        "hits": view.n_hits,
        "ms": 1e3 * seconds,
        "ns a hit": 1e9 * seconds / view.n_hits,
        "ns a (Gaussian, pixel)": 1e9 * seconds / (n * camera.width * camera.height),
        "flips %": 100 * view.flipped,
    }
    passed = view.flipped <= BENCH_FLIPPED_PIXELS
    note = "" if passed else f"more than {BENCH_FLIPPED_PIXELS:.0e} of the pixels are not those of float64"
    return Case(f"slope/{n:,} Gaussians, {camera.width} x {camera.height}", passed, figures, note)
