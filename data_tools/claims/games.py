"""Claim ``games/counts``: Gaussians on the faces of a mesh against free ones, as many, of a synthetic scene.

The paper is GaMeS, arXiv 2402.01459. The mesh is fused from the exact depths of the training views, or from those of a
model that was trained without it. A free arm starts from the Gaussians of the arm before it, and trains means,
rotations and scales as 3DGS does. How far centres lie from the surface, in the median, is measured to the points that
the views show: that much of a scene stays behind when its mesh is moved.
"""

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, argument, declare, iterations, seeds
from data_tools.claims.kit.figures import bars, group
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.games.model import GAMES, on_faces
from minisplat_ref.interface.palette import BLUE, GREY
from minisplat_ref.mechanisms.fusion.extraction import extract
from minisplat_ref.mechanisms.fusion.kernels import fuse
from minisplat_ref.mechanisms.fusion.volume import DepthMap, Grid, empty_volume
from minisplat_ref.mechanisms.meshes.mesh import Mesh
from minisplat_ref.metrics import evaluate
from minisplat_ref.reference.pinhole import unproject_depth
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Floats, Gaussians, Model, Scene, View

TRUNCATION = 0.5  # of the distances that are fused, world units
VOXEL = 0.1  # of the meshes, world units, metres of these scenes: faces are half as large
ARMS = (("exact mesh", 1), ("exact mesh", 3), ("fused mesh", 1))  # with the number of Gaussians on each face
AREA_MIN = 1e-4  # of a triangle that is kept, of half a voxel's face
OPACITY_MIN = 0.1  # of the Gaussians whose centres are measured
COLUMNS = (
    ("count", spread("n_gaussians", 0)),
    ("test PSNR (dB)", spread("psnr", 2)),
    ("centres off the surface (mm)", spread("distance", 1, 1000)),
)
BARS = {"psnr": "PSNR of test views (dB)", "distance": "Centres off the surface (the scene's unit)"}


def run(args: argparse.Namespace) -> kit.Report:
    """Train every arm with every seed, and measure."""
    made = make_scene(args.scene)
    surface = true_points(made)
    tree = cKDTree(surface)
    exact = fused_mesh(made.scene.train_views, list(made.train_depths), surface)
    records: list[dict[str, Any]] = []
    for seed in range(args.seeds):
        recipe = find_recipe("3dgs-accel", args.iterations)
        free = kit.train_with_progress(made.scene, recipe, seed).gaussians
        records.append({"arm": "free, densified", "seed": seed, **outcome(made, tree, free, recipe)})
        meshes = {"exact mesh": exact, "fused mesh": fused_mesh(made.scene.train_views, depths_of(free, made), surface)}
        for name, per_face in ARMS:
            for recipe in (find_recipe(GAMES.name, args.iterations), unbound(args.iterations)):
                state = start(made.scene, recipe, meshes[name], per_face, seed)
                trained = kit.train_with_progress(made.scene, recipe, seed, state=state).gaussians
                arm = f"{name}, {per_face} for each face, {'on it' if recipe.name == GAMES.name else 'free'}"
                records.append({"arm": arm, "seed": seed, **outcome(made, tree, trained, recipe)})
    description = {**kit.describe_scene(made.scene), **kit.settings_of(args, "iterations", "seeds"), "voxel": VOXEL}
    text = f"{kit.title(description)}; {len(exact.faces):,} faces in the exact mesh\n\n"
    text += table(records, {"arm": "Gaussians"}, COLUMNS)
    colors = [BLUE if arm.endswith("on it") else GREY for arm in group(records, "arm")]
    return kit.Report({**description, "records": records}, bars(records, BARS, (9, 3.2), colors), text)


def unbound(iterations: int) -> Recipe:
    """Return 3DGS without density control."""
    return find_recipe("3dgs-accel", iterations)._replace(events=())


def start(scene: Scene, recipe: Recipe, mesh: Mesh, per_face: int, seed: int) -> TrainState:
    """Return the state with Gaussians on a mesh: of the recipe of faces as they are, of any other as plain ones."""

    def populate(rng: np.random.Generator) -> Any:
        g = on_faces(mesh, scene, recipe.sh_degree, rng, per_face=per_face)
        return g if recipe.name == GAMES.name else Gaussians(*g[: len(Gaussians._fields)])

    return initial_state(scene, recipe, seed, populate)


def true_points(made: SyntheticScene) -> Floats:
    """Return the points [P, 3] of the surface that the pixels of the training views show."""
    shown = zip(made.train_depths, made.scene.train_views, strict=True)
    return np.concatenate([unproject_depth(depth, view.camera) for depth, view in shown])


def depths_of(gaussians: Gaussians, made: SyntheticScene) -> Sequence[Floats]:
    """Return the median depths [H, W] that Gaussians show to the training views."""
    settings, wants = RenderSettings(made.scene.background), frozenset({"median_depth"})
    outputs = (settings.render_view(Model(gaussians), view, wants)[0] for view in made.scene.train_views)
    return [output.median_depth for output in outputs if output.median_depth is not None]


def fused_mesh(views: Sequence[View], depths: Sequence[Floats], surface: Floats) -> Mesh:
    """Return the mesh of depth maps around points of the surface, without triangles of no area."""
    low, high = surface.min(axis=0) - TRUNCATION, surface.max(axis=0) + TRUNCATION
    n_x, n_y, n_z = (np.ceil((high - low) / VOXEL).astype(int) + 1).tolist()
    x, y, z = low.tolist()
    grid = Grid((x, y, z), VOXEL, (n_x, n_y, n_z))
    volume = empty_volume(grid)
    for view, depth in zip(views, depths, strict=True):
        fuse(volume, grid, view.camera, DepthMap(depth, np.zeros((*depth.shape, 3))), TRUNCATION)
    colored = extract(volume, grid, min_views=2)
    mesh = Mesh(colored.vertices.astype(np.float64), colored.faces)
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    doubled = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return mesh._replace(faces=mesh.faces[doubled > AREA_MIN * VOXEL**2])


def outcome(made: SyntheticScene, tree: cKDTree, trained: Any, recipe: Recipe) -> dict[str, Any]:
    """Return the PSNR on test views, the count, and how far centres lie from the surface, in the median."""
    settings = RenderSettings(made.scene.background, renderer=recipe.renderer)
    means = trained.means[trained.opacity_logits > np.log(OPACITY_MIN / (1 - OPACITY_MIN))]
    return {
        "n_gaussians": len(trained.means),
        "psnr": evaluate(trained, made.scene.test_views, settings).psnr,
        "distance": float(np.median(tree.query(means)[0])),
    }


CLAIMS = (
    declare(
        "counts",
        "Gaussians on the faces of the exact mesh against free ones, at equal counts",
        run,
        argument("scene", metavar="SCENE", help="a synthetic one, such as room"),
        *(OUT, iterations(2000), seeds(3)),
    ),
)
