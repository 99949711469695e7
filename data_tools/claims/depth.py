"""Depth reinitialisation, the paper's comparison (Table 4): mid-point, centre or blended depth, and with our guards.

The paper is Mini-Splatting, arXiv 2403.14166. A synthetic scene with known depths is trained with the recipe itself,
including all events, once for each choice and seed; only the points drawn by reinitialisation differ. Just before the
first reinitialisation, up to which all choices of a seed are the same training, the points that it is about to draw are
compared with the truth. The number of points behind the scene that are left at the time of simplification shows whether
density control removes them.

A point's error is that of its camera z relative to the true depth at its pixel. A point of the sky has no true depth:
it hangs in front of the sky if it is nearer than the depth within which most of the surfaces are.
"""

import argparse
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, SEEDS, SYNTHETIC_SCENE, declare, iterations, recipe
from data_tools.claims.kit.figures import plus_minus, summarise
from minisplat_ref.datasets.synthetic import SCENE_NAMES, SyntheticScene, make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.interface.palette import BLUE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.methods import RECIPES, get_recipe
from minisplat_ref.methods.mini_splatting import (
    BACKDROP_EXTENTS,
    DEPTH_TOLERANCE,
    reinitialise_from_depth,
    restart_from_means,
    simplify,
    store_sh,
)
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings, as_model
from minisplat_ref.strategy.depth_reinit import (
    PixelPoints,
    blend_points,
    centre_points,
    midpoint_points,
    reinitial_points,
)
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import Recipe, firing_steps
from minisplat_ref.training.state import StepReport
from minisplat_ref.types import Bools, Floats, Model, Scene

ALPHA_MIN = 0.9  # of the safeguard that requires opacity
FAR = 0.5 * BACKDROP_EXTENTS  # extents from the origin beyond which there is nothing but the backdrop
OFF_SURFACE = 0.05  # relative error above which a point is not on its surface
SKY_BEHIND = 0.95  # share of the surfaces that a point of the sky has to be behind


class Choice(NamedTuple):
    """How points are drawn."""

    points_of: Callable[..., PixelPoints]
    min_alpha: float = 0.0
    depth_tolerance: float | None = None
    has_backdrop: bool = False

    def apply_to(self, recipe: Recipe) -> Recipe:
        """Return the recipe with this choice in its reinitialisation."""
        return configure(
            recipe,
            points_of=self.points_of,
            min_alpha=self.min_alpha,
            depth_tolerance=self.depth_tolerance,
            backdrop_extents=BACKDROP_EXTENTS if self.has_backdrop else None,
        )


CHOICES = {
    "mid-point": Choice(midpoint_points),
    "centre": Choice(centre_points),
    "blended": Choice(blend_points),
    "mid-point, opacity floor": Choice(midpoint_points, ALPHA_MIN),
    "mid-point, vote": Choice(midpoint_points, 0.0, DEPTH_TOLERANCE),
    "mid-point, vote, backdrop": Choice(midpoint_points, 0.0, DEPTH_TOLERANCE, has_backdrop=True),
    "blended, vote": Choice(blend_points, 0.0, DEPTH_TOLERANCE),
}

METRICS = {
    "median_error": "median error",
    "high_error": "90 % below",
    "off_surface": "off the surface",
    "in_front_of_sky": "in front of the sky",
    "n_points": "points",
    "backdrop_left": "backdrop left",
    "psnr": "PSNR (dB)",
}
SHARES = ("median_error", "high_error", "off_surface", "in_front_of_sky")


def run(args: argparse.Namespace) -> kit.Report:
    """Train with every seed and every choice, and measure.

    Raises
    ------
    InputError
        There is no such scene, or the recipe does not reinitialise.
    """
    if args.scene not in SCENE_NAMES:
        raise InputError(f"{args.scene}: true depths are known of {', '.join(SCENE_NAMES)} alone; give one of these")
    recipe = get_recipe(args.recipe, args.iterations)
    steps = firing_steps(recipe, reinitialise_from_depth)
    if not steps:
        names = ", ".join(name for name, other in RECIPES.items() if firing_steps(other, reinitialise_from_depth))
        raise InputError(f"recipe {args.recipe} does not reinitialise from depth: choose from {names}")
    truth = make_scene(args.scene)
    jobs = [(name, seed) for seed in args.seeds for name in CHOICES]
    runs = [
        {"choice": name, "seed": seed, **measure(truth, recipe, CHOICES[name], seed)}
        for name, seed in kit.with_progress(jobs, "trainings")
    ]
    guards = {"min_alpha": ALPHA_MIN, "depth_tolerance": DEPTH_TOLERANCE, "backdrop_extents": BACKDROP_EXTENTS}
    settings = {"recipe": recipe.name, "iterations": args.iterations, "seeds": list(args.seeds), **guards}
    acting, alike = kit.leave_out_idle(kit.arms_of(runs, "choice", list(METRICS)))
    summary = summarise([run for run in runs if run["choice"] in acting], "choice", METRICS)
    result = {**kit.describe_scene(truth.scene), **settings, "summary": summary, "runs": runs}
    length = f"{recipe.name}, {args.iterations} iterations, reinitialised at {' and '.join(map(str, steps))}"
    table = markdown_table(["points", *METRICS.values()], to_rows(summary))
    return kit.Report(result, draw(summary), f"{kit.title(result)}\n{length}; {kit.seeds_of(args)}\n\n{table}{alike}")


def measure(truth: SyntheticScene, recipe: Recipe, choice: Choice, seed: int) -> dict[str, float | None]:
    """Train once; return the :data:`METRICS`, with the final ``psnr`` of the test views.

    ``backdrop_left`` is the fraction of the points moved behind the scene that survive densification, None if none were
    moved.
    """
    scene = truth.scene
    reinitialised = firing_steps(recipe, reinitialise_from_depth)
    densified = min(s for s in firing_steps(recipe, simplify, store_sh, restart_from_means) if s > reinitialised[-1])
    drawn: dict[str, float] = {}
    counts: dict[int, int] = {}  # of distant Gaussians, by iteration

    def look(report: StepReport) -> None:
        model = report.state.model
        if report.step == reinitialised[0] - 1:
            points, pixels = draw_points(model, scene, choice, np.random.default_rng(seed))
            drawn.update(n_points=len(points), **errors(points, pixels, truth))
        if report.step in (reinitialised[-1], densified - 1):
            counts[report.step] = n_far(model, scene)

    model = train(scene, choice.apply_to(recipe), seed=seed, on_step=look).model
    n_sent, n_left = counts[reinitialised[-1]], counts[densified - 1]
    psnr = evaluate(model, scene.test_views, RenderSettings(scene.background)).psnr
    return {**drawn, "backdrop_left": n_left / n_sent if n_sent else None, "psnr": psnr}


def n_far(model: Model, scene: Scene) -> int:
    """Return the number of Gaussians beyond :data:`FAR` extents of the scene."""
    return int(np.count_nonzero(np.linalg.norm(model.gaussians.means, axis=1) > FAR * scene.extent))


def draw_points(
    model: Any, scene: Scene, choice: Choice, rng: np.random.Generator, n_points: int | None = None
) -> tuple[Floats, NDArray[np.int64]]:
    """Return points [P, 3] and the pixels [P] they come from, numbered through all training views.

    There are at most ``n_points``, or as many as there are Gaussians. Points come with their pixels' colours, so
    photographs whose colours encode the number of the pixel tell which pixel it is.
    """
    model = as_model(model)
    shape = (len(scene.train_views), *scene.train_views[0].image.shape[:2])
    numbers = np.arange(np.prod(shape)).reshape(shape)
    coded = np.stack([numbers >> 16, numbers >> 8, numbers], axis=-1).astype(np.uint8)  # [V, H, W, 3], low bytes
    views = [view._replace(image=image) for view, image in zip(scene.train_views, coded, strict=True)]
    points, colors = reinitial_points(
        model,
        views,
        len(model.gaussians.means) if n_points is None else n_points,
        points_of=choice.points_of,
        min_alpha=choice.min_alpha,
        depth_tolerance=choice.depth_tolerance,
        backdrop_distance=BACKDROP_EXTENTS * scene.extent if choice.has_backdrop else None,
        rng=rng,
    )
    return points, colors.astype(np.int64) @ np.array([65536, 256, 1])


def depth_errors(points: Floats, pixels: NDArray[np.int64], truth: SyntheticScene) -> tuple[Floats, Bools]:
    """Return the relative errors [P] of points [P, 3] from pixels [P], and which [P] hang in front of the sky.

    The error of a point of the sky is NaN.
    """
    true_depths = truth.train_depths.ravel()[pixels]  # [P]
    view_ids = pixels // truth.train_depths[0].size
    cameras = [view.camera for view in truth.scene.train_views]
    forward = np.stack([camera.cam_from_world_R[2] for camera in cameras])[view_ids]  # [P, 3]
    depths = (forward * points).sum(axis=1) + np.array([camera.cam_from_world_t[2] for camera in cameras])[view_ids]
    is_sky = true_depths == 0
    relative = np.abs(depths - true_depths) / np.where(is_sky, np.nan, true_depths)
    sky_depth = np.quantile(truth.train_depths[truth.train_depths > 0], SKY_BEHIND)
    return relative, is_sky & (depths < sky_depth)


def errors(points: Floats, pixels: NDArray[np.int64], truth: SyntheticScene) -> dict[str, float]:
    """Compare points [P, 3] from pixels [P] with the true depths; shares are of all points."""
    relative, is_in_front = depth_errors(points, pixels, truth)
    return {
        "median_error": float(np.nanmedian(relative)),
        "high_error": float(np.nanquantile(relative, 0.9)),
        "off_surface": float(np.mean(relative > OFF_SURFACE)),
        "in_front_of_sky": float(np.mean(is_in_front)),
    }


def to_rows(summary: dict[str, dict[str, tuple[float, float]]]) -> list[list[str]]:
    """Return the lines of the table: means, and for PSNR also the deviation over the seeds."""
    rows = []
    for choice, row in summary.items():
        shares = [f"{row[name][0]:.1%}" for name in SHARES]
        left = f"{row['backdrop_left'][0]:.1%}" if "backdrop_left" in row else ""
        rows.append([choice, *shares, f"{row['n_points'][0]:,.0f}", left, plus_minus(row["psnr"], 2)])
    return rows


def draw(summary: dict[str, dict[str, tuple[float, float]]]) -> Figure:
    """Draw mean and deviation of the errors, the shares and PSNR for each choice."""
    names = [*SHARES, "psnr"]
    figure = Figure(figsize=(2.4 * len(names) + 1.6, 3.0), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(names), sharey=True), names, strict=True):
        scale = 1.0 if name == "psnr" else 100.0
        for line, (choice, row) in enumerate(summary.items()):
            mean, deviation = (scale * value for value in row[name])
            color = RED if CHOICES[choice].depth_tolerance is None and CHOICES[choice].min_alpha == 0 else BLUE
            axes.errorbar(mean, line, xerr=deviation, color=color, marker="o", capsize=4)
        axes.set(title=METRICS[name], xlabel="" if name == "psnr" else "%", ylim=(len(summary) - 0.5, -0.5))
        axes.set_yticks(range(len(summary)), list(summary))
        axes.grid(visible=False, axis="y")
    return figure


CLAIMS = (
    declare(
        "depth",
        "depth reinitialisation: mid-points, centres, blended depth; guards",
        run,
        SYNTHETIC_SCENE,
        OUT,
        iterations(3000),
        recipe("mini-splatting"),
        SEEDS,
        description="Train a synthetic scene by a recipe that reinitialises from depth, which is done in several"
        " ways, and compare with the truth.",
    ),
)
