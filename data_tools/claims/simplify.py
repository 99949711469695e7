"""Simplification at equal counts: sampling by importance against pruning by rank or mass, merging, and least change.

The paper is Mini-Splatting, arXiv 2403.14166. A dense population is trained once, or read from a PLY. Each choice
reduces it to the same numbers of Gaussians, and all are then fine-tuned for the same number of iterations, without any
event. A seed determines the samples and the order of views. Gaussians that dominate no pixel are no candidates,
whatever the choice. Pruning by mass keeps the same as rank and only determines the number by itself; so its number is
one of those that are measured, and both share one line. The choices weigh by importance (equation 12 of Mini-Splatting)
but for the last, which keeps those without which the images would change most (:mod:`minisplat_ref.strategy.removal`).

Chamfer distances are those of the centres that are kept, before fine-tuning: the mean distance to the nearest point of
a cloud, and the mean distance from the cloud's points to the nearest centre, added. The clouds are the dense
population's centres and, where a synthetic scene knows them, the points that the training views' pixels show.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from data_tools.claims import kit
from data_tools.claims.kit.claim import (
    OUT,
    PLY,
    SCENE,
    SEEDS,
    argument,
    declare,
    downscale,
    fine_tune,
    iterations,
    recipe,
)
from data_tools.claims.kit.figures import group, mean_and_deviation, plus_minus
from minisplat_ref.datasets.synthetic import SCENE_NAMES, make_scene
from minisplat_ref.datasets.synthetic.surface import chamfer, unproject_views
from minisplat_ref.interface.arguments import fraction, list_of
from minisplat_ref.interface.palette import BLUE, GREEN, GREY, OCHRE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.io import load_ply
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy import simplify
from minisplat_ref.strategy.importance import collect_importance, indoor
from minisplat_ref.strategy.ops import Edit, n_rows
from minisplat_ref.strategy.removal import collect_removal_costs
from minisplat_ref.types import Floats

CHANGE = "least change"
CHOICES = {
    "sampling": simplify.by_sampling,
    "rank, mass": simplify.by_rank,
    "merging": simplify.by_merging,
    CHANGE: simplify.by_rank,
}
COLORS = dict(zip(CHOICES, (BLUE, RED, OCHRE, GREEN), strict=True))
MASS = 0.99  # of both papers
FINE_TUNING = "3dgs"  # its learning rates, from the first to the last
SH_DEGREE = 3  # stored when fine-tuning begins from the centres


def run(args: argparse.Namespace) -> kit.Report:
    """Train, simplify in every way to every count with every seed, and measure."""
    scene = kit.read_scene(args.scene, args.downscale)
    recipe = get_recipe(args.recipe, args.iterations)
    dense = load_ply(args.ply) if args.ply else kit.train_with_progress(scene, recipe, args.seeds[0]).gaussians
    clouds = {"dense": dense.means, **true_surface(args.scene)}
    trees = {name: cKDTree(cloud) for name, cloud in clouds.items()}
    stats = collect_importance(dense, scene.train_views)
    importance = simplify.intersection_preserving(indoor(stats), stats.dominant_count)
    changes = collect_removal_costs(dense, scene.train_views, RenderSettings(scene.background)).changes
    weights = dict.fromkeys(CHOICES, importance) | {CHANGE: np.where(importance > 0, changes, 0)}
    counts = counts_to_keep(importance, args.fractions)
    tuning = kit.drop_events(get_recipe(FINE_TUNING, args.fine_tune))
    runs = []
    jobs = [(kept, choice, seed) for kept in counts for choice in CHOICES for seed in args.seeds]
    for kept, choice, seed in kit.with_progress(jobs, "fine-tunings"):
        rng = np.random.default_rng(seed)
        edit: Edit = CHOICES[choice](dense, weights[choice], counts[kept], rng)
        begun = simplify.reinitialise(edit.gaussians, SH_DEGREE) if args.restart else edit.gaussians
        row = {
            "kept": kept,
            "n_gaussians": n_rows(edit.gaussians),
            "choice": choice,
            "seed": seed,
            "psnr": evaluate(edit.gaussians, scene.test_views, RenderSettings(scene.background)).psnr,
            **{f"chamfer_{name}": chamfer(edit.gaussians.means, tree) for name, tree in trees.items()},
        }
        tuned = kit.fine_tune(begun, scene, tuning, rng)
        runs.append({**row, "psnr_tuned": evaluate(tuned, scene.test_views, RenderSettings(scene.background)).psnr})
    settings = {
        "recipe": None if args.ply else args.recipe,
        "iterations": None if args.ply else args.iterations,
        "ply": args.ply and str(args.ply),
        "fine_tune": args.fine_tune,
        "restart": args.restart,
        "seeds": list(args.seeds),
        "dense": {
            "n_gaussians": n_rows(dense),
            "n_candidates": int(np.count_nonzero(importance)),
            "psnr": evaluate(dense, scene.test_views, RenderSettings(scene.background)).psnr,
        },
    }
    result = {**kit.describe_scene(scene), **settings, "counts": counts, "summary": summarise(runs), "runs": runs}
    text = f"{kit.title(result)}\n{describe_dense(result)}\n\n{markdown_table(*to_table(result))}"
    return kit.Report(result, draw(result), text, kit.arms_of(runs, "choice", ("psnr", "psnr_tuned")))


def true_surface(source: str) -> dict[str, Floats]:
    """Return the points [P, 3] that the pixels of a synthetic scene's training views show; nothing for a folder."""
    if Path(source).exists() or source not in SCENE_NAMES:
        return {}
    synthetic = make_scene(source, supersampling=1, n_points=0)  # its depths do not depend on these two
    cameras = [view.camera for view in synthetic.scene.train_views]
    return {"surface": unproject_views(cameras, list(synthetic.train_depths))}


def counts_to_keep(importance: Floats, fractions: tuple[float, ...]) -> dict[str, int]:
    """Return the numbers to keep, ascending, by name: those of the fractions, and the one that has the mass."""
    n_candidates = np.count_nonzero(importance)
    counts = {f"{100 * fraction:g} %": max(1, round(fraction * n_candidates)) for fraction in fractions}
    counts[f"mass {MASS:g}"] = len(simplify.select_mass(importance, MASS))
    return dict(sorted(counts.items(), key=lambda item: item[1]))


def summarise(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return, for each number and choice, mean and standard deviation over the seeds of every measure."""
    measures = [name for name in runs[0] if name.startswith(("psnr", "chamfer"))]
    return [
        {
            "kept": kept,
            "n_gaussians": rows[0]["n_gaussians"],
            "choice": choice,
            **{name: mean_and_deviation([row[name] for row in rows]) for name in measures},
        }
        for (kept, choice), rows in group(runs, "kept", "choice").items()
    ]


def describe_dense(result: dict[str, Any]) -> str:
    """Return in one line what was simplified, and how it was fine-tuned."""
    dense = result["dense"]
    origin = result["ply"] or f"{result['recipe']}, {result['iterations']} iterations"
    return (
        f"{origin}: {dense['n_gaussians']:,} Gaussians, {dense['psnr']:.2f} dB, {dense['n_candidates']:,} candidates; "
        f"fine-tuned {result['fine_tune']} iterations{' from centres and colours' if result['restart'] else ''}; "
        f"seeds {', '.join(map(str, result['seeds']))}"
    )


def to_table(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return header and lines of the table."""
    headers = {
        "psnr": "PSNR at once (dB)",
        "psnr_tuned": f"after {result['fine_tune']} iterations (dB)",
        "chamfer_dense": "Chamfer to dense (world units)",
        "chamfer_surface": "to the surface",
    }
    measures = [name for name in headers if name in result["summary"][0]]
    lines = [
        [
            row["kept"],
            f"{row['n_gaussians']:,}",
            row["choice"],
            *(plus_minus(row[name], 2 if name.startswith("psnr") else 4) for name in measures),
        ]
        for row in result["summary"]
    ]
    return ["kept of the candidates", "Gaussians", "choice", *(headers[name] for name in measures)], lines


def draw(result: dict[str, Any]) -> Figure:
    """Draw each measure against the number of Gaussians; bars are the deviation over the seeds."""
    panels = {
        "psnr": ("right after simplification", "PSNR (dB)"),
        "psnr_tuned": (f"after {result['fine_tune']} more iterations", "PSNR (dB)"),
        "chamfer_dense": ("kept centres and dense centres", "Chamfer distance (world units)"),
        "chamfer_surface": ("kept centres and true surface", "Chamfer distance (world units)"),
    }
    panels = {name: labels for name, labels in panels.items() if name in result["summary"][0]}
    figure = Figure(figsize=(3.6 * len(panels), 3.2), layout="constrained")
    for axes, (name, (heading, label)) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        for choice, color in COLORS.items():
            rows = [row for row in result["summary"] if row["choice"] == choice]
            means, deviations = np.transpose([row[name] for row in rows])
            counts = [row["n_gaussians"] for row in rows]
            axes.errorbar(counts, means, yerr=deviations, color=color, marker="o", ms=4, capsize=3, label=choice)
        if name.startswith("psnr"):
            axes.axhline(result["dense"]["psnr"], color=GREY, linestyle="--", linewidth=1, label="dense")
        n_of_mass = result["counts"][f"mass {MASS:g}"]
        axes.axvline(n_of_mass, color=GREY, linestyle=":", linewidth=1)
        is_rising = name.startswith("psnr")
        axes.annotate(
            f"mass {MASS:g}",
            (n_of_mass, 0.03 if is_rising else 0.97),
            xycoords=("data", "axes fraction"),
            ha="right",
            va="bottom" if is_rising else "top",
            rotation=90,
            fontsize=8,
            color=GREY,
        )
        ticks = [n for kept, n in result["counts"].items() if kept.endswith("%")]
        axes.set(title=heading, ylabel=label, xlabel="Gaussians", xscale="log")
        axes.set_xticks(ticks, [f"{n:,}" for n in ticks])
        axes.minorticks_off()
        if name == "psnr":
            axes.legend(loc="upper left", bbox_to_anchor=(0, 0.92))
    return figure


CLAIMS = (
    declare(
        "simplify",
        "quality against count: sampling, rank and mass, merging",
        run,
        SCENE,
        OUT,
        downscale(),
        iterations(3000),
        recipe("mini-splatting-d", "of the dense population"),
        PLY,
        argument(
            "--fractions",
            type=list_of(fraction),
            default=(0.05, 0.1, 0.2, 0.4),
            metavar="F,G",
            help="of the candidates to keep (default 0.05,0.1,0.2,0.4)",
        ),
        fine_tune(500),
        argument(
            "--restart", action="store_true", help="fine-tune from centres and colours alone, as mini-splatting does"
        ),
        SEEDS,
        description="Simplify a dense population in several ways to equal numbers, and fine-tune what is left.",
    ),
)
