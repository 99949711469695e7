"""Claim ``omg/distinctiveness`` (arXiv 2503.16924): which Gaussians of a scene to keep, and what they cost as a file.

The Gaussians come from a training with Mini-Splatting2 or from a PLY. Of those that dominate a pixel, equally many are
kept by importance alone and by importance times distinctiveness squared; both selections are fine-tuned for the same
number of iterations, without any event. Then each is written as ``.omg`` and read again. For the whole population, each
field by itself is taken from such a file at every level, which shows where the quality is lost.

Distinctiveness hurts flat regions, because these consist of Gaussians whose neighbours have the same colour. So the
claim measures the flatter half of each test photograph and the rest apart (:mod:`data_tools.claims.kit.detail`).
"""

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.detail import Quality, quality
from data_tools.claims.kit.figures import plot_deviations, set_ticks, subplots, with_deviation
from data_tools.claims.kit.tables import mean, spread, table
from minisplat_ref.extensions.omg.file import OMG_FILE, find_order
from minisplat_ref.extensions.omg.recipe import POWER, distinct_importance, local_distinctiveness
from minisplat_ref.interface.palette import BLUE, GREY, OCHRE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.io.ply import load_ply
from minisplat_ref.methods import get_recipe
from minisplat_ref.strategy.importance import collect_importance, indoor
from minisplat_ref.strategy.ops import take
from minisplat_ref.strategy.simplify import intersection_preserving, most_important
from minisplat_ref.types import Gaussians, Scene

FRACTIONS = (0.5, 0.25, 0.125)
FINE_TUNING = "3dgs"  # the recipe whose learning rates are used, from the first to the last
CHOICES = {"importance": 0.0, "with distinctiveness": POWER}
"""The selections, with the power of distinctiveness in their score."""
COLORS = dict(zip(CHOICES, (BLUE, RED), strict=True))


def run(args: argparse.Namespace) -> kit.Report:
    """Train, prune, fine-tune and measure; each seed is a record, and a measurement that was interrupted continues."""
    scene = kit.read_scene(args.scene, args.downscale)
    settings = {**kit.describe_scene(scene), **kit.settings_of(args, "recipe", "iterations", "fine_tune")}
    settings |= {"power": POWER} | ({} if args.ply is None else {"ply": str(args.ply)})

    def measure_seed(seed: int) -> dict[str, Any]:
        recipe = get_recipe(args.recipe, args.iterations)
        whole = load_ply(args.ply) if args.ply else kit.train_with_progress(scene, recipe, seed).gaussians
        return {"rows": measure(whole, scene, args.fine_tune, seed), "losses": losses_of_fields(whole, scene)}

    records = kit.resume(args.out, settings, kit.jobs_of(seed=args.seeds), measure_seed)
    records.sort(key=lambda record: record["seed"])
    runs = [record["rows"] for record in records]
    losses = {field: [record["losses"][field] for record in records] for field in records[0]["losses"]}
    result = {**settings, "seeds": list(args.seeds), "runs": runs, "losses": losses}
    text = f"{kit.title(settings)}; {kit.seeds_of(args)}; fine-tuned {args.fine_tune} iterations\n\n"
    columns = [(name, spread(value, digits)) for name, (value, digits) in COLUMNS.items()]
    rows = [row for run in runs for row in run]
    text += table(rows, {"kept": "kept", "choice": "by"}, [("Gaussians", mean("n_gaussians")), *columns])
    text += "\n\ndB lost by one field from the file, at each level\n\n"
    lost = [
        [field, *(with_deviation(of_seeds, 2) for of_seeds in zip(*of_levels, strict=True))]
        for field, of_levels in losses.items()
    ]
    text += markdown_table(["field", *map(str, range(len(OMG_FILE.levels)))], lost)
    arms = kit.arms_of([row for row in rows if row["choice"]], "choice", ("at_once", "tuned"))
    return kit.Report(result, draw(result), text, arms)


def measure(whole: Gaussians, scene: Scene, iterations: int, seed: int) -> list[dict[str, Any]]:
    """Return the measurements of the whole population, and of each fraction and choice."""
    stats = collect_importance(whole, scene.train_views)
    importance = intersection_preserving(indoor(stats), stats.dominant_count)  # [N]
    distinctiveness = local_distinctiveness(whole.means, whole.sh_dc)
    recipe = kit.drop_events(get_recipe(FINE_TUNING, iterations))
    tuned = kit.fine_tune(whole, scene, recipe, seed)
    rows = [_row("all", "", quality(whole, scene), tuned, scene)]
    jobs = [(fraction, choice) for fraction in FRACTIONS for choice in CHOICES]
    for fraction, choice in kit.with_progress(jobs, f"fine-tunings, seed {seed}"):
        score = distinct_importance(importance, distinctiveness, CHOICES[choice])
        n = max(1, round(fraction * np.count_nonzero(importance)))
        kept = take(whole, most_important(score, min(n, int(np.count_nonzero(score)))))
        at_once = quality(kept, scene)
        rows.append(_row(f"{100 * fraction:g} %", choice, at_once, kit.fine_tune(kept, scene, recipe, seed), scene))
    return rows


def _row(kept: str, choice: str, at_once: Quality, tuned: Gaussians, scene: Scene) -> dict[str, Any]:
    content = OMG_FILE.encode(tuned, OMG_FILE.default_level)
    return {
        "kept": kept,
        "choice": choice,
        "n_gaussians": len(tuned.means),
        "at_once": at_once._asdict(),
        "tuned": quality(tuned, scene)._asdict(),
        "n_bytes": len(content),
        "packed": quality(OMG_FILE.decode(content, OMG_FILE.suffix), scene)._asdict(),
    }


def losses_of_fields(gaussians: Gaussians, scene: Scene) -> dict[str, list[float]]:
    """Return the loss at each level, dB, when one field alone is taken from a file; by field."""
    whole = take(gaussians, find_order(gaussians))
    before = quality(whole, scene).psnr
    losses: dict[str, list[float]] = {field: [] for field in Gaussians._fields}
    for level in range(len(OMG_FILE.levels)):
        back = OMG_FILE.decode(OMG_FILE.encode(gaussians, level), OMG_FILE.suffix)
        for field, of_levels in losses.items():
            of_levels.append(before - quality(whole._replace(**{field: getattr(back, field)}), scene).psnr)
    return losses


COLUMNS: dict[str, tuple[Callable[[dict[str, Any]], float], int]] = {
    "at once": (lambda row: row["at_once"]["psnr"], 2),
    "fine-tuned": (lambda row: row["tuned"]["psnr"], 2),
    "flat half": (lambda row: row["tuned"]["flat"], 2),
    "textured half": (lambda row: row["tuned"]["textured"], 2),
    "kB of .omg": (lambda row: row["n_bytes"] / 1e3, 1),
    "dB as .omg": (lambda row: row["packed"]["psnr"], 2),
}
"""Measures of a row of the results, and their digits in the table."""


def draw(result: dict[str, Any]) -> Figure:
    """Draw PSNR against the fraction kept, the gain of distinctiveness in either half, and PSNR against bytes."""
    runs = result["runs"]
    figure, (kept, halves, size) = subplots((12.0, 3.6), 1, 3)
    for choice, color in COLORS.items():
        for column, style in (("fine-tuned", "-o"), ("at once", ":o")):
            values = _by_seed(runs, choice, column)
            plot_deviations(kept, FRACTIONS, values, fmt=style, color=color, label=f"{choice}, {column}")
        sizes, losses = (
            [values for name in ("", choice) for values in _by_seed(runs, name, column)]  # all, then the fractions
            for column in ("kB of .omg", "dB as .omg")
        )
        plot_deviations(size, np.mean(sizes, axis=1), losses, color=color, label=choice)
    for half, color, style in (("flat half", GREY, "-o"), ("textured half", OCHRE, "-s")):
        pairs = zip(*(_by_seed(runs, choice, half) for choice in CHOICES), strict=True)
        gains = [np.subtract(distinct, plain) for plain, distinct in pairs]
        plot_deviations(halves, FRACTIONS, gains, fmt=style, color=color, label=f"{half} of the pixels")
    halves.axhline(0, color=GREY, linewidth=0.8)
    for axes in (kept, halves):
        axes.set(xscale="log", xlabel="kept of the Gaussians that dominate a pixel")
        set_ticks(axes, FRACTIONS, [f"{100 * fraction:g} %" for fraction in FRACTIONS])
    kept.set(ylabel="PSNR (dB)", title=result["scene"])
    halves.set(ylabel="PSNR gained by distinctiveness (dB)", title="where it helps and where it hurts")
    size.set(xlabel="kB of .omg", ylabel="PSNR when read again (dB)", title="bytes and quality")
    for axes in (kept, halves, size):
        axes.legend()
    return figure


def _by_seed(runs: list[list[dict[str, Any]]], choice: str, column: str) -> list[Sequence[float]]:
    """Return a measure of each row of a choice, in their order, for every seed."""
    value = COLUMNS[column][0]
    groups = [rows for rows in zip(*runs, strict=True) if rows[0]["choice"] == choice]
    return [[value(row) for row in rows] for rows in groups]
