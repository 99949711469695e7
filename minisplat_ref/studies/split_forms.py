"""Blur split, its two forms: children drawn at random, as in the released code, or cut on the longest axis.

The recipe is trained in four ways. Two of them switch blur split off: the split by gradients uses the same rule for
children, and its effect there has to be separated from that of blur split. Means and deviations are over seeds; a seed
determines the order of views, random children and, in depth reinitialisation, pixels.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

from matplotlib.figure import Figure
from tqdm import tqdm

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.methods import RECIPES, get_recipe, mini_splatting
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.reporting import markdown_table
from minisplat_ref.strategy.blur_split import principal_axis_children
from minisplat_ref.strategy.clone_split import random_children
from minisplat_ref.studies.front import (
    BLUE,
    RED,
    describe_scene,
    mean_and_deviation,
    read_scene,
    tidy,
    title,
    write,
)
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import Recipe, configured, does, without
from minisplat_ref.types import Gaussians, Scene

FORMS: dict[str, tuple[bool, Callable[..., Gaussians]]] = {
    "none, random": (False, random_children),
    "none, principal_axis": (False, principal_axis_children),
    "random": (True, random_children),
    "principal_axis": (True, principal_axis_children),
}
"""Whether there is blur split, and which children any split has."""

MEASURES = ("psnr", "ssim", "n_gaussians", "seconds")


def run(args: argparse.Namespace) -> None:
    """Train, measure, write, print the table.

    Raises
    ------
    InputError
        The scene, the recipe or the output folder cannot be used.
    """
    scene = read_scene(args.scene, args.downscale)
    if not scene.test_views:
        raise InputError(f"scene {scene.name} has no test views to compare by: add photographs")
    recipe = get_recipe(args.recipe, args.iterations)
    if not _has_blur_split(recipe):
        names = ", ".join(name for name, other in RECIPES.items() if _has_blur_split(other))
        raise InputError(f"recipe {args.recipe} has no blur split to compare: choose from {names}")
    with making_folder(args.out) as folder:
        jobs = [(form, seed) for seed in args.seeds for form in FORMS]
        runs = [
            measure(scene, recipe, form, seed) for form, seed in tqdm(jobs, desc="trainings", leave=False, disable=None)
        ]
        summary = summarise(runs)
        description = describe_scene(scene)
        settings = {"recipe": args.recipe, "iterations": args.iterations, "seeds": list(args.seeds)}
        write(folder, {**description, **settings, "summary": summary, "runs": runs}, draw(summary, runs))
    print(title(description))
    print(f"{args.recipe}, {args.iterations} iterations, seeds {', '.join(map(str, args.seeds))}\n")
    print(markdown_table(["blur split, children", "PSNR (dB)", "SSIM", "Gaussians", "seconds"], to_rows(summary)))


def variant(recipe: Recipe, form: str) -> Recipe:
    """Return the recipe with blur split in one of the :data:`FORMS`."""
    has_blur_split, children = FORMS[form]
    recipe = configured(recipe, draw_children=children)
    return recipe if has_blur_split else without(recipe, mini_splatting.collect_blur)


def _has_blur_split(recipe: Recipe) -> bool:
    return any(does(event, mini_splatting.collect_blur) for event in recipe.events)


def measure(scene: Scene, recipe: Recipe, form: str, seed: int) -> dict[str, Any]:
    """Train once and return the test views' measures; the seconds are those of the training alone."""
    start = time.process_time()
    state = train(scene, variant(recipe, form), seed=seed)
    seconds = time.process_time() - start
    result = evaluate(state.gaussians, scene.test_views, RenderSettings(scene.background))
    measures = (result.psnr, result.ssim, len(state.gaussians.means), seconds)
    return {"form": form, "seed": seed, **dict(zip(MEASURES, measures, strict=True))}


def summarise(runs: list[dict[str, Any]]) -> dict[str, dict[str, tuple[float, float]]]:
    """Return mean and standard deviation over the seeds, for each form and measure."""
    return {
        form: {name: mean_and_deviation([run[name] for run in runs if run["form"] == form]) for name in MEASURES}
        for form in FORMS
    }


def to_rows(summary: dict[str, dict[str, tuple[float, float]]]) -> list[list[str]]:
    """Return the lines of the table."""
    digits = dict(zip(MEASURES, (2, 4, 0, 0), strict=True))
    return [
        [
            form,
            *(f"{mean:,.{digits[name]}f} ± {deviation:,.{digits[name]}f}" for name, (mean, deviation) in row.items()),
        ]
        for form, row in summary.items()
    ]


def draw(summary: dict[str, dict[str, tuple[float, float]]], runs: list[dict[str, Any]]) -> Figure:
    """Draw each seed as a point, and mean and deviation as a bar, for the three measures of the result."""
    figure = Figure(figsize=(10, 2.6), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    colors = [RED if children is random_children else BLUE for _, children in FORMS.values()]
    for axes, name, label in zip(panels, MEASURES, ("PSNR (dB)", "SSIM", "Gaussians"), strict=False):
        for line, (form, color) in enumerate(zip(FORMS, colors, strict=True)):
            mean, deviation = summary[form][name]
            axes.errorbar(mean, line, xerr=deviation, color=color, marker="o", capsize=4)
            values = [run[name] for run in runs if run["form"] == form]
            axes.plot(values, [line + 0.18] * len(values), "|", color=color, markersize=5)
        axes.set(title=label, yticks=range(len(FORMS)), yticklabels=FORMS, ylim=(-0.6, len(FORMS) - 0.4))
        tidy(axes, grid="x")
        axes.locator_params(axis="x", nbins=5)
    panels[0].invert_yaxis()  # in the order of the table
    panels[0].set_ylabel("blur split, children")
    return figure
