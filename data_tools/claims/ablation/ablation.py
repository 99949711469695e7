"""The effect of each mechanism of Mini-Splatting: compare the recipe with the recipe without one of them, by seed.

A mechanism is removed by a setting or by leaving out its event; everything else, including all dates, stays. A row
about a mechanism that never acts would be meaningless. So there is none if it has no date at this length, or did not
fire in the full training according to its record of events: small photographs, for example, are never halved. Nor is
there one if the training without it is the full training to the last digit: it fired, but did nothing. The claim
can do the same for our own deviations from the published method (``docs/FIDELITY.md``).

Trainings take long. Each writes its record to ``runs.jsonl`` as soon as it ends, and the same command with the same
folder continues with those that are missing.
"""

import argparse
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.ablation.variants import ACTIONS, DEVIATIONS, FULL, MECHANISMS, variants_of
from data_tools.claims.kit.conditions import get_condition
from data_tools.claims.kit.figures import plus_minus, subplots, summarise
from minisplat_ref.errors import InputError
from minisplat_ref.interface.palette import BLUE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.methods import RECIPES, get_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import Recipe, scale_recipe
from minisplat_ref.types import Scene

METRICS = ("psnr", "ssim", "n_gaussians", "seconds")


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure.

    Raises
    ------
    InputError
        The scene, a recipe or the output folder cannot be used, or no mechanism acted.
    """
    scene = kit.read_scene(args.scene, args.downscale)
    published, rules = get_recipe(args.recipe), DEVIATIONS if args.deviations else MECHANISMS
    recipe = scale_recipe(published, args.iterations)
    variants = variants_of(published, args.iterations, rules)
    if len(variants) == 1:
        names = [r.name for r in RECIPES.values() if len(variants_of(r, args.iterations, rules)) > 1]
        raise InputError(f"recipe {args.recipe} has nothing to take out: choose from {', '.join(names)}")
    scene = get_condition(args.condition)(scene)
    description = kit.describe_scene(scene)
    settings = {"recipe": recipe.name, "iterations": recipe.iterations, "downscale": args.downscale}
    settings |= {"condition": args.condition}

    jobs = kit.jobs_of(seed=args.seeds, without=variants)
    identity = {**settings, "deviations": args.deviations, "scene": description["scene"]}
    records = kit.resume(args.out, identity, jobs, lambda seed, without: measure(scene, variants[without], seed))
    acts = count_actions(records, variants)
    idle = [name for name, n in acts.items() if n == 0]
    if len(idle) == len(variants) - 1:
        raise InputError(f"nothing that can be taken out ever acted ({', '.join(idle)}): {kit.REMEDY}")
    records_of_acting = [record for record in records if record["without"] not in idle]
    names, alike = kit.leave_out_idle(kit.arms_of(records_of_acting, "without", ("psnr", "ssim", "n_gaussians")))
    summary = differences([record for record in records if record["without"] in names])
    result = {**description, **settings, "seeds": list(args.seeds), "acts": acts, "summary": summary, "runs": records}
    length = f"{recipe.name}, {recipe.iterations} iterations"
    table = markdown_table(["without", "acts", "PSNR (dB)", "difference (dB)", "Gaussians", "seconds"], to_rows(result))
    text = f"{kit.title(description)}\n{length}, condition {args.condition}, {kit.seeds_of(args)}\n\n{table}"
    text += f"\n\nnever acted, so that nothing can be said of it: {', '.join(idle)}" if idle else ""
    text += alike
    return kit.Report(result, draw(summary), text)


def count_actions(records: Sequence[Mapping[str, Any]], variants: Iterable[str]) -> dict[str, int]:
    """Return how often each mechanism fired in a full training, the least of all seeds."""
    fired = [record["fired"] for record in records if record["without"] == FULL]
    names = {name: ACTIONS[name].__name__ for name in variants if name in MECHANISMS}
    return {name: min(times.get(action, 0) for times in fired) for name, action in names.items()}


def measure(scene: Scene, recipe: Recipe, seed: int) -> dict[str, Any]:
    """Train once; return the test views' metrics, the training's processor seconds, and counts of fired events."""
    fired: Counter[str] = Counter()
    start = time.process_time()
    state = train(scene, recipe, seed=seed, on_step=lambda report: fired.update(e.action for e in report.fired))
    seconds = time.process_time() - start
    result = evaluate(state.model, scene.test_views, RenderSettings(scene.background))
    measures = (result.psnr, result.ssim, len(state.gaussians.means), seconds)
    return {**dict(zip(METRICS, measures, strict=True)), "fired": dict(fired)}


def differences(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, tuple[float, float]]]:
    """Return mean and deviation over the seeds, for each variant and measure.

    ``difference`` is that of the PSNR from the full recipe's with the same seed, so that its deviation excludes the
    effect of the seed that both share.
    """
    full = {record["seed"]: record["psnr"] for record in records if record["without"] == FULL}
    compared = [{**record, "difference": record["psnr"] - full[record["seed"]]} for record in records]
    return summarise(compared, "without", (*METRICS, "difference"))


def to_rows(result: Mapping[str, Any]) -> list[list[str]]:
    """Return the lines of the table."""
    rows = []
    for variant, row in result["summary"].items():
        difference = "" if variant == FULL else "{:+.2f} ± {:.2f}".format(*row["difference"])
        acts = str(result["acts"].get(variant, ""))
        psnr = plus_minus(row["psnr"], 2)
        counts = (f"{row['n_gaussians'][0]:,.0f}", f"{row['seconds'][0]:.0f}")
        rows.append([variant if variant == FULL else f"- {variant}", acts, psnr, difference, *counts])
    return rows


def draw(summary: Mapping[str, Mapping[str, tuple[float, float]]]) -> Figure:
    """Draw for each variant the difference of the PSNR, and the number of Gaussians."""
    figure, (left, right) = subplots((10, 0.34 * len(summary) + 1.2), 1, 2, sharey=True)
    names = [name if name == FULL else f"without {name}" for name in summary]
    for line, row in enumerate(summary.values()):
        mean, deviation = row["difference"]
        left.errorbar(mean, line, xerr=deviation, color=RED if mean < -deviation else BLUE, marker="o", capsize=4)
        right.barh(line, row["n_gaussians"][0], color=BLUE, height=0.6)
    left.axvline(0, color="black", linewidth=0.8)
    left.set(xlabel="PSNR, difference from everything (dB)", yticks=range(len(names)), yticklabels=names)
    right.set_xlabel("Gaussians")
    left.invert_yaxis()
    for axes in (left, right):
        axes.grid(visible=False, axis="y")
    return figure
