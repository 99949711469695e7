"""The results of a comparison, from its finished runs, and their form in compare.json."""

import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.app.comparison.crops import Crop, choose_crops
from minisplat_ref.app.comparison.metrics import (
    METRICS,
    PER_PHOTOGRAPH,
    RecipeMetrics,
    final_psnr,
    read_curve,
    read_metrics,
    read_photographs,
    relation,
)
from minisplat_ref.app.comparison.plan import Plan, load_fold
from minisplat_ref.app.comparison.speed import render_rates
from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.events import count_published_times, read_mechanisms
from minisplat_ref.app.runs.recipe_actions import Fired
from minisplat_ref.app.runs.scoring import load_trained
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.reporting import describe_machine
from minisplat_ref.types import NOTHING, Scene


class Results(NamedTuple):
    """All that was found."""

    recipes: Sequence[RecipeMetrics]
    """Measures, in the order of the plan."""
    curves: dict[str, list[list[dict[str, Any]]]]
    """For every recipe the records of ``curve.jsonl`` of each run."""
    fired: Sequence[Fired]
    """The mechanisms that acted, in the order of the plan."""
    crops: Sequence[Crop]
    """Parts of test views, rendered with the first run of each recipe."""
    lpips_reason: str | None
    """The reason why LPIPS is missing."""
    lpips_network: str | None
    """By which network LPIPS was measured."""
    machine: str
    """Machine and versions, on which times and memory depend."""


def collect(plan: Plan, scene: Scene) -> Results:
    """Read and measure the runs of a plan that has been carried out.

    Parameters
    ----------
    plan : Plan
        All its runs are finished.
    scene : Scene
        As it was loaded for the plan, that of the first fold.
    """
    runs = plan.runs
    models = {run.folder: load_trained(run.folder) for run in runs}
    rates: dict[Path, float] = {}
    for fold in range(plan.folds or 1):
        own = [run.folder for run in runs if run.fold == fold]
        fold_scene = scene if fold == 0 else load_fold(plan, fold)
        rates |= zip(own, render_rates([models[folder] for folder in own], fold_scene), strict=True)
    targets = {(run.seed, run.fold): final_psnr(run.folder) for run in plan.list_runs(plan.recipes[0])}
    recipes = []
    for recipe in plan.recipes:
        own_runs = plan.list_runs(recipe)
        of_runs = [read_metrics(run.folder, targets[run.seed, run.fold], rates[run.folder]) for run in own_runs]
        photographs = NOTHING if plan.folds is None else read_photographs(run.folder for run in own_runs)
        recipes.append(RecipeMetrics(recipe, of_runs, photographs))
    shown = [models[run.folder] for run in runs[: len(plan.recipes)]]
    metrics = run_folder.read_json_object(runs[0].folder / run_folder.METRICS)
    return Results(
        recipes=recipes,
        curves={recipe: [read_curve(run.folder) for run in plan.list_runs(recipe)] for recipe in plan.recipes},
        fired=read_fired(plan),
        crops=choose_crops(shown, scene),
        lpips_reason=metrics["lpips_reason"],
        lpips_network=metrics["lpips_network"],
        machine=f"{describe_machine()}, {platform.platform()}",
    )


def to_json(plan: Plan, scene: Scene, results: Results) -> dict[str, Any]:
    """Return the content of compare.json."""
    camera = scene.test_views[0].camera
    return {
        "settings": {
            **plan._asdict(),
            "scene": str(plan.scene.resolve()),
            "folder": str(plan.folder.resolve()),
            **plan.files,
            "eval_every": [plan.list_runs(recipe)[0].eval_every for recipe in plan.recipes],
        },
        "scene": {
            "name": scene.name,
            "n_train_views": len(scene.train_views),
            "n_test_views": len(scene.test_views),
            "width": camera.width,
            "height": camera.height,
            "n_points": len(scene.points),
        },
        "machine": results.machine,
        "lpips_reason": results.lpips_reason,
        "lpips_network": results.lpips_network,
        "measures": [metric._asdict() for metric in METRICS],
        "recipes": [
            _recipe_to_json(plan, recipe, results.recipes[0], fired)
            for recipe, fired in zip(results.recipes, results.fired, strict=True)
        ],
    }


def read_fired(plan: Plan) -> list[Fired]:
    """Return the mechanisms that fired in the finished runs of a plan, recipe by recipe."""
    found = []
    for name, iterations in zip(plan.recipes, plan.iterations, strict=True):
        recipe = find_recipe(name)
        published = count_published_times(recipe)
        runs = [read_mechanisms(run.folder / run_folder.EVENTS, published) for run in plan.list_runs(name)]
        found.append(Fired(name, iterations, recipe.iterations, published, runs))
    return found


def _recipe_to_json(plan: Plan, recipe: RecipeMetrics, first: RecipeMetrics, fired: Fired) -> dict[str, Any]:
    spreads = {metric: recipe.compute_spread(metric) for metric in METRICS}
    runs = zip(plan.list_runs(recipe.recipe), recipe.runs, fired.runs, strict=True)
    return {
        "recipe": recipe.recipe,
        "mean": {metric.key: value.mean for metric, value in spreads.items()},
        "std": {metric.key: value.std for metric, value in spreads.items()},
        "relative_to_first": {
            metric.key: relation(metric, value, first.compute_spread(metric)) for metric, value in spreads.items()
        },
        "error_of_difference": {
            metric.key: recipe.error_of_difference(metric, first)
            for metric in METRICS
            if metric.relation == "difference"
        },
        **({} if plan.folds is None else _validation_to_json(recipe)),
        "never_fired": fired.never,
        "runs": [
            {
                "seed": run.seed,
                **({} if plan.folds is None else {"fold": run.fold}),
                "folder": run.folder.name,
                **metrics,
                "mechanisms": [mechanism._asdict() for mechanism in mechanisms],
            }
            for run, metrics, mechanisms in runs
        ],
    }


def _validation_to_json(recipe: RecipeMetrics) -> dict[str, Any]:
    """Return what folds add to a recipe: the metrics of each photograph, and the errors of their means."""
    return {
        "standard_error": {
            metric.key: recipe.compute_error(metric) for metric in METRICS if metric.key in PER_PHOTOGRAPH
        },
        "photographs": recipe.photographs,
    }
