"""What ``adaptive`` removes where masks leave pixels out, and the quality where they do not.

The claim is ours. Photographs of an object by itself have a loss on the object alone, and Gaussians grow around it
unseen (:mod:`minisplat_ref.strategy.mask_weights`). A scene with masks is trained with the rule that removes them and
without it. *Stray light* is the mean opacity of renderings of held-out views where their masks leave pixels out.
"""

import argparse
from typing import Any

import numpy as np

from data_tools.claims import kit
from data_tools.claims.kit.claim import CONTINUES, RESUMED_SCENE, SEEDS, declare
from data_tools.claims.kit.figures import bars
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.errors import InputError
from minisplat_ref.interface.reporting import describe_machine
from minisplat_ref.methods import get_recipe
from minisplat_ref.methods.adaptive.numbers import MASK_SHARE
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.track_gains import store_gains
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure, match_calibrations
from minisplat_ref.types import Model, Scene, View

ARMS = {"removed": MASK_SHARE, "kept": 0.0}
COLUMNS = (
    ("stray light (%)", spread("stray", 2, 100)),
    ("PSNR (dB)", spread("psnr", 2)),
    ("colours corrected (dB)", spread("corrected", 2)),
    ("SSIM", spread("ssim", 3)),
    ("Gaussians", spread("n_gaussians", 0)),
)
BARS = {"stray": "opacity where nothing counts", "corrected": "PSNR where pixels count, colours corrected (dB)"}


def run(args: argparse.Namespace) -> kit.Report:
    """Train with the rule and without it.

    Raises
    ------
    InputError
        The held-out views have no masks.
    """
    scene = store_gains(kit.read_scene(args.scene, args.downscale))
    if any(view.mask is None for view in scene.test_views) or not scene.test_views:
        raise InputError(f"{args.scene}: held-out photographs without masks; this claim is about masks")
    settings = {"scene": scene.name, "downscale": args.downscale}
    jobs = kit.jobs_of(arm=ARMS, seed=args.seeds)
    records = kit.resume(args.out, settings, jobs, lambda arm, seed: outcome(scene, ARMS[arm], seed), lambda _: None)
    title = f"{scene.name}, {kit.seeds_of(args)}; {describe_machine()}"
    text = f"{title}\n\n{table(records, {'arm': 'outside masks'}, COLUMNS)}"
    return kit.Report(
        {**settings, "records": records}, bars(records, BARS, (9, 3.2)), text, kit.arms_of(records, "arm", ("stray",))
    )


def outcome(scene: Scene, share: float, seed: int) -> dict[str, Any]:
    """Train, and return the measures of the held-out views."""
    recipe = configure(get_recipe("adaptive"), min_share_counted=share)
    model = train(scene, recipe, seed=seed).model
    settings = RenderSettings(scene.background, renderer=match_calibrations(recipe, model).renderer)
    value = evaluate(model, scene.test_views, settings)
    return {
        "stray": float(np.mean([stray_light(model, view, settings) for view in scene.test_views])),
        "psnr": value.psnr,
        "corrected": value.psnr_corrected,
        "ssim": value.ssim,
        "n_gaussians": len(model.gaussians.means),
    }


def stray_light(model: Model, view: View, settings: RenderSettings) -> float:
    """Return the mean opacity of a rendering where the mask leaves pixels out."""
    shown = view.load()
    assert shown.mask is not None
    return float(settings.render_view(model, shown)[0].alpha[~shown.mask].mean())


CLAIMS = (
    declare(
        "masks",
        "what masks leave out, and adaptive removes",
        run,
        *RESUMED_SCENE,
        SEEDS,
        description="Train a scene with masks, and measure held-out views where they count and where not. " + CONTINUES,
    ),
)
