"""Claim ``omg/networks`` (arXiv 2503.16924): what networks and codes cost, beside the same training without them.

Three arms prune by the same rule. One trains opacities and colours to the end as 3DGS does, one has networks compute
them from features, and the recipe ``omg`` has codebooks as well.
"""

import argparse
from typing import Any

from data_tools.claims import kit
from data_tools.claims.kit.figures import bars
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.omg.recipe import OMG, round_centres, start_codes, start_networks, write_fields
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import Recipe, does
from minisplat_ref.types import Scene

CODES = (start_codes, round_centres)
WITHOUT = {
    "neither": (start_networks, write_fields, *CODES),
    "networks": CODES,
    "networks and codes": (),
}
"""The actions that each arm leaves out."""
COLUMNS = (
    ("Gaussians", spread("n_gaussians", 0)),
    ("PSNR (dB)", spread("psnr", 2)),
    ("SSIM", spread("ssim", 3)),
)
BARS = {"psnr": "PSNR (dB)", "ssim": "SSIM"}


def arms(iterations: int) -> dict[str, Recipe]:
    """Return the recipes by arm."""
    recipe = find_recipe(OMG.name, iterations)
    return {
        arm: recipe._replace(events=tuple(event for event in recipe.events if not does(event, *actions)))
        for arm, actions in WITHOUT.items()
    }


def run(args: argparse.Namespace) -> kit.Report:
    """Train all arms with every seed."""
    scene = kit.read_scene(args.scene, args.downscale)
    settings = {**kit.describe_scene(scene), **kit.settings_of(args, "iterations")}
    recipes = arms(args.iterations)

    def measure(arm: str, seed: int) -> dict[str, Any]:
        return outcome(scene, recipes[arm], seed)

    records = kit.resume(args.out, settings, kit.jobs_of(arm=recipes, seed=args.seeds), measure)
    text = f"{kit.title(settings)}; {kit.seeds_of(args)}\n\n{table(records, {'arm': 'with'}, COLUMNS)}"
    result = {**settings, "seeds": list(args.seeds), "records": records}
    return kit.Report(result, bars(records, BARS, (8, 3)), text, kit.arms_of(records, "arm", ("psnr",)))


def outcome(scene: Scene, recipe: Recipe, seed: int) -> dict[str, Any]:
    """Train an arm, and return the measures of its test views."""
    model = train(scene, recipe, seed=seed).model
    value = evaluate(model, scene.test_views, RenderSettings(scene.background, renderer=recipe.renderer))
    return {"n_gaussians": len(model.gaussians.means), "psnr": value.psnr, "ssim": value.ssim}
