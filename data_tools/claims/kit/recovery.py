"""Recovery from a known disturbance of exposures or poses: three trainings of a synthetic scene."""

import argparse
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.tables import Columns, table
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.interface.palette import BLUE, EDGE_COLOR, GREY, RED
from minisplat_ref.methods import get_recipe
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import Scene

RECIPE = "3dgs-accel"
ARMS = ("undisturbed", "disturbed", "calibrated")
COLORS = dict(zip(ARMS, (GREY, RED, BLUE), strict=True))


def scene_and_recipe(args: argparse.Namespace) -> tuple[Scene, Recipe]:
    """Return what the arguments ask for.

    Raises
    ------
    InputError
        There are too few views, or iterations.
    """
    scene = make_scene(args.scene, n_views=args.views, width=args.width, height=args.width * 3 // 4).scene
    if not scene.test_views:
        raise InputError(f"scene {scene.name} has no test views to compare by: give more --views")
    return scene, get_recipe(RECIPE, args.iterations)


def report(
    args: argparse.Namespace,
    scene: Scene,
    arms: dict[str, dict[str, Any]],
    columns: Columns,
    figure: Figure,
    **more: Any,
) -> kit.Report:
    """Return the report of the three trainings; ``more`` belongs to the result.

    Neither the disturbance nor its correction may have done nothing.
    """
    description = {**kit.describe_scene(scene), "recipe": RECIPE, **kit.settings_of(args, "iterations", "seed")}
    heading = f"{kit.title(description)}\n{RECIPE}, {args.iterations} iterations, seed {args.seed}"
    text = table([{"arm": arm, **row} for arm, row in arms.items()], {"arm": "training"}, columns)
    compared = {arm: row["psnr"] for arm, row in arms.items()}
    return kit.Report({**description, **more, "arms": arms}, figure, f"{heading}\n\n{text}", compared)


def draw_errors(axes: Axes, arms: dict[str, dict[str, Any]], measure: str) -> None:
    """Draw the error of each photograph, disturbed and calibrated."""
    before, after = (arms[arm][measure] for arm in ARMS[1:])
    views = np.arange(1, len(before) + 1)
    axes.vlines(views, after, before, color=EDGE_COLOR, linewidth=1)
    for arm in ARMS[1:]:
        axes.plot(views, arms[arm][measure], ".", color=COLORS[arm], label=arm)
    axes.set(xlabel="training view", ylim=(0, None))


def draw_quality(axes: Axes, arms: dict[str, dict[str, Any]]) -> None:
    """Draw the PSNR of held-out views of the three trainings."""
    psnrs = [row["psnr"] for row in arms.values()]
    axes.barh(list(arms), psnrs, color=[COLORS[arm] for arm in arms])
    axes.set(title="held-out views", xlabel="PSNR (dB)", xlim=(0.9 * min(psnrs), None))
    axes.invert_yaxis()
