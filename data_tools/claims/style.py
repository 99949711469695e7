"""Claim ``style/swatches`` (G-Style, arXiv 2408.15695): two patterns on the synthetic room, with splitting and without.

How near the features of held-out views are to those of the style is measured by their sliced Wasserstein distance, the
mean over random directions of the distance between the quantiles of what both have along it. Whether views agree is
measured where exact depths say that two of them show the same point: the mean difference of its colours there.
Before is the scene in the style's colours, as both arms have it at the start.
"""

import argparse
import functools
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import RESUMED_OUT, declare, iterations, number, seeds
from data_tools.claims.kit.figures import show, subplots
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.style.recipe import Plan, stylise
from minisplat_ref.mechanisms.features.filters import CLASSICAL
from minisplat_ref.reference.pinhole import project_into_image, unproject_depth
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.types import Camera, Floats, Gaussians, Model, view_from

SIDE = 96  # pixels of a swatch
ARMS = {"split": True, "not split": False}
N_DIRECTIONS, N_QUANTILES = 64, 200
DEPTH_TOLERANCE = 0.01  # relative, within which two views show the same point
COLUMNS = (
    ("distance of features, before", spread("distance_before", 4)),
    ("after", spread("distance", 4)),
    ("disagreement of views (levels), before", spread("disagreement_before", 2)),
    ("after", spread("disagreement", 2)),
    ("Gaussians", spread("n_gaussians", 0)),
)


def swatches() -> dict[str, Floats]:
    """Return two patterns [SIDE, SIDE, 3] in [0, 1]: slanted stripes of two blues, and a red and yellow checker."""
    y, x = np.mgrid[:SIDE, :SIDE]
    stripes = (np.sin(2 * np.pi * (x + y) / 9) > 0)[..., None]
    checks = ((x // 6 + y // 6) % 2 == 0)[..., None]
    return {
        "stripes": np.where(stripes, [0.1, 0.2, 0.5], [0.7, 0.85, 0.95]),
        "checks": np.where(checks, [0.75, 0.15, 0.1], [0.95, 0.8, 0.3]),
    }


def run(args: argparse.Namespace) -> kit.Report:
    """Train with every seed, style by every pattern, and measure."""
    made = make_scene("room")
    settings = {**kit.describe_scene(made.scene), **kit.settings_of(args, "training", "iterations", "seeds")}
    jobs = kit.jobs_of(seed=range(args.seeds), pattern=swatches(), arm=ARMS)

    @functools.cache
    def trained(seed: int) -> Gaussians:
        recipe = find_recipe("3dgs-accel", args.training)
        return Gaussians(*kit.train_with_progress(made.scene, recipe, seed).gaussians)

    def measure(seed: int, pattern: str, arm: str) -> dict[str, Any]:
        plan = Plan(iterations=args.iterations, seed=seed, splits=ARMS[arm])
        image = swatches()[pattern]
        styled = stylise(trained(seed), made.scene, image, plan)
        if seed == 0:
            np.save(args.out / f"{pattern}, {arm}.npy", _picture(made, styled.gaussians))
        before, after = (outcome(made, g, image) for g in (styled.recolored, styled.gaussians))
        return {**after, **{f"{name}_before": value for name, value in before.items()}}

    records = kit.resume(args.out, settings, jobs, measure)
    pictures = {f"{p}, {arm}": np.load(args.out / f"{p}, {arm}.npy") for p in swatches() for arm in ARMS}
    named = [{**record, "name": f"{record['pattern']}, {record['arm']}"} for record in records]
    text = f"{kit.title(settings)}\n\n{table(named, {'name': 'pattern, arm'}, COLUMNS)}"
    return kit.Report({**settings, "records": records}, draw(pictures), text)


def outcome(made: SyntheticScene, gaussians: Gaussians, image: Floats) -> dict[str, float]:
    """Return the distance of features on test views, the disagreement of neighbouring training views, and the count."""
    settings = RenderSettings(made.scene.background)
    shown = [_render(gaussians, view.camera, settings) for view in made.scene.test_views]
    views = made.scene.train_views
    images = [_render(gaussians, view.camera, settings) for view in views]
    pairs = range(len(views) - 1)
    gaps = [
        disagreement(
            (images[k], images[k + 1]),
            (made.train_depths[k], made.train_depths[k + 1]),
            (views[k].camera, views[k + 1].camera),
        )
        for k in pairs
    ]
    return {
        "distance": float(np.mean([feature_distance(render, image) for render in shown])),
        "disagreement": 255 * float(np.mean(np.concatenate(gaps))),
        "n_gaussians": len(gaussians.means),
    }


def _render(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> Floats:
    return np.clip(settings.render_view(Model(gaussians), view_from(camera))[0].image, 0, 1)


def feature_distance(image: Floats, style: Floats) -> float:
    """Return the mean over the scales of the sliced Wasserstein distance between the features of two images."""
    (found, _), (wanted, _) = (CLASSICAL.features(each.astype(np.float64)) for each in (image, style))
    distances = [
        sliced_distance(a.reshape(-1, a.shape[2]), b.reshape(-1, b.shape[2]), np.random.default_rng(0))
        for a, b in zip(found, wanted, strict=True)
    ]
    return float(np.mean(distances))


def sliced_distance(a: Floats, b: Floats, rng: np.random.Generator) -> float:
    """Return the mean absolute difference of the quantiles of two sets of vectors [P, C], [Q, C] along random axes."""
    axes = rng.normal(size=(N_DIRECTIONS, a.shape[1]))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    levels = (np.arange(N_QUANTILES) + 0.5) / N_QUANTILES
    quantiles = [np.quantile(each @ axes.T, levels, axis=0) for each in (a, b)]
    return float(np.mean(np.abs(quantiles[0] - quantiles[1])))


def disagreement(
    images: tuple[Floats, Floats], depths: tuple[Floats, Floats], cameras: tuple[Camera, Camera]
) -> Floats:
    """Return the mean absolute difference of colours [P] at the pixels of one view whose point the other shows, too."""
    first, second = cameras
    y, x = np.nonzero(depths[0])
    rows, xy, z = project_into_image(unproject_depth(depths[0], first), second)
    u, v = np.floor(xy).astype(int).T
    here, there = (y[rows], x[rows]), (v, u)
    is_same = np.abs(depths[1][there] - z) < DEPTH_TOLERANCE * z
    differences = np.abs(images[0][here] - images[1][there]).mean(axis=1)
    return np.asarray(differences[is_same])


def _picture(made: SyntheticScene, gaussians: Gaussians) -> Floats:
    return _render(gaussians, made.scene.test_views[0].camera, RenderSettings(made.scene.background))


def draw(pictures: dict[str, Floats]) -> Figure:
    """Draw each swatch, and a held-out view in its style by both arms."""
    figure, rows = subplots((9, 4.6), 2, 3)
    for row, (pattern, image) in zip(rows, swatches().items(), strict=True):
        show(row[0], image, pattern)
        for axes, arm in zip(row[1:], ARMS, strict=True):
            show(axes, pictures[f"{pattern}, {arm}"], arm)
    return figure


CLAIMS = (
    declare(
        "swatches",
        "two patterns on a room: features, splitting, and whether views agree",
        run,
        RESUMED_OUT,
        number("--training", 1000, "iterations of the training"),
        iterations(500, "of each stage of the styling"),
        seeds(3),
    ),
)
