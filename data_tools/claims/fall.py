"""Where recipes with a schedule fall: the best moment of held-out photographs beside the end, without each mechanism.

The claim is ours. Photographs are held out in folds as by :mod:`data_tools.claims.folds`, and measured after the best
affine map of their colours every twentieth of the training, with the training photographs beside them. If a recipe
without a mechanism ends higher, the mechanism is what loses it on this scene; if it has its best moment early and the
training photographs go on rising, it fits what no other photograph shows.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.ablation.variants import FULL, MECHANISMS, variants_of
from data_tools.claims.folds import Fold, all_photographs, make_fold, read_small
from data_tools.claims.kit.claim import (
    CONTINUES,
    LONG_SIDE,
    NAMES,
    RESUMED_OUT,
    SEEDS,
    argument,
    declare,
    folds,
    iterations,
)
from data_tools.claims.kit.claim import recipe as recipe_argument
from data_tools.claims.kit.figures import standard_error, subplots
from minisplat_ref.interface.palette import SERIES
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.methods import get_recipe, mini_splatting
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure, match_calibrations
from minisplat_ref.training.schedule import Recipe, without
from minisplat_ref.training.state import StepReport

N_MOMENTS = 20  # measurements of a training
CHANGES: Mapping[str, Callable[[Recipe], Recipe]] = {
    **MECHANISMS,
    "harmonics": partial(without, action=mini_splatting.store_sh),
}


def arms_of(name: str, length: int) -> dict[str, Recipe]:
    """Return the recipe, and what differs from it: without each mechanism, and with the exposures of tracks."""
    variants = variants_of(get_recipe(name), length, CHANGES)
    exposed = configure(variants[FULL], exposure="tracks")
    return {FULL: variants[FULL], **{f"- {k}": v for k, v in variants.items() if k != FULL}, "+ exposures": exposed}


def measure(fold: Fold, recipe: Recipe, seed: int) -> dict[str, Any]:
    """Train on a fold; return the curve of step, held-out and training PSNR, and the number of Gaussians."""
    scene, curve = fold.scene, []
    every = max(1, recipe.iterations // N_MOMENTS)

    def on_step(report: StepReport) -> None:
        if report.step % every and report.step != report.last_step:
            return
        model = report.state.model
        settings = RenderSettings(scene.background, renderer=match_calibrations(recipe, model).renderer)
        held_out, trained = (evaluate(model, views, settings) for views in (scene.test_views, scene.train_views))
        curve.append([report.step, held_out.psnr_corrected, trained.psnr, len(model.gaussians.means)])

    train(scene, recipe, seed=seed, on_step=on_step)
    return {"curve": curve}


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure.

    Raises
    ------
    InputError
        The scene, the recipe or the output folder cannot be used.
    """
    scene, arms = read_small(args.scene, args.long_side), arms_of(args.recipe, args.iterations)
    arms = {name: arms[name] for name in arms if args.arms is None or name.strip("-+ ") in (FULL, *args.arms)}
    views = all_photographs(scene, args.thinned)
    settings = {"scene": scene.name, "thinned": args.thinned, **kit.settings_of(args, "recipe", "iterations", "folds")}
    jobs = kit.jobs_of(fold=range(args.folds), seed=args.seeds, arm=arms)
    records = kit.resume(
        args.out,
        settings,
        jobs,
        lambda fold, seed, arm: measure(make_fold(scene, views, args.folds, fold), arms[arm], seed),
    )
    rows = [summarise(records, arm) for arm in arms]
    title = f"{scene.name}{', thinned' * args.thinned}, {len(views)} photographs in {args.folds} folds; {args.recipe},"
    title += f" {args.iterations:,} iterations, {kit.seeds_of(args)}; {describe_machine()}"
    heading = ["recipe", "best (dB)", "at iteration", "end (dB)", "fall (dB)", "end, minus the recipe's (dB)"]
    heading += ["training photographs (dB)", "Gaussians"]
    text = f"{title}\n\n{markdown_table(heading, [_cells(row) for row in rows])}"
    return kit.Report({**settings, "summary": rows, "runs": records}, draw(records, list(arms)), text)


def summarise(records: Sequence[Mapping[str, Any]], arm: str) -> dict[str, Any]:
    """Return the row of an arm, over folds and seeds; differences are paired by both."""
    own = {(r["fold"], r["seed"]): r["curve"] for r in records if r["arm"] == arm}
    full = {(r["fold"], r["seed"]): r["curve"][-1][1] for r in records if r["arm"] == FULL}
    best = [max(curve, key=lambda point: point[1]) for curve in own.values()]
    ends = [curve[-1] for curve in own.values()]
    differences = [curve[-1][1] - full[job] for job, curve in own.items()]
    return {
        "arm": arm,
        "best": float(np.mean([point[1] for point in best])),
        "best_step": float(np.median([point[0] for point in best])),
        "end": float(np.mean([point[1] for point in ends])),
        "difference": float(np.mean(differences)),
        "difference_error": standard_error(differences),
        "trained": float(np.mean([point[2] for point in ends])),
        "n_gaussians": float(np.mean([point[3] for point in ends])),
    }


def _cells(row: Mapping[str, Any]) -> list[str]:
    error = "" if row["difference_error"] is None else f" ± {row['difference_error']:.2f}"
    return [
        row["arm"],
        f"{row['best']:.2f}",
        f"{row['best_step']:,.0f}",
        f"{row['end']:.2f}",
        f"{row['best'] - row['end']:.2f}",
        "" if row["arm"] == FULL else f"{row['difference']:+.2f}{error}",
        f"{row['trained']:.2f}",
        f"{row['n_gaussians']:,.0f}",
    ]


def draw(records: Sequence[Mapping[str, Any]], arms: Sequence[str]) -> Figure:
    """Draw the held-out PSNR over the iterations, the mean of folds and seeds, a line for each arm."""
    figure, axes = subplots((7.0, 4.2))
    for k, arm in enumerate(arms):
        curves = np.array([r["curve"] for r in records if r["arm"] == arm])  # [F, T, 4]
        color, width = SERIES[k % len(SERIES)], 2.4 if arm == FULL else 1.1
        axes.plot(curves[0, :, 0], curves[:, :, 1].mean(axis=0), color=color, linewidth=width, label=arm)
    axes.set(xlabel="iterations", ylabel="held-out photographs, colours corrected (dB)")
    axes.legend(fontsize=7)
    return figure


CLAIMS = (
    declare(
        "fall",
        "where a recipe with a schedule has its best moment, and what loses it",
        run,
        argument("scene", metavar="SCENE", help="folder of a scene, or a synthetic one"),
        RESUMED_OUT,
        recipe_argument("mini-splatting2"),
        iterations(3000),
        folds(3),
        argument("--thinned", action="store_true", help="take about ten of the photographs"),
        argument("--arms", type=NAMES, metavar="A,B", help="only these mechanisms, or 'exposures' (default: all)"),
        LONG_SIDE,
        SEEDS,
        description="Train with and without each mechanism, and measure held-out photographs on the way. " + CONTINUES,
    ),
)
