"""Relatives beside what they are built on, from which they differ in the mechanism alone.

The claim is ours, and the way every relative's own should be read: a relative of 2D surfels beside ``surfels``, one of
3D Gaussians beside ``3dgs-accel``, with the same sky, background, exposures, starting points, dates and density control
(:mod:`.kit.alike`). Where its release changes some of these, too, it has a second row, *as released*, with what differs
besides. Arms that would differ in more than the mechanism are refused.

With ``--after RECIPE`` every arm continues from the one model that this recipe trains with the same seed, as
TextureSplat does after Ref-Gaussian; then its base is itself without the mechanism, ``texture-splat+texels=1``.
"""

import argparse
import copy
import functools
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from data_tools.claims import kit
from data_tools.claims.kit.alike import DENSITY_CONTROL, HARMONICS, RATES, adopt, refuse_unlike, unlike_conditions
from data_tools.claims.kit.claim import CONTINUES, NAMES, RESUMED_SCENE, SEEDS, argument, declare, iterations
from data_tools.claims.kit.figures import bars
from data_tools.claims.kit.tables import first, spread, table
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.arguments import name
from minisplat_ref.interface.reporting import describe_machine
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.track_gains import store_gains
from minisplat_ref.training.initial_state import begin_with, initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure_by_name, match_calibrations
from minisplat_ref.training.representation import convert_population
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Model, Scene

OWN: Mapping[str, frozenset[str]] = {
    "discretized-sdf": frozenset({DENSITY_CONTROL}),  # resets distances in place of the opacities that they determine
    "gdgs": frozenset({DENSITY_CONTROL}),  # by regions: the paper's subject
    "cus": frozenset({DENSITY_CONTROL, HARMONICS, RATES}),  # anchors grow, and networks have no harmonics
}
"""Conditions that are part of a relative's mechanism."""
RELEASED = "as released"
COLUMNS = (
    ("differs besides in", first("unlike")),
    ("PSNR (dB)", spread("psnr", 2)),
    ("colours corrected (dB)", spread("corrected", 2)),
    ("SSIM", spread("ssim", 3)),
    ("primitives", spread("n_primitives", 0)),
    ("thousand floats", spread("floats", 0, 1e-3)),
    ("processor seconds", spread("seconds", 0)),
)
BARS = {"corrected": "PSNR of test views, colours corrected (dB)", "ssim": "SSIM of test views"}


class Arm(NamedTuple):
    """A recipe of the comparison."""

    recipe: Recipe
    unlike: tuple[str, ...] = ()
    """Conditions in which it differs from the base, besides the mechanism."""


def arms_of(base_text: str, base: Recipe, relatives: Mapping[str, Recipe]) -> dict[str, Arm]:
    """Return the base, by its text, and of each relative the mechanism alone and, if it differs, the release.

    Raises
    ------
    InputError
        A relative cannot be given the conditions of the base.
    """
    arms = {base_text: Arm(base)}
    for text, relative in relatives.items():
        own = OWN.get(relative.name, frozenset())
        alone = adopt(base, relative, own)
        refuse_unlike(base, alone, own)
        arms[text] = Arm(alone)
        unlike = tuple(condition for condition in unlike_conditions(base, relative) if condition not in own)
        if unlike:
            arms[f"{text}, {RELEASED}"] = Arm(relative, unlike)
    return arms


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure.

    Raises
    ------
    InputError
        A recipe, a setting, the scene or the output folder cannot be used, or arms differ in more than the mechanism.
    """

    def find(text: str) -> Recipe:
        every = "".join(f"+{setting}" for setting in args.settings)
        return configure_by_name(lambda recipe: find_recipe(recipe, args.iterations), text + every)

    arms = arms_of(args.base, find(args.base), {text: find(text) for text in args.relatives})
    before = None if args.after is None else find(args.after)
    scene = store_gains(kit.read_scene(args.scene, args.downscale))
    settings = {"scene": scene.name, "downscale": args.downscale}
    settings |= kit.settings_of(args, "iterations", "base", "after", "settings")
    jobs = kit.jobs_of(arm=arms, seed=args.seeds)

    @functools.cache
    def begun(seed: int) -> Model:
        assert before is not None
        return train(scene, before, seed=seed).model

    def measure(arm: str, seed: int) -> dict[str, Any]:
        recipe = arms[arm].recipe
        state = None if before is None else continued(begun(seed), before, scene, recipe, seed)
        return outcome(scene, recipe, state, seed)

    records = kit.resume(args.out, settings, jobs, measure)
    rows = [{**record, "unlike": ", ".join(arms[record["arm"]].unlike) or "-"} for record in records]
    title = f"{scene.name}, {args.iterations:,} iterations{after(args)}, {kit.seeds_of(args)}; {describe_machine()}"
    text = f"{title}\n\n{table(rows, {'arm': 'arm'}, COLUMNS)}\n\n{describe_differences(rows, list(arms))}"
    return kit.Report(
        {**settings, "records": rows}, bars(rows, BARS, (10, 3)), text, kit.arms_of(rows, "arm", ("psnr",))
    )


def after(args: argparse.Namespace) -> str:
    """Return what the arms continue from, and which settings all have."""
    parts = [] if args.after is None else [f" after as many of {args.after}"]
    return "".join([*parts, *(f", {setting}" for setting in args.settings)])


def outcome(scene: Scene, recipe: Recipe, state: TrainState | None, seed: int) -> dict[str, Any]:
    """Train an arm, from a state or from the scene's points, and return the measures of its test views."""
    start = time.process_time()
    model = train(scene, recipe, seed=seed, state=state).model
    seconds = time.process_time() - start
    renderer = match_calibrations(recipe, model).renderer
    value = evaluate(model, scene.test_views, RenderSettings(scene.background, renderer=renderer))
    return {
        "psnr": value.psnr,
        "corrected": value.psnr_corrected,
        "ssim": value.ssim,
        "n_primitives": len(model.gaussians.means),
        "floats": len(model.gaussians.means) * kit.count_floats(model.gaussians),
        "seconds": seconds,
    }


def continued(model: Model, before: Recipe, scene: Scene, recipe: Recipe, seed: int) -> TrainState:
    """Return the state before the first iteration of a recipe that continues a model, as ``train --init RUN`` does.

    The model stays as it is for other arms, although a training updates its arrays in place.

    Raises
    ------
    InputError
        The recipe does not train such a model.
    """
    rng = np.random.default_rng(seed)
    model = copy.deepcopy(model)
    population = convert_population(model.gaussians, before.representation, recipe.representation, rng)
    if population is None:
        raise InputError(f"recipe {recipe.name} does not train what {before.name} does: give another --after")
    state = initial_state(scene, recipe._replace(starts_densely=False), seed)
    begin_with(state, population, model.shared, rng)
    return state


def describe_differences(rows: list[dict[str, Any]], arms: list[str]) -> str:
    """Say how far each arm is above the base, seed by seed."""
    base, *others = arms
    by_arm: dict[str, dict[int, float]] = {
        arm: {r["seed"]: r["corrected"] for r in rows if r["arm"] == arm} for arm in arms
    }
    lines = []
    for arm in others:
        gains = [by_arm[arm][seed] - value for seed, value in by_arm[base].items() if seed in by_arm[arm]]
        each = ", ".join(f"{gain:+.2f}" for gain in gains)
        lines.append(f"{arm} minus {base}: {np.mean(gains):+.2f} dB after colour correction (by seed: {each})")
    return "\n".join(lines)


CLAIMS = (
    declare(
        "relatives",
        "relatives beside what they are built on, by the mechanism alone",
        run,
        *RESUMED_SCENE,
        iterations(2000),
        argument("--base", type=name, default="surfels", metavar="R", help="what they are built on (default surfels)"),
        argument(
            "--relatives",
            type=NAMES,
            default=("mvg", "reflective", "discretized-sdf"),
            metavar="R,Q",
            help="R+NAME=VALUE changes a setting (default mvg,reflective,discretized-sdf)",
        ),
        argument("--after", type=name, metavar="R", help="train this first, and continue its model in every arm"),
        argument(
            "--settings",
            type=NAMES,
            default=(),
            metavar="N=V,M=W",
            help="of every arm, such as sky=true (default none)",
        ),
        SEEDS,
        description="Train relatives and their base under the same conditions. " + CONTINUES,
    ),
)
