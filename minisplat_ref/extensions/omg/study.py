"""The study ``omg/distinctiveness``: which Gaussians of a scene to keep, and what they cost as a file.

The Gaussians come from a training with Mini-Splatting2 or from a PLY. Of those that dominate a pixel, equally many are
kept by importance alone and by importance times distinctiveness squared; both selections are fine-tuned for the same
number of iterations, without any event. Then each is written as ``.omg`` and read again. For the whole population, each
field by itself is taken from such a file at every level, which shows where the quality is lost.

Distinctiveness hurts flat regions, because these consist of Gaussians whose neighbours have the same colour. So the
study splits the pixels of each test photograph by their gradient into the flatter half and the rest.
"""

import argparse
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from minisplat_ref.extensions import shared_studies
from minisplat_ref.extensions import shared_trainings as shared
from minisplat_ref.extensions.omg.file import OMG_FILE, order_of
from minisplat_ref.extensions.omg.method import POWER
from minisplat_ref.extensions.omg.reference import distinct_importance, local_distinctiveness
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.studies.study import Study
from minisplat_ref.types import Bools, Floats, Gaussians, Scene, View

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRACTIONS = (0.5, 0.25, 0.125)
FINE_TUNING = "3dgs"  # the recipe whose learning rates are used, from the first to the last
CHOICES = {"importance": 0.0, "with distinctiveness": POWER}
"""The selections, with the power of distinctiveness in their score."""
COLORS = dict(zip(CHOICES, (shared.BLUE, shared.RED), strict=True))


class Quality(NamedTuple):
    """Agreement with the test views, dB."""

    psnr: float
    flat: float
    """Over the flatter half of the pixels of each view."""
    textured: float
    """Over the other half."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the study."""
    shared.add_scene_arguments(parser, iterations=1000, recipe="mini-splatting2")
    parser.add_argument(
        "--fine-tune", type=int, default=200, metavar="M", help="iterations of fine-tuning (default 200)"
    )


def run(args: argparse.Namespace) -> None:
    """Train, prune, fine-tune, measure, write the results, and print the tables.

    Raises
    ------
    InputError
        The scene, the recipe, the PLY or the output folder cannot be used.
    """
    from minisplat_ref.errors import InputError
    from minisplat_ref.reporting import markdown_table

    if args.fine_tune < 1:
        raise InputError(f"--fine-tune is {args.fine_tune}: give at least 1")
    scene = shared.read_scene(args)
    with making_folder(args.out) as folder:
        wholes = shared.populations(args, scene)
        runs = [measured(whole, scene, args.fine_tune, seed) for seed, whole in enumerate(wholes)]
        losses = [losses_of_fields(whole, scene) for whole in wholes]
        result = {**shared.describe(args, scene), "fine_tune": args.fine_tune, "power": POWER, "runs": runs}
        result["losses"] = {field: [of_seed[field] for of_seed in losses] for field in losses[0]}
        shared_studies.write(folder, result, draw(result))
    print(f"{scene.name}; fine-tuned {args.fine_tune} iterations\n")
    heading = [
        "kept",
        "by",
        "Gaussians",
        "at once",
        "fine-tuned",
        "flat half",
        "textured half",
        "kB of .omg",
        "dB as .omg",
    ]
    print(markdown_table(heading, to_rows(runs)))
    print("\ndB lost by one field from the file, at each level\n")
    rows = [
        [field, *(shared.with_deviation(list(of_seeds), 2) for of_seeds in zip(*of_levels, strict=True))]
        for field, of_levels in result["losses"].items()
    ]
    print(markdown_table(["field", *map(str, range(len(OMG_FILE.levels)))], rows))


def measured(whole: Gaussians, scene: Scene, iterations: int, seed: int) -> list[dict[str, Any]]:
    """Return the measurements of the whole population, and of each fraction and choice."""
    from tqdm import tqdm

    from minisplat_ref.strategy.importance import collect_importance, indoor
    from minisplat_ref.strategy.ops import take
    from minisplat_ref.strategy.simplify import intersection_preserving, most_important

    stats = collect_importance(whole, scene.train_views)
    importance = intersection_preserving(indoor(stats), stats.dominant_count)  # [N]
    distinctiveness = local_distinctiveness(whole.means, whole.sh_dc)
    tuned = fine_tuned(whole, scene, iterations, seed)
    rows = [_row("all", "", quality(whole, scene), tuned, scene)]
    jobs = [(fraction, choice) for fraction in FRACTIONS for choice in CHOICES]
    for fraction, choice in tqdm(jobs, desc=f"fine-tunings, seed {seed}", leave=False, disable=None):
        score = distinct_importance(importance, distinctiveness, CHOICES[choice])
        n = max(1, round(fraction * np.count_nonzero(importance)))
        kept = take(whole, most_important(score, min(n, np.count_nonzero(score))))
        at_once = quality(kept, scene)
        rows.append(_row(f"{100 * fraction:g} %", choice, at_once, fine_tuned(kept, scene, iterations, seed), scene))
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
    from minisplat_ref.strategy.ops import take

    whole = take(gaussians, order_of(gaussians))
    before = quality(whole, scene).psnr
    losses: dict[str, list[float]] = {field: [] for field in Gaussians._fields}
    for level in range(len(OMG_FILE.levels)):
        back = OMG_FILE.decode(OMG_FILE.encode(gaussians, level), OMG_FILE.suffix)
        for field, of_levels in losses.items():
            of_levels.append(before - quality(whole._replace(**{field: getattr(back, field)}), scene).psnr)
    return losses


def fine_tuned(gaussians: Gaussians, scene: Scene, iterations: int, seed: int) -> Gaussians:
    """Return the Gaussians after fine-tuning with all stored harmonics and without events; the input is not changed."""
    from minisplat_ref.methods import get_recipe
    from minisplat_ref.training.adam import zero_moments
    from minisplat_ref.training.loop import train
    from minisplat_ref.training.state import TrainState

    recipe = get_recipe(FINE_TUNING, iterations)
    recipe = recipe._replace(events=(), sh_milestones=(0,) * recipe.sh_degree)
    copy = Gaussians(*(field.copy() for field in gaussians))
    rng = np.random.default_rng(seed)
    state = TrainState(copy, zero_moments(copy), step=0, view_order=[], rng=rng, stats={})
    trained: Gaussians = train(scene, recipe, seed=seed, state=state).gaussians
    return trained


def quality(gaussians: Gaussians, scene: Scene) -> Quality:
    """Return the mean PSNR over the test views of all pixels, of the flatter half of each view, and of the rest."""
    from minisplat_ref.metrics import ViewMetrics, evaluate, psnr

    found = []

    def on_view(view: View, image: Floats, metrics: ViewMetrics) -> None:
        pixels = view.load().image
        is_flat = flatter_half(pixels)
        clipped = np.clip(image, 0, 1)
        found.append((metrics.psnr, psnr(clipped, pixels, is_flat), psnr(clipped, pixels, ~is_flat)))

    evaluate(gaussians, scene.test_views, RenderSettings(scene.background), on_view=on_view)
    return Quality(*np.mean(found, axis=0).tolist())


def flatter_half(pixels: Any) -> Bools:
    """Return [H, W], True for the half of the pixels with the smaller gradient of the mean of the channels."""
    dy, dx = np.gradient(np.asarray(pixels, np.float64).mean(axis=2))
    ascending = np.argsort(np.hypot(dx, dy), axis=None, kind="stable")
    is_flat = np.zeros(dx.shape, bool)
    is_flat.flat[ascending[: dx.size // 2]] = True
    return is_flat


def to_rows(runs: list[list[dict[str, Any]]]) -> list[list[str]]:
    """Return the lines of the table: means and deviations over the seeds."""
    lines = []
    for rows in zip(*runs, strict=True):
        columns: list[tuple[Callable[[dict[str, Any]], float], int]] = [
            (lambda row: row["at_once"]["psnr"], 2),
            (lambda row: row["tuned"]["psnr"], 2),
            (lambda row: row["tuned"]["flat"], 2),
            (lambda row: row["tuned"]["textured"], 2),
            (lambda row: row["n_bytes"] / 1e3, 1),
            (lambda row: row["packed"]["psnr"], 2),
        ]
        cells = [shared.with_deviation([value(row) for row in rows], digits) for value, digits in columns]
        n = np.mean([row["n_gaussians"] for row in rows])
        lines.append([rows[0]["kept"], rows[0]["choice"], f"{n:,.0f}", *cells])
    return lines


def draw(result: dict[str, Any]) -> "Figure":
    """Draw PSNR against the fraction kept, the gain of distinctiveness in either half, and PSNR against bytes."""
    from matplotlib.figure import Figure

    runs = result["runs"]
    figure = Figure(figsize=(12.0, 3.6), layout="constrained")
    kept, halves, size = figure.subplots(1, 3)
    for choice, color in COLORS.items():
        for key, style, label in (("tuned", "-o", f"{choice}, fine-tuned"), ("at_once", ":o", f"{choice}, at once")):
            means, deviations = _over_seeds(runs, choice, partial(_psnr, key))
            kept.errorbar(FRACTIONS, means, yerr=deviations, fmt=style, color=color, ms=4, capsize=3, label=label)
        sizes = [_over_seeds(runs, name, lambda row: row["n_bytes"] / 1e3)[0] for name in ("", choice)]
        losses = [_over_seeds(runs, name, partial(_psnr, "packed")) for name in ("", choice)]
        means, deviations = (np.concatenate([losses[0][i], losses[1][i]]) for i in (0, 1))
        size.errorbar(
            np.concatenate(sizes), means, yerr=deviations, fmt="-o", color=color, ms=4, capsize=3, label=choice
        )
    for half, color, style in (("flat", shared.GREY, "-o"), ("textured", shared.YELLOW, "-s")):
        means, deviations = _gain(runs, half)
        label = f"{half} half of the pixels"
        halves.errorbar(FRACTIONS, means, yerr=deviations, fmt=style, color=color, ms=4, capsize=3, label=label)
    halves.axhline(0, color=shared.GREY, linewidth=0.8)
    for axes in (kept, halves):
        axes.set(xscale="log", xlabel="kept of the Gaussians that dominate a pixel")
        axes.set_xticks(FRACTIONS, [f"{100 * fraction:g} %" for fraction in FRACTIONS])
        axes.minorticks_off()
    kept.set(ylabel="PSNR (dB)", title=result["scene"])
    halves.set(ylabel="PSNR gained by distinctiveness (dB)", title="where it helps and where it hurts")
    size.set(xlabel="kB of .omg", ylabel="PSNR when read again (dB)", title="bytes and quality", ylim=None)
    for axes in (kept, halves, size):
        shared_studies.tidy(axes)
        axes.legend(frameon=False, fontsize=8)
    return figure


def _psnr(key: str, row: dict[str, Any]) -> float:
    psnr: float = row[key]["psnr"]
    return psnr


def _over_seeds(
    runs: list[list[dict[str, Any]]], choice: str, value: Callable[[dict[str, Any]], float]
) -> tuple[Floats, Floats]:
    """Return means and deviations of the rows of a choice, in their order."""
    groups = [rows for rows in zip(*runs, strict=True) if rows[0]["choice"] == choice]
    pairs = [shared.mean_and_deviation([value(row) for row in rows]) for rows in groups]
    means, deviations = np.transpose(pairs)
    return means, deviations


def _gain(runs: list[list[dict[str, Any]]], half: str) -> tuple[Floats, Floats]:
    """Return the gain of distinctiveness in a half of the pixels after fine-tuning: mean and deviation by fraction."""
    plain, distinct = CHOICES
    gains = [
        [b["tuned"][half] - a["tuned"][half] for a, b in zip(_of(rows, plain), _of(rows, distinct), strict=True)]
        for rows in runs
    ]
    means, deviations = np.transpose(
        [shared.mean_and_deviation(of_fraction) for of_fraction in zip(*gains, strict=True)]
    )
    return means, deviations


def _of(rows: list[dict[str, Any]], choice: str) -> list[dict[str, Any]]:
    return [row for row in rows if row["choice"] == choice]


DISTINCTIVENESS = Study("distinctiveness", "which 50, 25 and 12.5 % of the Gaussians to keep", add_arguments, run)
"""The study ``omg/distinctiveness``."""
