"""Claim ``mixed/scene`` (MP-GS, arXiv 2507.11321) compares populations of as many floats on scenes.

Points of a scene become ellipses, lines and triangles by groups. 3DGS gets as many floats, by leaving points out at
random; and, for comparison, all of the points, and one Gaussian for each group, which tells what vertices are worth
apart from the choice of points. Nothing is densified or pruned, so that numbers stay; kinds change as the recipe has
it. The loss is that of 3DGS for all.
"""

import argparse
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import group, plot_curves, subplots
from data_tools.claims.kit.tables import first, spread, table
from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import SCENE_NAMES
from minisplat_ref.extensions.mixed.model import MIXED as RECIPE
from minisplat_ref.extensions.mixed.model import MIXED_GAUSSIANS, promote, simplify_hulls
from minisplat_ref.extensions.mixed.population import MixedGaussians, counts
from minisplat_ref.interface.palette import BLUE, GREY, OCHRE, RED
from minisplat_ref.interface.reporting import describe_machine
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.initialization import initial_gaussians
from minisplat_ref.training.schedule import Recipe, action_name, scale_recipe
from minisplat_ref.types import Scene

ALL, PLAIN, GROUPS, MIXED = "3DGS, all points", "3DGS, as many floats", "3DGS, one for each group", "mixed"
COLORS = {ALL: OCHRE, PLAIN: GREY, GROUPS: BLUE, MIXED: RED}
COLUMNS = (
    ("number", first("number", ",")),
    ("floats", first("n_floats", ",")),
    ("ellipses, lines, triangles", first(lambda row: ", ".join(f"{number:,}" for number in row["kinds"]))),
    ("test PSNR", spread("psnr", 2)),
    ("test SSIM", spread("ssim", 4)),
)


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure."""
    scenes = [kit.read_scene(s, 1 if s in SCENE_NAMES else args.downscale) for s in args.scenes]
    rows = [row for scene in scenes for row in outcomes(scene, args.iterations, args.seeds)]
    result = {**kit.settings_of(args, "iterations", "seeds", "downscale"), "rows": rows, "machine": describe_machine()}
    arms = kit.arms_of(rows, "primitives", ("psnr", "ssim"))
    text = table(rows, {"scene": "scene", "primitives": "primitives"}, COLUMNS)
    return kit.Report(result, draw(rows), text, arms)


def outcomes(scene: Scene, iterations: int, n_seeds: int) -> list[dict[str, Any]]:
    """Return a row for each population of a scene."""
    names = {promote.__name__, simplify_hulls.__name__}
    mixed = RECIPE._replace(
        losses=GS_ACCEL.losses,
        representation=MIXED_GAUSSIANS,
        events=tuple(event for event in RECIPE.events if action_name(event) in names),
    )
    plain = GS_ACCEL._replace(events=())
    whole = initial_gaussians(scene, plain.sh_degree, np.random.default_rng(0))
    groups = MIXED_GAUSSIANS.extend(whole, np.random.default_rng(0))
    n_equal = len(groups.means) * kit.count_floats(groups) // kit.count_floats(whole)
    order = np.random.default_rng(0).permutation(len(scene.points))
    fewer = np.sort(order[: min(n_equal, len(order))])
    part = scene._replace(points=scene.points[fewer], point_colors=scene.point_colors[fewer])
    colors = np.rint(255 * np.clip(0.5 + SH_C0 * groups.sh_dc, 0, 1)).astype(np.uint8)
    middles = scene._replace(points=groups.means.astype(np.float64), point_colors=colors)
    jobs = ((ALL, plain, scene), (PLAIN, plain, part), (GROUPS, plain, middles), (MIXED, mixed, scene))
    return [
        {"scene": scene.name, "primitives": name, **train_and_measure(recipe, of_points, iterations, n_seeds)}
        for name, recipe, of_points in jobs
    ]


def train_and_measure(recipe: Recipe, scene: Scene, iterations: int, n_seeds: int) -> dict[str, Any]:
    """Return the measures of trainings, and what has become of the population of the last."""
    row: dict[str, Any] = {"psnr": [], "ssim": []}
    for seed in range(n_seeds):
        state = kit.train_with_progress(scene, scale_recipe(recipe, iterations), seed)
        renderer = recipe.representation.renderer
        found = evaluate(state.model, scene.test_views, RenderSettings(scene.background, renderer=renderer))
        row["psnr"].append(found.psnr)
        row["ssim"].append(found.ssim)
    g = state.gaussians
    row["number"], row["n_floats"] = len(g.means), len(g.means) * kit.count_floats(g)
    kinds = np.bincount(counts(g), minlength=4)[1:].tolist() if isinstance(g, MixedGaussians) else [len(g.means), 0, 0]
    return {**row, "kinds": kinds}


def draw(rows: list[dict[str, Any]]) -> Figure:
    """Draw the test PSNR of each population over its floats, a panel for each scene."""
    scenes = group(rows, "scene")
    figure, panels = subplots((4.2 * len(scenes), 3.4), 1, len(scenes), squeeze=False)
    for axes, (scene, own) in zip(panels[0], scenes.items(), strict=True):
        in_millions = [{**row, "millions": row["n_floats"] / 1e6} for row in own]
        plot_curves(axes, in_millions, "millions", "psnr", COLORS, key="primitives")
        axes.set(title=scene, xlabel="floats (millions)", ylabel="test PSNR (dB)")
        axes.margins(0.2)
        axes.legend()
    return figure
