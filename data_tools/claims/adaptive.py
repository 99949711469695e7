"""Compare ``adaptive`` with recipes with a schedule: on a scene as it is, with few photographs, with wrong exposures.

The claim is ours. Every recipe is trained with every seed under every condition. The test views are evaluated during
training, without counting the time or influencing the training. So besides the final PSNR and the count, this reports
the time until a recipe reaches the final PSNR of the first recipe minus 0.1 dB, and how far the PSNR has fallen from
its maximum. Times are processor times (of all threads of the process together), which other programs disturb less than
wall time.

With ``--rules`` it compares ``adaptive`` with itself without one of its rules; with ``--sweep``, with itself at other
thresholds of growth, which give more Gaussians and fewer: which number would have been best, and by how much. A rule
without which the training is the same to the last digit is named below the table, without a row.

Trainings take long. Each writes its record to ``runs.jsonl``, and the same command with the same folder continues.
"""

import argparse
import contextlib
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import (
    CONDITION_HELP,
    CONTINUES,
    NAMES,
    RESUMED_SCENE,
    SEEDS,
    argument,
    declare,
    one_of,
)
from data_tools.claims.kit.conditions import get_condition
from data_tools.claims.kit.figures import standard_error
from minisplat_ref.errors import InputError
from minisplat_ref.interface.palette import BLUE, GREEN, OCHRE, PURPLE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.methods import gaussian_splatting, get_recipe
from minisplat_ref.methods.adaptive.degrees import cut_degrees_when_cooling, raise_degrees
from minisplat_ref.methods.adaptive.growth import grow
from minisplat_ref.methods.adaptive.numbers import RAISED
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.calibration import NONE
from minisplat_ref.training.loop import train
from minisplat_ref.training.rates import Rates, n_coefficients, present_degrees
from minisplat_ref.training.recipe_settings import configure, match_calibrations, settings_of
from minisplat_ref.training.schedule import Recipe, does, scale_recipe
from minisplat_ref.training.state import Iteration, StepReport, TrainState
from minisplat_ref.types import Gaussians, Scene

ITERATIONS = 3000  # of recipes with a schedule
WARM_UP = 20  # iterations
N_MEASUREMENTS = 24  # in those iterations; for adaptive with the same interval
NEAR = 0.1  # dB
MEANS = ("psnr", "n_gaussians", "n_numbers", "step", "seconds")  # over seeds
COLORS = (BLUE, GREEN, OCHRE, RED, PURPLE)


def with_clones(recipe: Recipe) -> Recipe:
    """Return the recipe with the clones and splits of 3DGS in place of halves."""
    action = partial(clones_while_growing, threshold=2e-4, size_fraction=0.01)
    events = (event._replace(action=action) if does(event, grow) else event for event in recipe.events)
    return recipe._replace(events=tuple(events))


def clones_while_growing(
    state: TrainState, iteration: Iteration, *, threshold: float, size_fraction: float
) -> str | None:
    """Clone and split as 3DGS does, until the rates fall."""
    if state.pace.cooling_from is not None:
        return "nothing done: the learning rates are falling"
    return gaussian_splatting.clone_and_split(state, iteration, threshold=threshold, size_fraction=size_fraction)


def with_published_rates(recipe: Recipe) -> Recipe:
    """Return the recipe with the initial rates of 3dgs-accel."""
    rates = gaussian_splatting.GS_ACCEL.learning_rates
    return recipe._replace(learning_rates=Rates(rates.at(0, 1.0), rates.per_extent))


def with_faster_means(recipe: Recipe) -> Recipe:
    """Return the recipe with the rate of the means raised by the square, as in short runs of other recipes."""
    rates = recipe.learning_rates
    return recipe._replace(learning_rates=rates.change(means=RAISED * rates.at(0, extent=1.0)["means"]))


def without_cool_down(recipe: Recipe) -> Recipe:
    """Return the recipe with constant rates to the end."""
    assert recipe.cooling is not None
    return recipe._replace(cooling=recipe.cooling._replace(last=1.0, last_per_extent=1.0))


def without_growth(recipe: Recipe) -> Recipe:
    """Return the recipe with as many Gaussians as there are points."""
    return recipe._replace(events=tuple(event for event in recipe.events if not does(event, grow)))


def with_all_bands(recipe: Recipe) -> Recipe:
    """Return the recipe with the harmonics of 3DGS: all degrees for all Gaussians, one more every 200 iterations."""
    actions = raise_degrees, cut_degrees_when_cooling
    events = tuple(event for event in recipe.events if not does(event, *actions))
    return recipe._replace(events=events, sh_milestones=(200, 400, 600))


def with_growth(recipe: Recipe, **factors: float) -> Recipe:
    """Return the recipe with settings of its growth multiplied by factors."""
    settings = settings_of(recipe)
    return configure(recipe, **{name: factor * settings[name] for name, factor in factors.items()})


RULES: Mapping[str, Callable[[Recipe], Recipe]] = {
    "adaptive": lambda recipe: recipe,
    "no growth": without_growth,
    "clones of 3DGS": with_clones,
    "largest gradients first": lambda recipe: configure(recipe, error_views=0),
    "rates of 3DGS": with_published_rates,
    "faster means": with_faster_means,
    "no cool-down": without_cool_down,
    "large views at once": lambda recipe: configure(recipe, min_side=math.inf),
    "all bands": with_all_bands,
    "no bands": lambda recipe: configure(recipe, views_per_coefficient=math.inf),
    "no cut of bands": lambda recipe: configure(recipe, min_variation=0.0),
    "no sky": lambda recipe: configure(recipe, min_sky_gain=math.inf),
    "no prune": lambda recipe: configure(recipe, min_slope=0.0, min_views=0),
    "no exposures": lambda recipe: configure(recipe, exposure=NONE),
    "no poses": lambda recipe: configure(recipe, min_pose_gain=math.inf),
    "no anti-aliasing": lambda recipe: configure(recipe, min_antialiasing_gain=math.inf),
}

SWEEP: Mapping[str, Callable[[Recipe], Recipe]] = {
    **{f"threshold x {factor:g}": partial(with_growth, threshold=factor) for factor in (8.0, 4.0, 2.0, 1.4)},
    "adaptive": lambda recipe: recipe,
    **{
        f"threshold / 2, growth x {factor:g}": partial(with_growth, threshold=0.5, max_growth=factor)
        for factor in (1.5, 2.0, 3.0)
    },
}
"""Eight counts. In small photographs nearly all gradients are above the threshold, and the growth at a time decides."""


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure.

    Raises
    ------
    InputError
        The scene, a recipe or the output folder cannot be used.
    """
    scene = kit.read_scene(args.scene, args.downscale)
    conditions = {name: get_condition(name) for name in args.conditions}
    variants = RULES if args.rules else SWEEP if args.sweep else {}
    recipes = {name: change(ADAPTIVE) for name, change in variants.items()} or _recipes_by_name(args.recipes)
    description = kit.describe_scene(scene)
    settings = {"scene": description["scene"], "downscale": args.downscale, "recipes": list(recipes)}
    records = kit.resume(
        args.out,
        settings,
        kit.jobs_of(condition=args.conditions, seed=args.seeds, recipe=recipes),
        lambda condition, seed, recipe: measure(conditions[condition](scene), recipes[recipe], seed),
        lambda missing: warm_up(scene, recipes.values() if missing else ()),
    )
    as_decided = sorted(records, key=lambda record: record["recipe"] != "adaptive")  # its row stays
    names, alike = kit.leave_out_idle(kit.arms_of(as_decided, "recipe", ("psnr", "ssim", "n_gaussians", "n_numbers")))
    measured, records = records, [record for record in records if record["recipe"] in names]
    rows = summarise(records)
    result = {**description, **settings, "seeds": list(args.seeds), "summary": rows, "runs": measured}
    heading = ["PSNR (dB)", "fall since its best", "Gaussians", "numbers", "iterations", "seconds"]
    until = f"until {next(iter(recipes))} - {NEAR} dB"
    table = markdown_table(["condition", "recipe", *heading, until], [_cells(row) for row in rows])
    text = f"{kit.title(description)}\n{kit.seeds_of(args)}; seconds of the processor\n\n{table}"
    for condition in args.conditions if args.sweep else ():
        text += f"\n\n{condition}: {describe_regret([r for r in records if r['condition'] == condition])}"
    text += alike
    return kit.Report(result, draw(records), text)


def _recipes_by_name(names: Sequence[str]) -> dict[str, Recipe]:
    """Return recipes by their names; adaptive without one of its rules has that rule's name."""
    return {name: RULES[name](ADAPTIVE) if name in RULES else get_recipe(name, ITERATIONS) for name in names}


def warm_up(scene: Scene, recipes: Iterable[Recipe]) -> None:
    """Train every recipe for a moment, so that no training counts the time of compiling."""
    for recipe in recipes:
        with contextlib.suppress(InputError):  # so short a schedule may be impossible
            train(scene, scale_recipe(recipe, WARM_UP), seed=0)


def measure(scene: Scene, recipe: Recipe, seed: int) -> dict[str, Any]:
    """Train once; return the last measures of the test views, the seconds of the training alone, and its curve."""
    curve: list[dict[str, float | None]] = []
    paused, every = 0.0, ITERATIONS // N_MEASUREMENTS
    start = time.process_time()

    def on_step(report: StepReport) -> None:
        nonlocal paused
        if report.step % every and report.step != report.last_step:
            return
        now = time.process_time()
        model = report.state.model
        renderer = match_calibrations(recipe, model).renderer
        value = evaluate(model, scene.test_views, RenderSettings(scene.background, renderer=renderer))
        n = len(report.state.gaussians.means)
        curve.append({"step": report.step, "seconds": now - start - paused, "psnr": value.psnr, "n_gaussians": n})
        curve[-1] |= {"ssim": value.ssim, "n_numbers": n_numbers(report.state.gaussians)}
        paused += time.process_time() - now

    state = train(scene, recipe, seed=seed, on_step=on_step)
    decisions = [decision._asdict() for decision in state.pace.decisions]
    return {**curve[-1], "curve": curve, "decisions": decisions}


def n_numbers(gaussians: Gaussians) -> int:
    """Return how many numbers a model consists of, without those of bands of the harmonics that are zero."""
    n_others = sum(int(np.prod(field.shape[1:])) for name, field in gaussians._asdict().items() if name != "sh_rest")
    return int((n_others + 3 * n_coefficients(present_degrees(gaussians.sh_rest))).sum())


def summarise(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each condition and recipe: means over the seeds, the standard error of the PSNR's difference.

    The others are compared with the first recipe, seed by seed.
    """
    rows = []
    for condition in dict.fromkeys(record["condition"] for record in records):
        own = [record for record in records if record["condition"] == condition]
        names = list(dict.fromkeys(record["recipe"] for record in own))
        first = {record["seed"]: record for record in own if record["recipe"] == names[0]}
        for name in names:
            runs = [record for record in own if record["recipe"] == name]
            differences = [run["psnr"] - first[run["seed"]]["psnr"] for run in runs]
            until = [seconds_until(run["curve"], first[run["seed"]]["psnr"] - NEAR) for run in runs]
            rows.append(
                {
                    "condition": condition,
                    "recipe": name,
                    **{k: float(np.mean([run[k] for run in runs])) for k in MEANS},
                    "difference": float(np.mean(differences)),
                    "standard_error": standard_error(differences),
                    "fall": float(np.mean([max(p["psnr"] for p in run["curve"]) - run["psnr"] for run in runs])),
                    "until": None if None in until else float(np.mean([s for s in until if s is not None])),
                }
            )
    return rows


def regret(records: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """Return what the chosen count costs, over the trainings of one seed under one condition.

    Returns
    -------
    regret : float
        dB from the chosen count to the best one.
    ratio : float
        The chosen count, as a multiple of the smallest that is within :data:`NEAR` of the best.
    """
    chosen = next(record for record in records if record["recipe"] == "adaptive")
    best = max(record["psnr"] for record in records)
    smallest = min(record["n_gaussians"] for record in records if record["psnr"] >= best - NEAR)
    return best - chosen["psnr"], chosen["n_gaussians"] / smallest


def describe_regret(records: Sequence[Mapping[str, Any]]) -> str:
    """Return the mean of :func:`regret` over the seeds, in words."""
    seeds = dict.fromkeys(record["seed"] for record in records)
    each = [regret([record for record in records if record["seed"] == seed]) for seed in seeds]
    cost, ratio = np.mean(each, axis=0)
    return f"the count of adaptive costs {cost:.2f} dB, and is {ratio:.2f} times the smallest adequate one"


def seconds_until(curve: Sequence[Mapping[str, float]], psnr: float) -> float | None:
    """Return when a training first had a PSNR, None if it never did."""
    return next((point["seconds"] for point in curve if point["psnr"] >= psnr), None)


def _cells(row: Mapping[str, Any]) -> list[str]:
    error = "" if row["standard_error"] is None else f" ± {row['standard_error']:.2f}"
    return [
        row["condition"],
        row["recipe"],
        f"{row['psnr']:.2f} ({row['difference']:+.2f}{error})",
        f"{row['fall']:.2f}",
        f"{row['n_gaussians']:,.0f}",
        f"{row['n_numbers']:,.0f}",
        f"{row['step']:,.0f}",
        f"{row['seconds']:.0f}",
        "never" if row["until"] is None else f"{row['until']:.0f}",
    ]


def draw(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw PSNR over seconds, a panel for each condition, a line for each training."""
    conditions = list(dict.fromkeys(record["condition"] for record in records))
    names = list(dict.fromkeys(record["recipe"] for record in records))
    figure = Figure(figsize=(4.2 * len(conditions), 3.6), layout="constrained")
    for axes, condition in zip(np.atleast_1d(figure.subplots(1, len(conditions))), conditions, strict=True):
        for record in (record for record in records if record["condition"] == condition):
            color = COLORS[names.index(record["recipe"]) % len(COLORS)]
            is_first = record["seed"] == records[0]["seed"]
            points = [(point["seconds"], point["psnr"]) for point in record["curve"]]
            label = record["recipe"] if is_first else None
            axes.plot(*zip(*points, strict=True), color=color, label=label, linewidth=1.2)
            axes.plot(*points[-1], "o", color=color, markersize=4)
        axes.set(title=condition, xlabel="seconds of the processor", ylabel="held-out PSNR (dB)")
        highest = max(point["psnr"] for r in records if r["condition"] == condition for point in r["curve"])
        axes.set_ylim(highest - 8, highest + 0.5)
    figure.axes[0].legend()
    return figure


CLAIMS = (
    declare(
        "adaptive",
        "the recipe that decides for itself, beside those with a schedule",
        run,
        *RESUMED_SCENE,
        argument(
            "--recipes",
            type=NAMES,
            default=("3dgs-accel", "mini-splatting", "mini-splatting2", "adaptive"),
            metavar="R,Q",
            help="the first is what the others are compared with; also names of --rules (default: three of 3000"
            " iterations, and adaptive)",
        ),
        one_of(
            argument("--rules", action="store_true", help="adaptive beside itself without each of its rules"),
            argument("--sweep", action="store_true", help="adaptive beside itself with more Gaussians and fewer"),
        ),
        argument(
            "--conditions",
            type=NAMES,
            default=("whole", "few", "gains"),
            metavar="C,D",
            help=f"{CONDITION_HELP} (default: the first three)",
        ),
        SEEDS,
        description=f"Train a scene by adaptive and by recipes with a schedule, as it is and disturbed. {CONTINUES}",
    ),
)
