"""Arguments, trainings and means that studies share which train a scene once per seed."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions import shared_studies
from minisplat_ref.types import Gaussians, Scene

BLUE, RED, YELLOW, GREY = "#35608c", "#d2493f", "#e0a526", "#8a8580"


def add_scene_arguments(parser: argparse.ArgumentParser, iterations: int, recipe: str) -> None:
    """Add the scene, the options of its trainings, and ``--out``."""
    parser.add_argument("scene", metavar="SCENE", help="folder of a scene, or a synthetic one such as room")
    shared_studies.add_out(parser)
    parser.add_argument("--downscale", type=int, default=1, metavar="D", help="make photographs D times smaller")
    parser.add_argument("--recipe", default=recipe, metavar="R", help="recipe of the trainings (default %(default)s)")
    parser.add_argument(
        "--iterations", type=int, default=iterations, metavar="N", help="per training (default %(default)s)"
    )
    parser.add_argument("--ply", type=Path, metavar="FILE", help="take these Gaussians instead of training")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="number of seeds, from 0 on (default 3)")


def read_scene(args: argparse.Namespace) -> Scene:
    """Load a scene from a folder, or make the synthetic one of that name.

    Raises
    ------
    InputError
        The scene is neither, it has no test views, or a number is out of range.
    """
    for name in ("downscale", "iterations", "seeds"):
        if getattr(args, name) < 1:
            raise InputError(f"--{name} is {getattr(args, name)}: give at least 1")
    return shared_studies.read_scene(args.scene, args.downscale)


def populations(args: argparse.Namespace, scene: Scene) -> list[Gaussians]:
    """Return the given Gaussians, or those of one training per seed.

    Raises
    ------
    InputError
        There is no such recipe, or the PLY cannot be read.
    """
    from tqdm import tqdm

    from minisplat_ref.io import load_ply
    from minisplat_ref.methods import get_recipe
    from minisplat_ref.training.loop import train

    if args.ply is not None:
        return [load_ply(args.ply)]
    recipe = get_recipe(args.recipe, args.iterations)
    trained = []
    for seed in range(args.seeds):
        with tqdm(total=recipe.iterations, desc=f"{recipe.name}, seed {seed}", leave=False, disable=None) as bar:
            trained.append(train(scene, recipe, seed=seed, on_step=lambda _: bar.update()).gaussians)
    return trained


def describe(args: argparse.Namespace, scene: Scene) -> dict[str, Any]:
    """Return the scene and the settings on which the results depend."""
    from minisplat_ref.reporting import describe_machine

    camera = scene.train_views[0].camera
    origin = {"ply": str(args.ply)} if args.ply else {"recipe": args.recipe, "iterations": args.iterations}
    return {
        "scene": scene.name,
        "size": [camera.width, camera.height],
        "test_views": len(scene.test_views),
        **origin,
        "seeds": 1 if args.ply else args.seeds,
        "machine": describe_machine(),
    }


def mean_and_deviation(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and sample standard deviation; the latter is 0 for one value."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def with_deviation(values: Sequence[float], digits: int) -> str:
    """Return mean and deviation as text for a table; of a single value, the value alone."""
    mean, deviation = mean_and_deviation(values)
    return f"{mean:.{digits}f} ± {deviation:.{digits}f}" if len(values) > 1 else f"{mean:.{digits}f}"
