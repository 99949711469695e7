"""Claim ``geometry/depth``: what each loss on the rendered depth does to the depth, and to the images.

The paper is DS-NeRF, arXiv 2107.02791. A synthetic scene is trained without the terms, with each of them, and with all.
On test views the expected depth is compared with the ray tracer's in the pixels that are opaque, ``|z - z_true| /
z_true``.
"""

import argparse
from functools import partial
from typing import Any

import numpy as np

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, iterations, recipe, seeds, synthetic_scene
from data_tools.claims.kit.figures import bars
from data_tools.claims.kit.tables import first, spread, table
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.extensions.extension import find_recipe
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
COLUMNS = (
    ("weights", first(lambda record: ", ".join(f"{weight:g}" for weight in ARMS[record["arm"]].values()) or "0")),
    ("median depth error (%)", spread("median_error", 2, 100)),
    ("mean depth error (%)", spread("mean_error", 2, 100)),
    ("test PSNR (dB)", spread("psnr", 2)),
    ("Gaussians", spread("n_gaussians", 0)),
)
BARS = {"median_error": "Median error of the depth (relative)", "psnr": "PSNR of test views (dB)"}


def run(args: argparse.Namespace) -> kit.Report:
    """Train every arm with every seed, and measure."""
    made = make_scene(args.scene)
    records = kit.measure_arms(ARMS, args.seeds, partial(outcome, made, args.recipe, args.iterations))
    description = {**kit.describe_scene(made.scene), **kit.settings_of(args, "recipe", "iterations", "seeds")}
    text = f"{kit.title(description)}; {args.recipe}, {args.iterations} iterations\n\n"
    text += table(records, {"arm": "terms"}, COLUMNS)
    result = {**description, "weights": ARMS, "records": records}
    figure = bars(records, BARS, (9, 3.2))
    return kit.Report(result, figure, text, kit.arms_of(records, "arm", ("psnr", "median_error")))


def outcome(made: SyntheticScene, name: str, iterations: int, arm: str, seed: int) -> dict[str, Any]:
    """Train, and return the errors of depth and image on the test views."""
    recipe = configure(find_recipe(name, iterations, extension="geometry"), **ARMS[arm])
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


CLAIMS = (
    declare(
        "depth",
        "what each loss does to the depth, and to the images",
        run,
        *(synthetic_scene(), OUT, recipe("3dgs-accel"), iterations(2000), seeds(3)),
    ),
)
