"""Claim ``cus/growth``: trainings with and without the growing of anchors, from many points and from few.

The paper is CUS-GS, arXiv 2511.17904. Scene, teacher and measures are those of ``cus/floats`` (:mod:`.floats`). Where
growing adds anchors, more floats may be all that helps, so a third arm has no growing but smaller voxels from the
start; from few points there are no more anchors to be had like this, and the arm is left out.
"""

import argparse
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.cus.floats import (
    SIZE,
    counts,
    features_of_anchors,
    make_task,
    psnr_of,
    quality,
    recipe_of,
)
from data_tools.claims.kit.figures import group, mean_and_deviation, subplots
from data_tools.claims.kit.tables import mean, spread, table
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.extensions.cus.model import LATENT
from minisplat_ref.extensions.cus.recipe import THRESHOLD, grow_anchors
from minisplat_ref.interface.palette import BLUE, GREY, RED
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import Recipe, without

POINTS = (2_000, 300)  # that trainings begin with; the first is as in cus/floats
WITHOUT, WITH, SMALLER = "without growing", "with growing", "smaller voxels"
COLORS = {WITHOUT: GREY, WITH: RED, SMALLER: BLUE}
COLUMNS = (
    ("anchors", mean("anchors")),
    ("floats in all", mean("all_floats")),
    ("PSNR dB", spread("psnr", 2)),
    ("error of features", spread("error", 4)),
    ("mean IoU", spread("iou", 3)),
)
SMALLER_VOXEL = 0.4  # about as many anchors from 2,000 points as growing ends with


def arms_from(recipe: Recipe, n_points: int) -> Mapping[str, Recipe]:
    """Return the recipes to compare, by name."""
    still = without(recipe, grow_anchors)
    arms = {WITHOUT: still, WITH: configure(recipe, growth_threshold=THRESHOLD)}
    return {**arms, SMALLER: configure(still, voxel=SMALLER_VOXEL)} if n_points == POINTS[0] else arms


def measure(iterations: int, n_points: int, seed: int) -> list[dict[str, Any]]:
    """Train all arms from so many points, and return their records."""
    made = make_scene("room", **{**SIZE, "n_points": n_points})
    records = []
    with tempfile.TemporaryDirectory() as folder:
        task = make_task(made, seed, Path(folder))
        for arm, recipe in arms_from(recipe_of(LATENT, iterations, task.folder), n_points).items():
            model = kit.train_with_progress(task.scene, recipe, seed).model
            records.append(
                {
                    "arm": f"{n_points:,} points, {arm}",
                    "anchors": len(model.gaussians.means),
                    "psnr": psnr_of(model, task.scene, recipe),
                    **counts(model),
                    **quality(task, lambda view, model=model: features_of_anchors(model, view)),  # type: ignore[misc]
                }
            )
    return records


def run(args: argparse.Namespace) -> kit.Report:
    """Train all arms with every seed."""
    settings = {**kit.describe_scene(make_scene("room", **SIZE).scene), **kit.settings_of(args, "iterations")}
    jobs = kit.jobs_of(n_points=POINTS, seed=range(args.seeds))
    records = kit.resume(args.out, settings, jobs, partial(measure, args.iterations))
    return report(records, {**settings, "seeds": args.seeds}, f"{kit.title(settings)}; {args.iterations} iterations")


def report(records: list[dict[str, Any]], settings: dict[str, Any], heading: str) -> kit.Report:
    """Return table and figure of the records of all arms."""
    text = f"{heading}\n\n{table(records, {'arm': 'arm'}, COLUMNS)}"
    arms = kit.arms_of(records, "arm", ("anchors", "psnr", "error"))
    return kit.Report({**settings, "records": records}, draw(records), text, arms=arms)


def draw(records: list[dict[str, Any]]) -> Figure:
    """Plot PSNR and error of features of all arms over their floats."""
    figure, panels = subplots((9, 3.6), 1, 2)
    for axes, (key, label) in zip(panels, {"psnr": "PSNR dB", "error": "error of features"}.items(), strict=True):
        for name, own in group(records, "arm").items():
            points, arm = name.split(", ")
            deviations = mean_and_deviation([record[key] for record in own])
            floats = np.mean([record["all_floats"] for record in own])
            marker = "o" if points == f"{POINTS[0]:,} points" else "s"
            axes.errorbar(floats, *deviations, fmt=marker, color=COLORS[arm], label=name)
        axes.set(xlabel="floats in all", ylabel=label)
    axes.legend(fontsize=8)
    return figure
