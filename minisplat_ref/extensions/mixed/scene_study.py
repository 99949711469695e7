"""The study ``mixed/scene`` compares populations of as many floats on scenes.

Points of a scene become ellipses, lines and triangles by groups. 3DGS gets as many floats, by leaving points out at
random; and, for comparison, all of the points, and one Gaussian for each group, which tells what vertices are worth
apart from the choice of points. Nothing is densified or pruned, so that numbers stay; kinds change as the recipe has
it.
"""

import argparse
from typing import TYPE_CHECKING, Any

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import SCENE_NAMES
from minisplat_ref.extensions import shared_studies
from minisplat_ref.extensions import shared_trainings as shared
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.studies.study import Study
from minisplat_ref.types import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from minisplat_ref.training.schedule import Recipe

ALL, PLAIN, GROUPS, MIXED = "3DGS, all points", "3DGS, as many floats", "3DGS, one for each group", "mixed"
COLORS = {ALL: shared.YELLOW, PLAIN: shared.GREY, GROUPS: shared.BLUE, MIXED: shared.RED}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add scenes, ``--downscale``, ``--iterations``, ``--seeds`` and ``--out``."""
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="folders, or synthetic scenes such as room")
    parser.add_argument("--downscale", type=int, default=4, metavar="D", help="of folders (default 4)")
    parser.add_argument("--iterations", type=int, default=400, metavar="N", help="default 400")
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="from 0 on, of the trainings (default 2)")
    shared_studies.add_out(parser)


def run(args: argparse.Namespace) -> None:
    """Train, measure, write, print the table.

    Raises
    ------
    InputError
        A scene, a number or the output folder cannot be used.
    """
    from minisplat_ref.reporting import describe_machine, markdown_table

    shared_studies.check_at_least(1, downscale=args.downscale, iterations=args.iterations, seeds=args.seeds)
    scenes = [shared_studies.read_scene(s, 1 if s in SCENE_NAMES else args.downscale) for s in args.scenes]
    with making_folder(args.out) as folder:
        rows = [row for scene in scenes for row in outcomes(scene, args.iterations, args.seeds)]
        result = {"iterations": args.iterations, "seeds": args.seeds, "downscale": args.downscale, "rows": rows}
        shared_studies.write(folder, {**result, "machine": describe_machine()}, draw(rows))
    heading = ["scene", "primitives", "number", "floats", "ellipses, lines, triangles", "test PSNR", "test SSIM"]
    print(markdown_table(heading, [to_line(row) for row in rows]))


def outcomes(scene: Scene, iterations: int, n_seeds: int) -> list[dict[str, Any]]:
    """Return a row for each population of a scene."""
    from minisplat_ref.extensions.mixed.method import MIXED as RECIPE
    from minisplat_ref.extensions.mixed.method import MIXED_GAUSSIANS, promote, simplify_hulls
    from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
    from minisplat_ref.strategy.initialization import initial_gaussians
    from minisplat_ref.training.schedule import action_name

    names = {promote.__name__, simplify_hulls.__name__}
    mixed = RECIPE._replace(
        representation=MIXED_GAUSSIANS, events=tuple(event for event in RECIPE.events if action_name(event) in names)
    )
    plain = GS_ACCEL._replace(events=())
    whole = initial_gaussians(scene, plain.sh_degree, np.random.default_rng(0))
    groups = MIXED_GAUSSIANS.extend(whole, np.random.default_rng(0))
    n_equal = len(groups.means) * floats_of(groups) // floats_of(whole)
    order = np.random.default_rng(0).permutation(len(scene.points))
    fewer = np.sort(order[: min(n_equal, len(order))])
    part = scene._replace(points=scene.points[fewer], point_colors=scene.point_colors[fewer])
    colors = np.rint(255 * np.clip(0.5 + SH_C0 * groups.sh_dc, 0, 1)).astype(np.uint8)
    middles = scene._replace(points=groups.means.astype(np.float64), point_colors=colors)
    jobs = ((ALL, plain, scene), (PLAIN, plain, part), (GROUPS, plain, middles), (MIXED, mixed, scene))
    return [
        {"scene": scene.name, "primitives": name, **trained(recipe, of_points, iterations, n_seeds)}
        for name, recipe, of_points in jobs
    ]


def trained(recipe: "Recipe", scene: Scene, iterations: int, n_seeds: int) -> dict[str, Any]:
    """Return the measures of trainings, and what has become of the population of the last."""
    from tqdm import tqdm

    from minisplat_ref.extensions.mixed.population import MixedGaussians, counts
    from minisplat_ref.metrics import evaluate
    from minisplat_ref.training.loop import train
    from minisplat_ref.training.schedule import scaled

    row: dict[str, Any] = {"psnr": [], "ssim": []}
    for seed in range(n_seeds):
        with tqdm(total=iterations, desc=f"{recipe.name}, seed {seed}", leave=False, disable=None) as bar:
            state = train(scene, scaled(recipe, iterations), seed=seed, on_step=lambda _: bar.update())
        renderer = recipe.representation.renderer
        found = evaluate(state.model, scene.test_views, RenderSettings(scene.background, renderer=renderer))
        row["psnr"].append(found.psnr)
        row["ssim"].append(found.ssim)
    g = state.gaussians
    row["number"], row["n_floats"] = len(g.means), len(g.means) * floats_of(g)
    kinds = np.bincount(counts(g), minlength=4)[1:].tolist() if isinstance(g, MixedGaussians) else [len(g.means), 0, 0]
    return {**row, "kinds": kinds}


def floats_of(population: Any) -> int:
    """Return how many numbers a primitive of the population has."""
    return sum(int(np.prod(field.shape[1:])) for field in population)


def to_line(row: dict[str, Any]) -> list[str]:
    """Return a line of the table."""
    kinds = ", ".join(f"{number:,}" for number in row["kinds"])
    measures = [shared.with_deviation(row["psnr"], 2), shared.with_deviation(row["ssim"], 4)]
    return [row["scene"], row["primitives"], f"{row['number']:,}", f"{row['n_floats']:,}", kinds, *measures]


def draw(rows: list[dict[str, Any]]) -> "Figure":
    """Draw the test PSNR of each population over its floats, a panel for each scene."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(4.2 * len(scenes), 3.4), layout="constrained")
    for i, scene in enumerate(scenes):
        axes = figure.add_subplot(1, len(scenes), i + 1)
        for row in (row for row in rows if row["scene"] == scene):
            mean, deviation = shared.mean_and_deviation(row["psnr"])
            name = row["primitives"]
            axes.errorbar(row["n_floats"] / 1e6, mean, deviation, fmt="o", capsize=3, color=COLORS[name], label=name)
        axes.set(title=scene, xlabel="floats (millions)", ylabel="test PSNR (dB)")
        axes.margins(0.2)
        axes.legend(frameon=False, fontsize=8)
        shared_studies.tidy(axes)
    return figure


SCENE = Study("scene", "ellipses, lines and triangles against 3DGS of as many floats", add_arguments, run)
"""``mixed/scene``."""
