"""Visibility culling of Mini-Splatting2: what it removes beyond the frustum, the time it saves, and its cost.

The paper is Mini-Splatting2, arXiv 2411.12788. The recipe is trained up to two points: before the simplification, where
there are many Gaussians, and before culling ends, where there are few. The photographs have their full size throughout.
At each point the visibility table is measured again, as the recipe's events do, and the training is continued twice
from the same state, with the table and without, one iteration of each alternately. Gaussians from a PLY are measured as
they are.
"""

import argparse
import copy
import time
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, PLY, SCENE, declare, downscale, iterations, number, seed
from data_tools.claims.kit.figures import subplots
from minisplat_ref.interface.palette import BLUE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.io import load_ply
from minisplat_ref.methods import get_recipe, mini_splatting, mini_splatting2
from minisplat_ref.metrics import psnr
from minisplat_ref.rendering import render
from minisplat_ref.strategy.importance import collect_importance
from minisplat_ref.strategy.ops import contiguous
from minisplat_ref.strategy.visibility import culled_fraction
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import Action, Recipe, firing_steps, without
from minisplat_ref.training.smaller_views import halve_large_views
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Bools, Gaussians, Scene

RECIPE = "mini-splatting2"
WARM_UP = 5  # iterations of either arm that are not timed


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure."""
    scene = kit.read_scene(args.scene, args.downscale, is_tested=False)
    recipe = without(get_recipe(RECIPE, args.iterations), halve_large_views)
    state = initial_state(scene, recipe, args.seed)
    if args.ply is None:
        places: dict[str, Action] = {
            "before simplification": mini_splatting.simplify,
            "before culling ends": mini_splatting2.stop_culling,
        }
        last_steps = {name: firing_steps(recipe, action)[0] - 1 for name, action in places.items()}
    else:
        last_steps = {args.ply.name: recipe.iterations}
        resume_from(state, load_ply(args.ply), recipe.iterations)
    rows = {}
    for name, step in last_steps.items():
        kit.train_with_progress(scene, recipe._replace(iterations=step), 0, state=state)
        rows[name] = measure(state, scene, recipe, args.repeats)
    found = {name: summarise(row) for name, row in rows.items()}
    settings = {**kit.settings_of(args, "iterations", "seed", "repeats"), "ply": args.ply and str(args.ply)}
    result = {**kit.describe_scene(scene), **settings, "places": found}
    counts = ("Gaussians", "in the frustum of a view", "culled of these", "of the pairs with tiles")
    costs = ("ms without", "ms with", "ratio", "PSNR without (dB)", "with (dB)")
    text = f"{RECIPE}, {args.iterations} iterations, seed {args.seed}, {args.repeats} timed"
    table = markdown_table(["", *counts, *costs], to_rows(found))
    views = [row["views"][name] for row in found.values() for name in ("gaussians", "tile_pairs")]
    arms = {arm: np.concatenate(views)[:, k] for k, arm in enumerate(("without culling", "with culling"))}
    return kit.Report(result, draw(rows), f"{kit.title(result)}\n{text}\n\n{table}", arms)


def resume_from(state: TrainState, gaussians: Gaussians, step: int) -> None:
    """Put other Gaussians in the state, with the learning rates of ``step``."""
    state.gaussians = contiguous(gaussians)
    state.adam = zero_moments(state.gaussians)
    state.step = step


def measure(state: TrainState, scene: Scene, recipe: Recipe, repeats: int) -> dict[str, NDArray[Any]]:
    """Return counts and PSNR of each training view, and seconds of each iteration, without and with the table.

    Parameters
    ----------
    state : TrainState
        Stays as it is.
    scene : Scene
    recipe : Recipe
        Recipe of the timed iterations; its events are left out.
    repeats : int
        Iterations of either kind.

    Returns
    -------
    measures : dict of ndarrays
        ``frustum_count`` [N], ``is_visible`` [N, V], those of :func:`compare_views`, ``seconds`` [repeats, 2].
    """
    stats = collect_importance(state.gaussians, scene.train_views)
    return {
        "frustum_count": stats.frustum_count,
        "is_visible": stats.is_visible,
        **compare_views(state.gaussians, scene, stats.is_visible),
        "seconds": time_both(state, scene, recipe, stats.is_visible, repeats),
    }


def compare_views(gaussians: Gaussians, scene: Scene, is_visible: Bools) -> dict[str, NDArray[Any]]:
    """Render every training view without and with culling.

    Returns
    -------
    measures : dict of ndarrays of shape (V, 2)
        ``gaussians`` that are drawn, ``tile_pairs`` (Gaussian, tile) that are sorted and blended, ``psnr`` in dB.
    """
    rows = []
    for v, view in enumerate(scene.train_views):
        for visible in (None, is_visible[:, v]):
            output, tape = render(gaussians, view.camera, background=scene.background, is_visible=visible)
            n_drawn = int(np.count_nonzero(tape.projection.radii[:, 0]))
            quality = psnr(np.clip(output.image, 0, 1), view.image / 255, view.mask)
            rows.append((n_drawn, len(tape.splats.bins.gaussian_ids), quality))
    columns = zip(*rows, strict=True)
    return {name: np.reshape(c, (-1, 2)) for name, c in zip(("gaussians", "tile_pairs", "psnr"), columns, strict=True)}


def time_both(state: TrainState, scene: Scene, recipe: Recipe, is_visible: Bools, repeats: int) -> NDArray[np.float64]:
    """Time training iterations alternately without and with the table: render, loss, gradients, Adam.

    Returns
    -------
    seconds : ndarray of shape (repeats, 2)
        Of one iteration; row by row the same view, first without.
    """
    arms = [copy.deepcopy(state), copy.deepcopy(state)]
    for arm in arms:
        arm.stats.pop("is_visible", None)
    arms[1].stats["is_visible"] = is_visible
    seconds = np.zeros((WARM_UP + repeats, 2))
    for i in kit.with_progress(range(len(seconds)), "timing"):
        for k in (0, 1) if i % 2 else (1, 0):  # each is first as often as second
            one_more = recipe._replace(iterations=arms[k].step + 1, events=())
            start = time.process_time()
            train(scene, one_more, seed=0, state=arms[k])
            seconds[i, k] = time.process_time() - start
    return seconds[WARM_UP:]


def summarise(measures: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the figures of the table, and those of every view."""
    medians = 1e3 * np.median(measures["seconds"], axis=0)  # [2] without, with
    tile_pairs, psnrs = measures["tile_pairs"].sum(axis=0), measures["psnr"].mean(axis=0)
    return {
        "n_gaussians": len(measures["is_visible"]),
        "drawn_per_view": float(measures["gaussians"][:, 0].mean()),
        "culled_fraction": culled_fraction(measures["is_visible"], measures["frustum_count"]),
        "culled_fraction_of_tile_pairs": float(1 - tile_pairs[1] / tile_pairs[0]),
        "ms_without": float(medians[0]),
        "ms_with": float(medians[1]),
        "ratio_of_medians": float(medians[0] / medians[1]),
        "train_psnr_without": float(psnrs[0]),
        "train_psnr_with": float(psnrs[1]),
        "views": {name: measures[name].tolist() for name in ("gaussians", "tile_pairs", "psnr")},
    }


def to_rows(result: dict[str, dict[str, Any]]) -> list[list[str]]:
    """Return the lines of the table."""
    return [
        [
            name,
            f"{row['n_gaussians']:,}",
            f"{row['drawn_per_view']:,.0f}",
            f"{row['culled_fraction']:.1%}",
            f"{row['culled_fraction_of_tile_pairs']:.1%}",
            f"{row['ms_without']:.1f}",
            f"{row['ms_with']:.1f}",
            f"{row['ratio_of_medians']:.2f}",
            f"{row['train_psnr_without']:.2f}",
            f"{row['train_psnr_with']:.2f}",
        ]
        for name, row in result.items()
    ]


def draw(places: dict[str, dict[str, NDArray[Any]]]) -> Figure:
    """Draw the culled part of each view, the times of all iterations, and the loss of PSNR in each view."""
    figure, (culled, times, cost) = subplots((11, 3), 1, 3)
    for (name, measures), color in zip(places.items(), (BLUE, RED), strict=False):
        views = np.arange(1, len(measures["psnr"]) + 1)
        culled.plot(
            views, 100 * (1 - measures["gaussians"][:, 1] / measures["gaussians"][:, 0]), ".", color=color, label=name
        )
        cost.plot(views, measures["psnr"][:, 1] - measures["psnr"][:, 0], ".", color=color, label=name)
        shares = np.linspace(0, 100, len(measures["seconds"]))
        for k, style in enumerate(("--", "-")):
            times.plot(1e3 * np.sort(measures["seconds"][:, k]), shares, style, color=color)
    culled.set(title="culled of what the frustum leaves", xlabel="training view", ylabel="%", ylim=(0, None))
    times.set(title="training iterations that take at most", xlabel="ms", ylabel="%", xlim=(0, None))
    cost.set(title="PSNR with culling less PSNR without", xlabel="training view", ylabel="dB")
    culled.legend()
    styles = [Line2D([], [], color="black", linestyle=style) for style in ("--", "-")]
    times.legend(styles, ["without", "with"], loc="center left")
    return figure


CLAIMS = (
    declare(
        "culling",
        "visibility culling: what it removes, and the time it saves",
        run,
        SCENE,
        OUT,
        downscale(),
        iterations(1800),
        PLY,
        seed("of the training"),
        number("--repeats", 100, "iterations to time, of either kind"),
        description="Train a scene with mini-splatting2, and measure what visibility culling does.",
    ),
)
