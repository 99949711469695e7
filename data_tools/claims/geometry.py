"""Claim ``geometry/depth``: what each loss on the rendered depth does to the depth, and to the images.

The paper is DS-NeRF, arXiv 2107.02791. A synthetic scene is trained without the terms, with each of them, and with all.
On test views the expected depth is compared with the ray tracer's in the pixels that are opaque, ``|z - z_true| /
z_true``.
"""

import argparse
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, iterations, recipe, seeds, synthetic_scene
from data_tools.claims.kit.figures import mean_and_deviation, with_deviation
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.palette import BLUE, GREY
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.metrics import evaluate
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.types import Model

ARMS: dict[str, dict[str, float]] = {
    "without": {},
    "sfm_depth": {"sfm_depth": 0.1},
    "depth_smoothness": {"depth_smoothness": 0.1},
    "normal_smoothness": {"normal_smoothness": 0.01},
}
ARMS["all three"] = {name: weight for arm in ARMS.values() for name, weight in arm.items()}
ALPHA_MIN = 0.5


def run(args: argparse.Namespace) -> kit.Report:
    """Train every arm with every seed, and measure."""
    made = make_scene(args.scene)
    records = [
        {"arm": arm, "seed": seed, **outcome(made, settings, args.recipe, args.iterations, seed)}
        for arm, settings in kit.with_progress(ARMS.items(), "terms")
        for seed in range(args.seeds)
    ]
    description = {**kit.describe_scene(made.scene), **kit.settings_of(args, "recipe", "iterations", "seeds")}
    heading = ["terms", "weights", "median depth error (%)", "mean depth error (%)", "test PSNR (dB)", "Gaussians"]
    text = f"{kit.title(description)}; {args.recipe}, {args.iterations} iterations\n\n"
    text += markdown_table(heading, [to_line(arm, records) for arm in ARMS])
    result = {**description, "weights": ARMS, "records": records}
    return kit.Report(result, draw(records), text, kit.arms_of(records, "arm", ("psnr", "median_error")))


def outcome(made: SyntheticScene, settings: dict[str, float], name: str, iterations: int, seed: int) -> dict[str, Any]:
    """Train, and return the errors of depth and image on the test views."""
    recipe = configure(find_recipe(name, iterations, extension="geometry"), **settings)
    state = kit.train_with_progress(made.scene, recipe, seed, backend=CPU)
    render_settings = RenderSettings(made.scene.background, renderer=recipe.renderer)
    errors = []
    for view, truth in zip(made.scene.test_views, made.test_depths, strict=True):
        output, _ = render_settings.render_view(Model(state.gaussians), view, frozenset({"depth"}))
        depth = expected_depth(output.image[..., 3], output.alpha)
        is_counted = (truth > 0) & (output.alpha > ALPHA_MIN)
        errors.append(np.abs(depth - truth)[is_counted] / truth[is_counted])
    every = np.concatenate(errors)
    return {
        "median_error": float(np.median(every)),
        "mean_error": float(np.mean(every)),
        "psnr": evaluate(state.model, made.scene.test_views, render_settings).psnr,
        "n_gaussians": len(state.gaussians.means),
    }


def to_line(arm: str, records: list[dict[str, Any]]) -> list[str]:
    """Return a line of the table: means and deviations over the seeds."""
    own = [record for record in records if record["arm"] == arm]
    errors = [with_deviation([100 * record[key] for record in own], 2) for key in ("median_error", "mean_error")]
    psnr, count = (with_deviation([r[key] for r in own], digits) for key, digits in (("psnr", 2), ("n_gaussians", 0)))
    weights = ", ".join(f"{weight:g}" for weight in ARMS[arm].values()) or "0"
    return [arm, weights, *errors, psnr, count]


def draw(records: list[dict[str, Any]]) -> Figure:
    """Draw the error of depth and the PSNR of each arm."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for axes, key, title in zip(
        figure.subplots(1, 2),
        ("median_error", "psnr"),
        ("Median error of the depth (relative)", "PSNR of test views (dB)"),
        strict=True,
    ):
        values = [mean_and_deviation([r[key] for r in records if r["arm"] == arm]) for arm in ARMS]
        means, deviations = np.transpose(values)
        axes.barh(list(ARMS), means, xerr=deviations, color=[GREY, *[BLUE] * (len(ARMS) - 1)])
        axes.invert_yaxis()
        axes.set_title(title)
        if key == "psnr":
            axes.set_xlim(min(means - deviations) - 0.5, None)
    return figure


CLAIMS = (
    declare(
        "depth",
        "what each loss does to the depth, and to the images",
        run,
        *(synthetic_scene(), OUT, recipe("3dgs-accel"), iterations(2000), seeds(3)),
    ),
)
