"""Claim ``vdgs/floats`` (arXiv 2312.13729): PSNR at held-out views with as many floats, those of the network included.

Harmonics alone train a Gaussian for each of N points of the scene, drawn at random. Each mode trains as many fewer as
have the floats of its network and hash grid. One arm is without the hash grid, which is most of these floats: a network
of the direction alone multiplies the opacities; that of an earlier commit of the released code reads the Gaussian's
opacity besides. Numbers stay, and all of the schedule else is that of the recipe.
"""

import argparse
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from data_tools.claims import kit
from data_tools.claims.kit.figures import group, plot_deviations, subplots
from data_tools.claims.kit.tables import first, spread, table
from data_tools.claims.vdgs.pane import floats_of
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.vdgs.model import (
    NAME,
    TABLE,
    VDGS,
    VIEW_DEPENDENT,
    colors_plus,
    colors_times,
    initial_shared,
    opacity_plus,
    opacity_times,
)
from minisplat_ref.interface.palette import BLUE
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import Recipe, scale_recipe
from minisplat_ref.types import Floats, Scene

HARMONICS = "harmonics"
NO_GRID = "opacity_times, direction alone"
MODES = (opacity_times, opacity_plus, colors_times, colors_plus)
FLOATS = 59  # of a Gaussian with harmonics of degree 3


def arms(iterations: int) -> dict[str, Recipe]:
    """Return the recipes by arm; none changes the number of Gaussians."""
    ours = VDGS._replace(representation=VIEW_DEPENDENT)
    recipes = {HARMONICS: GS_ACCEL} | {mode.__name__: configure(ours, modulation=mode) for mode in MODES}
    recipes[NO_GRID] = VDGS._replace(representation=VIEW_DEPENDENT._replace(shared=direction_alone))
    return {name: scale_recipe(recipe, iterations)._replace(events=()) for name, recipe in recipes.items()}


def direction_alone(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return the shared parameters with a hash grid of one number, which all places read: one more bias."""
    shared = initial_shared(scene, rng, modulation=opacity_times)
    first = f"{NAME}_weights_0"
    table = np.zeros((1, 1, 1), shared[TABLE].dtype)
    return {**shared, TABLE: table, first: shared[first][: 3 + table.size]}


def n_shared(scene: Scene, recipe: Recipe) -> int:
    """Return the floats of a recipe's shared parameters."""
    shared = recipe.representation.shared(scene, np.random.default_rng(0))
    return sum(array.size for array in shared.values())


def measure(scene: Scene, iterations: int, n: int, arm: str, seed: int) -> dict[str, Any]:
    """Train an arm with the floats of n Gaussians, and return its record."""
    recipe = arms(iterations)[arm]
    kept = n - -(-n_shared(scene, recipe) // FLOATS)
    if kept < 1:
        raise InputError(
            f"a network has more floats than {n} Gaussians: give more --gaussians, or a scene of more points"
        )
    rows = np.random.default_rng(seed).permutation(len(scene.points))[:kept]  # the fewer are among the more
    part = scene._replace(points=scene.points[rows], point_colors=scene.point_colors[rows])
    state = kit.train_with_progress(part, recipe, seed)
    settings = RenderSettings(scene.background, renderer=recipe.renderer)
    psnr = evaluate(state.model, scene.test_views, settings).psnr
    return {"psnr": psnr, "gaussians": len(state.gaussians.means), "floats": floats_of(state.model)}


def run(args: argparse.Namespace) -> kit.Report:
    """Train all arms with every seed."""
    scene = kit.read_scene(args.scene, args.downscale)
    n = min(args.gaussians, len(scene.points))
    settings = {**kit.describe_scene(scene), "iterations": args.iterations, "gaussians": n}
    jobs = kit.jobs_of(arm=arms(args.iterations), seed=range(args.seeds))
    records = kit.resume(args.out, settings, jobs, partial(measure, scene, args.iterations, n))
    plain = {record["seed"]: record["psnr"] for record in records if record["arm"] == HARMONICS}
    columns = (
        ("Gaussians", first("gaussians", ",")),
        ("floats", first("floats", ",")),
        ("PSNR dB", spread("psnr", 2)),
        ("gain, seed by seed", spread(lambda record: record["psnr"] - plain[record["seed"]], 2)),
    )
    figure, axes = subplots((6, 3.4))
    psnrs = {arm: [record["psnr"] for record in own] for arm, own in group(records, "arm").items()}
    plot_deviations(axes, list(psnrs), list(psnrs.values()), color=BLUE, fmt="o")
    axes.set(title=f"PSNR (dB) with {FLOATS * n:,} floats")
    text = f"{kit.title(settings)}\n\n{table(records, {'arm': 'arm'}, columns)}"
    result = {**settings, "seeds": args.seeds, "records": records}
    return kit.Report(result, figure, text, kit.arms_of(records, "arm", ("psnr",)))
