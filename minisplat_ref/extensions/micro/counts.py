"""The study ``micro/counts``: whether Micro-splatting needs fewer Gaussians than 3DGS, and what its second stage gains.

Three curves of PSNR over the number of Gaussians. That of ``3dgs-accel`` is drawn by its threshold of densification;
those of ``micro``, with its second stage and without, by their penalty of size, of which more makes more Gaussians.
"""

import argparse
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from minisplat_ref.backends import CPU
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.reporting import markdown_table
from minisplat_ref.reports.palette import BLUE, GREY, RED
from minisplat_ref.studies import kit
from minisplat_ref.studies.figures import with_deviation
from minisplat_ref.training.schedule import configure
from minisplat_ref.types import Scene

PLAIN, FIRST, BOTH = "3dgs-accel", "micro, first stage alone", "micro"
COLORS = {PLAIN: GREY, FIRST: BLUE, BOTH: RED}
THRESHOLDS = (2e-4, 4e-4, 8e-4, 1.6e-3)  # in normalised device coordinates
_LIMITS = (0.05, 0.1, 0.2)  # trace_limit
_NO_SECOND_STAGE = {"score_mass": 1.0, "merge_reach": 0.0}
ARMS: dict[str, tuple[dict[str, float], ...]] = {
    PLAIN: tuple({"threshold": threshold} for threshold in THRESHOLDS),
    FIRST: tuple({"trace_limit": limit, **_NO_SECOND_STAGE} for limit in _LIMITS),
    BOTH: tuple({"trace_limit": limit} for limit in _LIMITS),
}


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure."""
    scene = kit.read_scene(args.scene, args.downscale)
    jobs = [(name, settings) for name, of_arm in ARMS.items() for settings in of_arm]
    points = [measure(scene, name, settings, args.iterations, args.seeds) for name, settings in jobs]
    description = {**kit.describe_scene(scene), **kit.settings_of(args, "iterations", "seeds")}
    heading = ["recipe", "set", "Gaussians", "test PSNR (dB)", "test SSIM"]
    text = f"{kit.title(description)}; {args.iterations} iterations; mean over the seeds ± standard deviation"
    table = markdown_table(heading, [to_line(point) for point in points])
    arms = {f"{point['recipe']}, {point['settings']}": point["psnr"] for point in points}
    return kit.Report({**description, "points": points}, draw(points), f"{text}\n\n{table}", arms)


def measure(scene: Scene, name: str, settings: dict[str, float], iterations: int, n_seeds: int) -> dict[str, Any]:
    """Return the measures of one point of a curve, over the seeds."""
    recipe = configure(find_recipe(PLAIN if name == PLAIN else BOTH, iterations), **settings)
    point: dict[str, Any] = {"recipe": name, "settings": settings, "n_gaussians": [], "psnr": [], "ssim": []}
    for seed in range(n_seeds):
        state = kit.train_with_progress(scene, recipe, seed, backend=CPU)
        found = evaluate(state.model, scene.test_views, RenderSettings(scene.background, renderer=recipe.renderer))
        point["n_gaussians"].append(len(state.gaussians.means))
        point["psnr"].append(found.psnr)
        point["ssim"].append(found.ssim)
    return point


def to_line(point: dict[str, Any]) -> list[str]:
    """Return a line of the table."""
    shown = ", ".join(f"{name} {value:g}" for name, value in point["settings"].items() if name not in _NO_SECOND_STAGE)
    measures = [with_deviation(point["n_gaussians"], 0), with_deviation(point["psnr"], 2)]
    return [point["recipe"], shown, *measures, with_deviation(point["ssim"], 4)]


def draw(points: list[dict[str, Any]]) -> Figure:
    """Draw each curve, with all of its trainings as points."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for name, color in COLORS.items():
        own = sorted((p for p in points if p["recipe"] == name), key=lambda p: float(np.mean(p["n_gaussians"])))
        axes.plot(
            [np.mean(p["n_gaussians"]) for p in own], [np.mean(p["psnr"]) for p in own], "-", color=color, label=name
        )
        for p in own:
            axes.plot(p["n_gaussians"], p["psnr"], "o", ms=3, color=color)
    axes.set_xscale("log")
    axes.set(xlabel="Gaussians", ylabel="test PSNR (dB)")
    axes.legend()
    return figure
