"""Depth reinitialisation, the paper's comparison (Table 4): mid-point, centre or blended depth, and with our guards.

A synthetic scene, whose true depths are known, is trained once for each seed. Then each choice draws the same number of
points, and all begin anew from theirs and train for the same number of iterations, without any event. A seed decides
the order of views and which pixels are drawn.

A point's error is its camera z against the true depth at its pixel, relative to the latter. A point of the sky has no
true depth: it hangs in front of the sky if it is nearer than the depth within which most of the surfaces are.
"""

import argparse
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm import tqdm

from minisplat_ref.datasets.synthetic import SCENE_NAMES, SyntheticScene, make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.experiments.studies.front import (
    BLUE,
    RED,
    describe_scene,
    mean_and_deviation,
    tidy,
    title,
    write,
)
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.reporting import markdown_table
from minisplat_ref.strategy.depth_reinit import (
    PixelPoints,
    blended_points,
    centre_points,
    midpoint_points,
    reinitial_points,
)
from minisplat_ref.strategy.initialization import from_points
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.loop import train
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Bools, Floats, Gaussians, Scene

RECIPE = "3dgs-accel"
POINTS_PER_PIXEL = 0.03  # twice the recipes' number, as nothing is added afterwards
LEAST_ALPHA, DEPTH_TOLERANCE = 0.9, 0.05  # of the guards
BACKDROP = 10.0  # distance of what is not confirmed, in extents of the scene
OFF_SURFACE = 0.05  # relative error above which a point is not on its surface
SKY_BEHIND = 0.95  # share of the surfaces that a point of the sky has to be behind


class Choice(NamedTuple):
    """How points are drawn."""

    points_of: Callable[..., PixelPoints]
    least_alpha: float = 0.0
    depth_tolerance: float | None = None
    has_backdrop: bool = False


CHOICES = {
    "mid-point": Choice(midpoint_points),
    "centre": Choice(centre_points),
    "blended": Choice(blended_points),
    "mid-point, opacity floor": Choice(midpoint_points, LEAST_ALPHA),
    "mid-point, vote": Choice(midpoint_points, 0.0, DEPTH_TOLERANCE),
    "mid-point, vote, backdrop": Choice(midpoint_points, 0.0, DEPTH_TOLERANCE, has_backdrop=True),
    "blended, vote": Choice(blended_points, 0.0, DEPTH_TOLERANCE),
}

MEASURES = {
    "median_error": "median error",
    "high_error": "90 % below",
    "off_surface": "off the surface",
    "in_front_of_sky": "in front of the sky",
    "n_points": "points",
    "psnr": "PSNR (dB)",
}


def run(args: argparse.Namespace) -> None:
    """Train, reinitialise, measure, write, print the table.

    Raises
    ------
    InputError
        There is no such scene, or the output folder cannot be used.
    """
    if args.scene not in SCENE_NAMES:
        raise InputError(f"{args.scene}: true depths are known of {', '.join(SCENE_NAMES)} alone; give one of these")
    with making_folder(args.out) as folder:
        truth = make_scene(args.scene)
        runs = list(measure(truth, args.iterations, args.train_on, args.seeds))
        settings = {
            "recipe": RECIPE,
            "iterations": args.iterations,
            "train_on": args.train_on,
            "seeds": list(args.seeds),
            "least_alpha": LEAST_ALPHA,
            "depth_tolerance": DEPTH_TOLERANCE,
            "backdrop": BACKDROP,
        }
        summary = summarise(runs)
        result = {**describe_scene(truth.scene), **settings, "summary": summary, "runs": runs}
        write(folder, result, draw(summary))
    print(title(result))
    seeds = ", ".join(map(str, args.seeds))
    print(f"{RECIPE}, {args.iterations} iterations, then {args.train_on} from the new points; seeds {seeds}\n")
    print(markdown_table(["points", *MEASURES.values()], to_rows(summary)))


def measure(truth: SyntheticScene, iterations: int, train_on: int, seeds: tuple[int, ...]) -> Iterator[dict[str, Any]]:
    """Train with every seed, and reinitialise in every way.

    Parameters
    ----------
    truth : SyntheticScene
    iterations : int
        Before reinitialisation.
    train_on : int
        Iterations after it.
    seeds : sequence of int

    Yields
    ------
    run : dict
        The :data:`MEASURES`; ``psnr`` is that of the test views in the end, ``psnr_before`` that of the Gaussians
        which gave way.
    """
    scene = truth.scene
    with tqdm(total=len(seeds) * len(CHOICES), desc="reinitialisations", leave=False) as bar:
        for seed in seeds:
            trained = train(scene, get_recipe(RECIPE, iterations), seed=seed).gaussians
            before = evaluate(trained, scene.test_views, background=scene.background).psnr
            for name, choice in CHOICES.items():
                rng = np.random.default_rng(seed)
                points, pixels = drawn_points(trained, scene, choice, rng)
                colors = np.concatenate([view.image.reshape(-1, 3) for view in scene.train_views])[pixels]
                learned = train_from(from_points(points, colors, sh_degree=0), scene, train_on, rng)
                psnr = evaluate(learned, scene.test_views, background=scene.background).psnr
                yield {
                    "choice": name,
                    "seed": seed,
                    "n_points": len(points),
                    **errors(points, pixels, truth),
                    "psnr_before": before,
                    "psnr": psnr,
                }
                bar.update()


def drawn_points(
    gaussians: Gaussians, scene: Scene, choice: Choice, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.int64]]:
    """Return points [P, 3] and the pixels [P] they are of, counted through all training views.

    Points come with their pixels' colours. In photographs in which the colour is the number of the pixel, that tells
    which pixel it is.
    """
    shape = (len(scene.train_views), *scene.train_views[0].image.shape[:2])
    numbers = np.arange(np.prod(shape)).reshape(shape)
    coded = np.stack([numbers >> 16, numbers >> 8, numbers], axis=-1).astype(np.uint8)  # [V, H, W, 3], low bytes
    views = [view._replace(image=image) for view, image in zip(scene.train_views, coded, strict=True)]
    points, colors = reinitial_points(
        gaussians,
        views,
        round(POINTS_PER_PIXEL * numbers.size),
        points_of=choice.points_of,
        least_alpha=choice.least_alpha,
        depth_tolerance=choice.depth_tolerance,
        backdrop_distance=BACKDROP * scene.extent if choice.has_backdrop else None,
        rng=rng,
    )
    return points, colors.astype(np.int64) @ np.array([65536, 256, 1])


def depth_errors(points: Floats, pixels: NDArray[np.int64], truth: SyntheticScene) -> tuple[Floats, Bools]:
    """Return the relative errors [P] of points [P, 3] of these pixels [P], and which [P] hang in front of the sky.

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
    """Return what the true depths say of points [P, 3] of these pixels [P]; shares are of all points."""
    relative, is_in_front = depth_errors(points, pixels, truth)
    return {
        "median_error": float(np.nanmedian(relative)),
        "high_error": float(np.nanquantile(relative, 0.9)),
        "off_surface": float(np.mean(relative > OFF_SURFACE)),
        "in_front_of_sky": float(np.mean(is_in_front)),
    }


def train_from(gaussians: Gaussians, scene: Scene, iterations: int, rng: np.random.Generator) -> Gaussians:
    """Train without events and without view-dependent colour; ``gaussians`` are changed in place."""
    recipe = get_recipe(RECIPE, iterations)._replace(events=(), sh_milestones=())
    state = TrainState(gaussians, zero_moments(gaussians), step=0, view_order=[], rng=rng, stats={})
    return train(scene, recipe, seed=0, state=state).gaussians


def summarise(runs: list[dict[str, Any]]) -> dict[str, dict[str, tuple[float, float]]]:
    """Return mean and standard deviation over the seeds, for each choice and measure."""
    return {
        choice: {name: mean_and_deviation([row[name] for row in runs if row["choice"] == choice]) for name in MEASURES}
        for choice in CHOICES
    }


def to_rows(summary: dict[str, dict[str, tuple[float, float]]]) -> list[list[str]]:
    """Return the lines of the table: means, and of PSNR the deviation over the seeds as well."""
    rows = []
    for choice, row in summary.items():
        mean, deviation = row["psnr"]
        shares = [f"{row[name][0]:.1%}" for name in MEASURES if name not in ("n_points", "psnr")]
        rows.append([choice, *shares, f"{row['n_points'][0]:,.0f}", f"{mean:.2f} ± {deviation:.2f}"])
    return rows


def draw(summary: dict[str, dict[str, tuple[float, float]]]) -> Figure:
    """Draw mean and deviation of the errors, the shares and PSNR for each choice."""
    names = [name for name in MEASURES if name != "n_points"]
    figure = Figure(figsize=(2.4 * len(names) + 1.6, 3.0), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(names), sharey=True), names, strict=True):
        scale = 1.0 if name == "psnr" else 100.0
        for line, (choice, row) in enumerate(summary.items()):
            mean, deviation = (scale * value for value in row[name])
            color = RED if CHOICES[choice].depth_tolerance is None and CHOICES[choice].least_alpha == 0 else BLUE
            axes.errorbar(mean, line, xerr=deviation, color=color, marker="o", capsize=4)
        axes.set(title=MEASURES[name], xlabel="" if name == "psnr" else "%", ylim=(len(summary) - 0.5, -0.5))
        axes.set_yticks(range(len(summary)), list(summary))
        tidy(axes, grid="x")
    return figure
