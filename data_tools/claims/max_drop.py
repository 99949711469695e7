"""The promise of ``simplify --max-drop``: dB that were asked for beside dB that test views lose.

The claim is ours. A scene is trained with every seed. For every limit a size is chosen as ``minisplat-ref simplify``
does it, on training views that are held out in turn. Then the model of this size is made, and compared with that of the
training on the test views. The promise is kept where these lose at most the limit, within the standard error of the
differences between them.

Trainings take long. Each writes its record to ``runs.jsonl``, and the same command with the same folder continues.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import (
    CONDITION,
    CONTINUES,
    RESUMED_SCENE,
    SEEDS,
    argument,
    declare,
    fine_tune,
    iterations,
    recipe,
)
from data_tools.claims.kit.conditions import get_condition
from data_tools.claims.kit.figures import subplots
from minisplat_ref.app.runs.opened_run import Run, check_views
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.rate_distortion import paired_drop
from minisplat_ref.app.runs.simplification import Target, decide, evaluate_views, finish, make_measure
from minisplat_ref.extensions.extension import CORE
from minisplat_ref.interface.arguments import decibels, list_of
from minisplat_ref.interface.palette import BLUE, GREEN, GREY, OCHRE, PURPLE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.methods import get_recipe
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.recipe_settings import match_calibrations
from minisplat_ref.types import Scene, number_views

COLORS = (BLUE, GREEN, OCHRE, RED, PURPLE)
TEST_EVERY = 8  # as for a folder, by default


def run(args: argparse.Namespace) -> kit.Report:
    """Train with every seed, simplify to every limit, and measure the test views."""
    scene = get_condition(args.condition)(kit.read_scene(args.scene, args.downscale))
    check_views(scene, "this claim")
    scene = scene._replace(train_views=number_views(scene.train_views))
    names = "recipe", "iterations", "fine_tune", "condition", "limits"
    settings = {**kit.describe_scene(scene), **kit.settings_of(args, *names)}
    settings["limits"] = list(settings["limits"])  # as JSON reads it again

    def measure(seed: int) -> Iterable[Mapping[str, Any]]:
        return measure_limits(train_run(scene, args, seed), args.limits, args.fine_tune)

    records = kit.resume(args.out, settings, [{"seed": seed} for seed in args.seeds], measure)
    result = {**settings, "seeds": list(args.seeds), "runs": records}
    text = f"{kit.title(result)}; {args.recipe}, {kit.seeds_of(args)}\n\n{markdown_table(*to_table(records))}"
    return kit.Report(result, draw(records), text)


def train_run(scene: Scene, args: argparse.Namespace, seed: int) -> Run:
    """Train, and return what ``simplify`` reads of the folder of a run."""
    recipe = get_recipe(args.recipe)
    if recipe.cooling is None:  # the others decide their length
        recipe = get_recipe(args.recipe, args.iterations)
    model = kit.train_with_progress(scene, recipe, seed).model
    settings = Settings(
        scene=args.scene,
        downscale=args.downscale,
        test_every=TEST_EVERY,
        recipe=args.recipe,
        schedule_iterations=recipe.iterations,
        iterations=recipe.iterations,
        seed=seed,
    )
    return Run(Path(args.scene), settings, match_calibrations(recipe, model), CORE, scene, model, None, None)


def measure_limits(run: Run, limits: Sequence[float], fine_tune: int) -> list[dict[str, Any]]:
    """Return for each limit what was chosen, and what it loses on held-out training views and on test views."""
    point_of = make_measure(run, fine_tune)
    before = [view.psnr for view in evaluate_views(run, run.model, run.scene.test_views)]
    records = []
    for limit in limits:
        decision = decide(run, Target(max_drop=limit), point_of)
        n = decision.chosen.n_gaussians
        model = run.model if decision.is_unchanged else finish(run, n, fine_tune)
        after = [view.psnr for view in evaluate_views(run, model, run.scene.test_views)]
        lost, error = paired_drop(before, after)
        records.append(
            {
                "limit": limit,
                "n_before": n_rows(run.model.gaussians),
                "n_after": n,
                "drop": decision.chosen.drop,
                "standard_error": decision.chosen.standard_error,
                "test_before": float(np.mean(before)),
                "lost": lost,
                "lost_error": None if len(before) < 2 else error,
            }
        )
    return records


def to_table(records: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return header and lines of the table, by limit and seed."""
    lines = []
    for record in sorted(records, key=lambda record: (record["limit"], record["seed"])):
        is_unchanged = record["n_after"] == record["n_before"]
        error = "" if record["lost_error"] is None else f" ± {record['lost_error']:.3f}"
        lines.append(
            [
                f"{record['limit']:g}",
                f"{record['seed']}",
                f"{record['n_before']:,}",
                "all" if is_unchanged else f"{record['n_after']:,} ({record['n_after'] / record['n_before']:.0%})",
                "" if is_unchanged else f"{record['drop']:.3f} ± {record['standard_error']:.3f}",
                "0" if is_unchanged else f"{record['lost']:.3f}{error}",
            ]
        )
    return ["asked (dB)", "seed", "Gaussians", "kept", "held-out drop (dB)", "lost on test views (dB)"], lines


def draw(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw what is lost against what was asked for; a promise that is kept lies on the diagonal or below."""
    figure, axes = subplots((4.6, 4.0))
    seeds = sorted({record["seed"] for record in records})
    for seed, color in zip(seeds, COLORS * len(seeds), strict=False):
        own = sorted((r for r in records if r["seed"] == seed), key=lambda record: record["limit"])
        limits, lost = ([record[name] for record in own] for name in ("limit", "lost"))
        errors = [record["lost_error"] or 0.0 for record in own]
        axes.errorbar(limits, lost, yerr=errors, color=color, marker="o", ms=4, capsize=3, label=f"seed {seed}")
    highest = max(record["limit"] for record in records)
    axes.plot([0, highest], [0, highest], color=GREY, linestyle="--", linewidth=1, label="as much as asked")
    axes.set(xlabel="asked: at most (dB)", ylabel="lost on test views (dB)")
    axes.legend()
    return figure


CLAIMS = (
    declare(
        "max-drop",
        "simplify --max-drop: dB that were asked for, dB that are lost",
        run,
        *RESUMED_SCENE,
        recipe("adaptive"),
        iterations(3000, "per training, of recipes with a schedule"),
        argument(
            "--limits",
            type=list_of(decibels),
            default=(0.1, 0.5, 1.0),
            metavar="L,M",
            help="of --max-drop, dB (default 0.1,0.5,1)",
        ),
        fine_tune(300),
        CONDITION,
        SEEDS,
        description=f"Train a scene, simplify to each limit, and measure what test views lose. {CONTINUES}",
    ),
)
