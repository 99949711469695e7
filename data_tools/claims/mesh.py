"""Claim ``mesh``: meshes of synthetic scenes against the exact surface, over recipes, depths and sizes of voxels.

The claim is ours. The truth are the points that the ray tracer finds in the pixels of all views, so that what no view
shows does not count. Distances are those of :mod:`data_tools.claims.kit.mesh_distances`, with a tau of ``TAU``. Each
scene has the size of its default, and the same cameras are trained on and fused.
"""

import argparse
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import NAMES, RESUMED_OUT, SEEDS, SYNTHETIC_SCENE, argument, declare, iterations
from data_tools.claims.kit.figures import plot_deviations, with_deviation
from data_tools.claims.kit.mesh_distances import OrientedPoints, compare_surfaces, sample_surface
from minisplat_ref.app.runs.depth_maps import DepthKind
from minisplat_ref.app.runs.meshing import Asked, Opened, mesh_run
from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.palette import SERIES
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.io.viewpoints import scene_viewpoints
from minisplat_ref.methods import get_recipe
from minisplat_ref.reference.pinhole import unproject_depth
from minisplat_ref.training.recipe_settings import configure_by_name, match_calibrations
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import FILE_FRAME

TAU = 0.05  # world units, metres of these scenes
VOXELS = (0.02, 0.04, 0.08)
DEPTH_VOXEL = 0.04  # at which the kinds of depth are compared
N_POINTS = 100_000  # drawn on the mesh, and of the truth
_SHARES = {"f_score": 3, "normal_error": 1}  # columns of the table that are no lengths, with their digits


def run(args: argparse.Namespace) -> kit.Report:
    """Train by every recipe with every seed, make meshes, and measure them."""
    made = make_scene(args.scene)
    truth = true_surface(made)
    recipes = {text: _recipe_of(text, args.iterations) for text in args.recipes}
    settings = {**kit.describe_scene(made.scene), **kit.settings_of(args, "iterations"), "tau": TAU}
    jobs = [{"recipe": name, "seed": seed} for seed in args.seeds for name in args.recipes]

    def measure(recipe: str, seed: int) -> Iterable[Mapping[str, Any]]:
        return measure_meshes(train_run(made, recipes[recipe], seed), truth)

    records = kit.resume(args.out, settings, jobs, measure)
    heading = ["recipe", "depth", "voxel", "accuracy", "completeness", "Chamfer", f"F ({TAU:g})", "normals (degrees)"]
    rows = to_rows(records, args.recipes)
    text = f"{kit.title(settings)}; {kit.seeds_of(args)}; lengths in thousandths of the scene's unit"
    result = {**settings, "seeds": list(args.seeds), "records": records}
    arms = kit.arms_of(records, "recipe", ("chamfer", "f_score"))
    return kit.Report(result, draw(records, args.recipes), f"{text}\n\n{markdown_table(heading, rows)}", arms)


def _recipe_of(text: str, iterations: int) -> Recipe:
    """Return a recipe by its name, with settings if there are; one that decides on its length has its own."""

    def find(name: str) -> Recipe:
        recipe = find_recipe(name, iterations)
        return recipe if recipe.cooling is None else get_recipe(name)

    return configure_by_name(find, text)


def true_surface(made: SyntheticScene) -> OrientedPoints:
    """Return points of the surfaces that the views show."""
    views = (*made.scene.train_views, *made.scene.test_views)
    depths = np.concatenate([made.train_depths, made.test_depths])
    normals = np.concatenate([made.train_normals, made.test_normals])
    points, directions = [], []
    for view, depth, normal in zip(views, depths, normals, strict=True):
        points.append(unproject_depth(depth, view.camera))
        directions.append(normal[depth != 0])
    every, rng = np.concatenate(points), np.random.default_rng(0)
    chosen = rng.choice(len(every), min(N_POINTS, len(every)), replace=False)
    return OrientedPoints(every[chosen], np.concatenate(directions)[chosen])


def train_run(made: SyntheticScene, recipe: Recipe, seed: int) -> Opened:
    """Train, and return what ``mesh`` reads of the folder of a run."""
    state = kit.train_with_progress(made.scene, recipe, seed)
    renderer = match_calibrations(recipe, state.model).renderer
    trained = Trained(state.model, renderer, made.scene.background, GSPLAT_MAIN.name, "cpu")
    views = [view for view in scene_viewpoints(made.scene) if view.split != "test"]
    return Opened(trained, views, FILE_FRAME)


def measure_meshes(opened: Opened, truth: OrientedPoints) -> list[dict[str, Any]]:
    """Return the distances of meshes by every voxel and, at one, by every depth."""
    settings = [(DepthKind.MEDIAN, voxel) for voxel in VOXELS]
    settings += [(kind, DEPTH_VOXEL) for kind in DepthKind if kind is not DepthKind.MEDIAN and _has(opened, kind)]
    records = []
    for kind, voxel in kit.with_progress(settings, "meshes"):
        mesh = mesh_run(opened, Asked(Path("run"), kind, voxel)).mesh
        found = sample_surface(mesh.vertices, mesh.faces, N_POINTS, np.random.default_rng(0))
        distances = compare_surfaces(found, truth, TAU)
        records.append({"depth": kind.value, "voxel": voxel, **distances._asdict(), "chamfer": distances.chamfer})
    return records


def _has(opened: Opened, kind: DepthKind) -> bool:
    """Return whether the renderer of a run has a kind of depth; surfels have no dominant Gaussian."""
    try:
        opened.map_of(opened.views[0], kind)
    except InputError:
        return False
    return True


def to_rows(records: list[dict[str, Any]], recipes: tuple[str, ...]) -> list[list[str]]:
    """Return the lines of the table: means and deviations over the seeds."""
    rows = []
    for recipe in recipes:
        own = [record for record in records if record["recipe"] == recipe]
        for depth, voxel in dict.fromkeys((record["depth"], record["voxel"]) for record in own):
            of_seeds = [record for record in own if (record["depth"], record["voxel"]) == (depth, voxel)]
            lengths = [
                with_deviation([1000 * record[key] for record in of_seeds], 1)
                for key in ("accuracy", "completeness", "chamfer")
            ]
            shares = [with_deviation([record[key] for record in of_seeds], d) for key, d in _SHARES.items()]
            rows.append([recipe, depth, f"{voxel:g}", *lengths, *shares])
    return rows


def draw(records: list[dict[str, Any]], recipes: tuple[str, ...]) -> Figure:
    """Draw Chamfer distance and F-score of median depths over the voxel."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for axes, key, title in zip(
        figure.subplots(1, 2),
        ("chamfer", "f_score"),
        ("Chamfer distance (the scene's unit)", f"F-score at {TAU:g}"),
        strict=True,
    ):
        for recipe, color in zip(recipes, SERIES, strict=False):
            own = [r for r in records if (r["recipe"], r["depth"]) == (recipe, DepthKind.MEDIAN.value)]
            by_voxel = [[r[key] for r in own if r["voxel"] == voxel] for voxel in VOXELS]
            plot_deviations(axes, VOXELS, by_voxel, color=color, label=recipe)
        axes.set(title=title, xlabel="voxel (the scene's unit)")
    axes.legend()
    return figure


CLAIMS = (
    declare(
        "mesh",
        "meshes of runs against the exact surface of a synthetic scene",
        run,
        SYNTHETIC_SCENE,
        RESUMED_OUT,
        argument(
            "--recipes",
            type=NAMES,
            default=("3dgs-accel", "mini-splatting2", "adaptive", "surfels"),
            metavar="R,Q",
            help="names as in train --recipe; R+NAME=VALUE changes a setting (default"
            " 3dgs-accel,mini-splatting2,adaptive,surfels)",
        ),
        iterations(2000),
        SEEDS,
    ),
)
