"""Claim ``surfels/losses``: what the two losses do to depths, normals and images, beside 3D Gaussians.

The paper is 2DGS, arXiv 2403.17888. A synthetic scene is trained by ``3dgs-accel`` and by ``surfels`` without the
losses, with each, and with both. On test views the expected depth is compared with the ray tracer's where the image is
opaque, and the normals of the surface through it with the true ones.
"""

import argparse
from functools import partial
from typing import Any

import numpy as np

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, iterations, seeds, synthetic_scene
from data_tools.claims.kit.figures import bars
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.mechanisms.depth_maps.normals import central_normals
from minisplat_ref.metrics import evaluate
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.recipe_settings import configure

GAUSSIANS = "3dgs-accel"
ARMS: dict[str, dict[str, float]] = {
    GAUSSIANS: {},
    "surfels without": {"normal_consistency": 0.0},
    "normal_consistency": {},
    "distortion": {"normal_consistency": 0.0, "distortion": 100.0},
    "both": {"distortion": 100.0},
}
"""Settings by name; the weights are the released ones."""
ALPHA_MIN = 0.5
COLUMNS = (
    ("median depth error (%)", spread("depth_error", 2)),
    ("median normal error (degrees)", spread("normal_error", 1)),
    ("test PSNR (dB)", spread("psnr", 2)),
    ("number", spread("n_gaussians", 0)),
)
BARS = {
    "depth_error": "Median error of the depth (%)",
    "normal_error": "Median error of normals (degrees)",
    "psnr": "PSNR of test views (dB)",
}


def run(args: argparse.Namespace) -> kit.Report:
    """Train every arm with every seed, and measure."""
    made = make_scene(args.scene)
    records = kit.measure_arms(ARMS, args.seeds, partial(outcome, made, args.iterations))
    description = {**kit.describe_scene(made.scene), **kit.settings_of(args, "iterations", "seeds")}
    text = f"{kit.title(description)}; {args.iterations} iterations\n\n{table(records, {'arm': 'arm'}, COLUMNS)}"
    result = {**description, "settings": ARMS, "records": records}
    figure = bars(records, BARS, (10, 3))
    return kit.Report(result, figure, text, kit.arms_of(records, "arm", ("psnr", "depth_error")))


def outcome(made: SyntheticScene, iterations: int, arm: str, seed: int) -> dict[str, Any]:
    """Train, and return the errors of depth, normals and image on the test views."""
    recipe = configure(find_recipe(GAUSSIANS if arm == GAUSSIANS else "surfels", iterations), **ARMS[arm])
    state = kit.train_with_progress(made.scene, recipe, seed)
    settings = RenderSettings(made.scene.background, renderer=recipe.renderer)
    depth_errors, angles = [], []
    for view, truth, normals in zip(made.scene.test_views, made.test_depths, made.test_normals, strict=True):
        output, _ = settings.render_view(state.model, view, frozenset({"depth"}))
        depth = expected_depth(output.image[..., 3], output.alpha)
        is_counted = (truth > 0) & (output.alpha > ALPHA_MIN)
        depth_errors.append((np.abs(depth - truth) / np.where(truth > 0, truth, 1))[is_counted])
        n = central_normals(depth.astype(np.float64), view.camera) @ view.camera.cam_from_world_R
        has_normal = is_counted & (np.abs(n).sum(axis=2) > 0)
        angles.append(kit.angles(n[has_normal], normals[has_normal]))
    return {
        "depth_error": 100 * float(np.median(np.concatenate(depth_errors))),
        "normal_error": float(np.median(np.concatenate(angles))),
        "psnr": evaluate(state.model, made.scene.test_views, settings).psnr,
        "n_gaussians": len(state.gaussians.means),
    }


CLAIMS = (
    declare(
        "losses",
        "what the losses of surfels do to depths, normals and images",
        run,
        *(synthetic_scene(), OUT, iterations(2000), seeds(3)),
    ),
)
