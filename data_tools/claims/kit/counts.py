"""Curves of quality over the number of Gaussians, for claims that compare methods at an equal number.

A curve is a recipe whose number of Gaussians follows from some setting: a threshold of densification, a penalty. Each
of its points is trained with every seed, and a measurement that was interrupted continues.
"""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from data_tools.claims import kit
from data_tools.claims.kit.detail import quality
from data_tools.claims.kit.figures import with_deviation
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import NOTHING, Scene

MEASURES = {"n_gaussians": 0, "psnr": 2, "flat": 2, "textured": 2}
"""Columns of the table, with their digits."""
HEADING = ("recipe", "set", "Gaussians", "PSNR (dB)", "flatter half", "textured half")


class Curve(NamedTuple):
    """A recipe, and the settings of its points."""

    recipe: str
    """Its name."""
    points: tuple[Mapping[str, float], ...]
    """What :func:`~minisplat_ref.training.recipe_settings.configure` changes in each."""
    color: str
    common: Mapping[str, float] = NOTHING
    """What it changes in all."""


def measure_curves(
    args: argparse.Namespace, curves: Mapping[str, Curve], find: Callable[[str, int], Recipe]
) -> kit.Report:
    """Train all points with every seed, and set the curves side by side.

    Parameters
    ----------
    args : Namespace
        ``scene``, ``out``, ``downscale``, ``iterations`` and ``seeds``, a number.
    curves : mapping
        By the name that table and figure show.
    find : callable
        Returns the recipe of a name, scaled to so many iterations.
    """
    scene = kit.read_scene(args.scene, args.downscale)
    settings = {**kit.describe_scene(scene), **kit.settings_of(args, "iterations")}
    jobs: list[dict[str, Any]] = [
        {"curve": name, "settings": dict(point), "seed": seed}
        for name, curve in curves.items()
        for point in curve.points
        for seed in range(args.seeds)
    ]

    def train_and_measure(curve: str, settings: dict[str, float], seed: int) -> dict[str, Any]:
        recipe = find(curves[curve].recipe, args.iterations)
        return measure(scene, configure(recipe, **curves[curve].common, **settings), seed)

    found = kit.resume(args.out, settings, jobs, train_and_measure)
    records = [record for job in jobs for record in found if job.items() <= record.items()]
    points = points_of(records)
    text = f"{kit.title(settings)}; {args.iterations} iterations; means over {args.seeds} seeds ± standard deviation"
    table = markdown_table(HEADING, [to_line(own) for own in points])
    arms = {f"{own[0]['curve']}, {own[0]['settings']}": [record["psnr"] for record in own] for own in points}
    result = {**settings, "seeds": args.seeds, "records": records}
    return kit.Report(result, draw(records, curves), f"{text}\n\n{table}", arms)


def measure(scene: Scene, recipe: Recipe, seed: int) -> dict[str, Any]:
    """Return number and quality of one training."""
    state = kit.train_with_progress(scene, recipe, seed, backend=CPU)
    found = quality(state.model, scene, RenderSettings(scene.background, renderer=recipe.renderer))
    return {"n_gaussians": len(state.gaussians.means), **found._asdict()}


def points_of(records: Iterable[Mapping[str, Any]]) -> list[list[Mapping[str, Any]]]:
    """Return the records of all seeds of each point, in the order of the points."""
    points: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for record in records:
        points.setdefault((record["curve"], *sorted(record["settings"].items())), []).append(record)
    return list(points.values())


def to_line(own: list[Mapping[str, Any]]) -> list[str]:
    """Return a line of the table."""
    shown = ", ".join(f"{name} {value:g}" for name, value in own[0]["settings"].items())
    measures = [with_deviation([record[name] for record in own], digits) for name, digits in MEASURES.items()]
    return [own[0]["curve"], shown, *measures]


def draw(records: Sequence[Mapping[str, Any]], curves: Mapping[str, Curve]) -> Figure:
    """Draw each curve for all pixels and for the textured half, with all trainings as points."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    panels = zip(figure.subplots(1, 2), (("psnr", "all pixels"), ("textured", "the textured half")), strict=True)
    for axes, (measured, heading) in panels:
        for name, curve in curves.items():
            own = [(r["n_gaussians"], r[measured]) for r in records if r["curve"] == name]
            means = [
                np.mean([(r["n_gaussians"], r[measured]) for r in point], axis=0)
                for point in points_of(records)
                if point[0]["curve"] == name
            ]
            axes.plot(*np.transpose(sorted(map(tuple, means))), "-", color=curve.color, label=name)
            axes.plot(*np.transpose(own), "o", ms=3, color=curve.color)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.minorticks_off()
        axes.set(xlabel="Gaussians", ylabel="test PSNR (dB)", title=heading)
    axes.legend()
    return figure
