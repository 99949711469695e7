"""Claims ``gaustudio/sky``, with and without a background, and ``gaustudio/swaps``, one stage at a time.

The paper is GauStudio, arXiv 2403.19632. Both train each arm with every seed and measure on the test views, within the
masks of the sky and outside of them: PSNR, and the opacity of the scene without its background, which should be 0 in
the sky and 1 elsewhere. Masks are the ray tracer's for a synthetic scene, else those of ``--masks`` or of
``sky_mask=by_color``. Two pixels along their edges are left out, because a pixel of an edge shows both.
"""

import argparse
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_erosion

from data_tools.claims import kit
from data_tools.claims.kit.claim import NAMES, RESUMED_OUT, SCENE, SEEDS, argument, declare, downscale, iterations
from data_tools.claims.kit.figures import bars
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.datasets.synthetic import SCENE_NAMES, make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.gaustudio.alternatives import by_color, from_files
from minisplat_ref.extensions.gaustudio.commands import all_stages
from minisplat_ref.extensions.gaustudio.model import sky_opacity
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.recipe_settings import configure, parse_settings
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import Bools, Floats, Scene, View

WIDTH, HEIGHT = 256, 192  # of a synthetic scene
EDGE = 2  # pixels
SQUARE_MIN = 1e-20  # an error of 200 dB
WITHOUT = "without"
SKY_ARMS: dict[str, dict[str, str]] = {
    WITHOUT: {"background": "nothing", "sky_opacity": "0"},
    "loss": {"background": "nothing"},
    "ball": {"sky_opacity": "0"},
    "ball+loss": {},
    "harmonics+loss": {"background": "harmonics"},
    "map+loss": {"background": "sky_map"},
}
"""Settings by arm, as ``train --set`` takes them."""
PUBLISHED = "as it is"
SWAPPED = ("initialiser", "representation", "background", "photo_loss", "density")
COLUMNS = (
    ("mean opacity in the sky", spread("opacity", 3)),
    ("largest", spread("opacity_max", 2)),
    ("mean elsewhere", spread("opacity_scene", 3)),
    ("PSNR (dB)", spread("psnr", 2)),
    ("in the sky", spread("psnr_sky", 2)),
    ("elsewhere", spread("psnr_scene", 2)),
    ("Gaussians", spread("n_gaussians", 0)),
)
BARS = {"opacity": "Mean opacity of the scene in the sky", "psnr": "PSNR of test views (dB)"}
"""Columns, with their digits."""


class Subject(NamedTuple):
    """A scene, and where its photographs show the sky."""

    scene: Scene
    is_sky: Mapping[str, Bools]
    """[H, W] by the name of the view."""


def run_sky(args: argparse.Namespace) -> kit.Report:
    """Compare backgrounds, with the loss on the sky and without."""
    unknown = [arm for arm in args.arms if arm not in SKY_ARMS]
    if unknown:
        raise InputError(f"--arms {unknown[0]} is unknown: choose from {', '.join(SKY_ARMS)}")
    return _report(args, {arm: SKY_ARMS[arm] for arm in args.arms})


def run_swaps(args: argparse.Namespace) -> kit.Report:
    """Exchange one stage at a time."""
    unknown = [stage for stage in args.stages if stage not in SWAPPED]
    if unknown:
        raise InputError(f"--stages {unknown[0]} is unknown: choose from {', '.join(SWAPPED)}")
    return _report(args, swaps(args.stages))


def swaps(stages: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the settings of the recipe as it is, and with each other module of each of these stages."""
    others = {
        f"{stage.name}={name}": {stage.name: name}
        for stage in all_stages()
        for name in stage.modules
        if stage.name in stages and name != stage.present
    }
    return {PUBLISHED: {}, **others}


def _report(args: argparse.Namespace, arms: Mapping[str, dict[str, str]]) -> kit.Report:
    subject = read_subject(args.scene, args.downscale, args.masks)
    settings = {
        **kit.describe_scene(subject.scene),
        **kit.settings_of(args, "iterations"),
        "masks": args.masks,
        "sky_share": float(np.mean([subject.is_sky[view.name].mean() for view in subject.scene.test_views])),
    }
    jobs = kit.jobs_of(seed=args.seeds, arm=arms)
    records = kit.resume(args.out, settings, jobs, lambda seed, arm: outcome(subject, arms[arm], args.iterations, seed))
    text = f"{kit.title(settings)}; {args.iterations} iterations; {kit.seeds_of(args)}\n\n"
    text += table(records, {"arm": "arm"}, COLUMNS)
    result = {**settings, "seeds": list(args.seeds), "arms": arms, "records": records}
    figure = bars(records, BARS, (9, 1 + 0.35 * len(arms)))
    return kit.Report(result, figure, text, kit.arms_of(records, "arm", ("opacity", "psnr", "n_gaussians")))


def read_subject(source: str, downscale: int, masks: str | None) -> Subject:
    """Read a scene and its masks.

    Raises
    ------
    InputError
        There is no such scene, it has no test views, or a mask is missing.
    """
    if source in SCENE_NAMES and not Path(source).exists():
        made = make_scene(source, width=WIDTH, height=HEIGHT)
        views = (*made.scene.train_views, *made.scene.test_views)
        depths = (*made.train_depths, *made.test_depths)
        return Subject(made.scene, {view.name: depth == 0 for view, depth in zip(views, depths, strict=True)})
    scene = kit.read_scene(source, downscale)
    views = tuple(view.load() for view in (*scene.train_views, *scene.test_views))
    choose = by_color if masks is None else from_files
    found = {view.name: choose(view, masks or "") for view in views}
    return Subject(scene, {name: is_sky for name, is_sky in found.items() if is_sky is not None})


def recipe_for(subject: Subject, settings: Mapping[str, str], iterations: int) -> Recipe:
    """Return the recipe with an arm's settings, whose loss knows the sky of the subject."""
    recipe = find_recipe("gaustudio", iterations)
    recipe = configure(recipe, **parse_settings(recipe, settings))

    def known(view: View, mask_folder: str) -> Bools:
        return subject.is_sky[view.name]

    function: Callable[..., Any] = partial(sky_opacity, sky_mask=known, mask_folder="")
    losses = [term._replace(function=function) if term.name == "sky_opacity" else term for term in recipe.losses]
    return recipe._replace(losses=tuple(losses))


def outcome(subject: Subject, settings: Mapping[str, str], iterations: int, seed: int) -> dict[str, Any]:
    """Train, and return what the test views show."""
    recipe = recipe_for(subject, settings, iterations)
    state = kit.train_with_progress(subject.scene, recipe, seed)
    shown = RenderSettings(subject.scene.background, renderer=recipe.renderer)
    opacities, scene_opacities, errors, sky_errors, scene_errors = [], [], [], [], []
    for stored in subject.scene.test_views:
        view = stored.load()
        output, _ = shown.render_view(state.model, view)
        squares = np.mean((np.clip(output.image[..., :3], 0, 1) - view.image / 255.0) ** 2, axis=2)
        is_sky = subject.is_sky[view.name]
        inside, outside = (binary_erosion(mask, iterations=EDGE, border_value=1) for mask in (is_sky, ~is_sky))
        opacities.append(output.alpha[inside])
        scene_opacities.append(output.alpha[outside])
        errors.append(psnr_of(squares))
        sky_errors.append(squares[inside])
        scene_errors.append(squares[outside])
    opacity, scene_opacity = np.concatenate(opacities), np.concatenate(scene_opacities)
    return {
        "opacity": float(opacity.mean()) if opacity.size else None,
        "opacity_max": float(opacity.max()) if opacity.size else None,
        "opacity_scene": float(scene_opacity.mean()) if scene_opacity.size else None,
        "psnr": float(np.mean([error for error in errors if error is not None])),
        "psnr_sky": psnr_of(np.concatenate(sky_errors)),
        "psnr_scene": psnr_of(np.concatenate(scene_errors)),
        "n_gaussians": len(state.gaussians.means),
    }


def psnr_of(squares: Floats) -> float | None:
    """Return the PSNR of squared errors, dB; None where there are no pixels."""
    return float(-10 * np.log10(max(float(np.mean(squares)), SQUARE_MIN))) if squares.size else None


_MASKS = argument("--masks", metavar="DIR", help="masks of the sky, NAME.png each (default: by colour)")
_COMMON = (SCENE, RESUMED_OUT, downscale(), iterations(2000), SEEDS, _MASKS)


CLAIMS = (
    declare(
        "sky",
        "opacity in the sky with backgrounds and a loss, and without",
        run_sky,
        *_COMMON,
        argument(
            "--arms",
            type=NAMES,
            default=("without", "ball", "ball+loss", "harmonics+loss", "map+loss"),
            metavar="A,B",
            help="of without, loss, ball, ball+loss, harmonics+loss, map+loss (default: all but loss)",
        ),
    ),
    declare(
        "swaps",
        "exchange one stage at a time",
        run_swaps,
        *_COMMON,
        argument(
            "--stages",
            type=NAMES,
            default=("initialiser", "representation", "background", "photo_loss", "density"),
            metavar="S,T",
            help="which stages (default: all of initialiser, representation, background, photo_loss, density)",
        ),
    ),
)
