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
from data_tools.claims.kit.figures import plot_curves, subplots
from data_tools.claims.kit.mesh_distances import OrientedPoints, compare_surfaces, sample_surface
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.app.runs.depth_maps import DepthKind
from minisplat_ref.app.runs.meshing import MeshOptions, Opened, mesh_run
from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.palette import SERIES
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
COLUMNS = (
    *((name, spread(name.lower(), 1, 1000)) for name in ("accuracy", "completeness", "Chamfer")),
    (f"F ({TAU:g})", spread("f_score", 3)),
    ("normals (degrees)", spread("normal_error", 1)),
)
CURVES = {"chamfer": "Chamfer distance (the scene's unit)", "f_score": f"F-score at {TAU:g}"}


def run(args: argparse.Namespace) -> kit.Report:
    """Train by every recipe with every seed, make meshes, and measure them."""
    made = make_scene(args.scene)
    truth = true_surface(made)
    recipes = {text: _recipe_of(text, args.iterations) for text in args.recipes}
    settings = {**kit.describe_scene(made.scene), **kit.settings_of(args, "iterations"), "tau": TAU}
    jobs = kit.jobs_of(seed=args.seeds, recipe=args.recipes)

    def measure(seed: int, recipe: str) -> Iterable[Mapping[str, Any]]:
        return measure_meshes(train_run(made, recipes[recipe], seed), truth)

    records = kit.resume(args.out, settings, jobs, measure)
    by_recipe = sorted(records, key=lambda record: args.recipes.index(record["recipe"]))
    text = f"{kit.title(settings)}; {kit.seeds_of(args)}; lengths in thousandths of the scene's unit\n\n"
    text += table(by_recipe, {"recipe": "recipe", "depth": "depth", "voxel": "voxel"}, COLUMNS)
    result = {**settings, "seeds": list(args.seeds), "records": records}
    arms = kit.arms_of(records, "recipe", ("chamfer", "f_score"))
    return kit.Report(result, draw(records, args.recipes), text, arms)


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
        mesh = mesh_run(opened, MeshOptions(Path("run"), kind, voxel)).mesh
        found = sample_surface(mesh.vertices, mesh.faces, N_POINTS, np.random.default_rng(0))
        distances = compare_surfaces(found, truth, TAU)
        records.append({"depth": kind.value, "voxel": voxel, **distances._asdict(), "chamfer": distances.chamfer})
    return records


def _has(opened: Opened, kind: DepthKind) -> bool:
    """Return whether the renderer of a run has a kind of depth; surfels have no dominant Gaussian."""
    try:
        opened.render_map(opened.views[0], kind)
    except InputError:
        return False
    return True


def draw(records: list[dict[str, Any]], recipes: tuple[str, ...]) -> Figure:
    """Draw Chamfer distance and F-score of median depths over the voxel."""
    figure, panels = subplots((9, 3.6), 1, 2)
    medians = [record for record in records if record["depth"] == DepthKind.MEDIAN.value]
    for axes, (measure, title) in zip(panels, CURVES.items(), strict=True):
        plot_curves(axes, medians, "voxel", measure, dict(zip(recipes, SERIES, strict=False)), key="recipe")
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
