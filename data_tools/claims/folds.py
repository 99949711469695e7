"""Cross-validation: each photograph of a scene is held out once, and recipes are compared photograph by photograph.

The photographs, sorted by name, fall into K folds: fold k holds out every K-th, beginning with the k-th. A held-out
photograph is treated as if it had not been taken, except that its camera is known: sparse points that fewer than two of
the other photographs have found are left out. Each photograph is measured as rendered; with the exposure that its own
tracks show, of points that the others have found; and after the best affine map of its colours. The last also in the
pixels that at least two training photographs show (:mod:`.kit.coverage`), because the others are guessed.

Several scenes may be given. Then the first recipe is also compared, fold by fold, with the best other one of the scene,
and a recipe is chosen as one must: on the other scenes, to be reported on the one left out. The claim is ours;
``minisplat-ref compare --folds`` is the command for one scene.
"""

import argparse
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.adaptive import ITERATIONS, warm_up
from data_tools.claims.kit.claim import CONTINUES, LONG_SIDE, NAMES, RESUMED_OUT, SEEDS, argument, declare, folds
from data_tools.claims.kit.coverage import count_covering_views
from data_tools.claims.kit.figures import standard_error, subplots
from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.extensions.extension import find_recipe, load_extensions
from minisplat_ref.interface.palette import SERIES
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.io.scene import camera_extent
from minisplat_ref.methods.adaptive.numbers import TRAIN_VIEWS_MIN
from minisplat_ref.metrics import ViewMetrics, correct_colors, evaluate, psnr
from minisplat_ref.rendering import SPLATTING, RenderSettings
from minisplat_ref.strategy.line_of_sight import hidden_share
from minisplat_ref.strategy.track_gains import store_gains
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure_by_name, match_calibrations, settings_of
from minisplat_ref.training.representation import GAUSSIANS
from minisplat_ref.training.schedule import Recipe, scale_recipe
from minisplat_ref.training.state import StepReport
from minisplat_ref.types import Bools, Floats, Gaussians, Ints, Scene, View, number_views

KNOWN = 2  # training photographs that must show a pixel's surface
N_MOMENTS = 12  # evaluations of a training of ITERATIONS iterations
THINNED = 10  # photographs of a thinned scene, about


class Fold(NamedTuple):
    """A scene with some photographs held out."""

    scene: Scene
    coverage: tuple[Ints | None, ...]
    """Of each test view, [H, W] training views that show a pixel's surface; None where that is not known."""


def all_photographs(scene: Scene, thin: bool) -> list[View]:
    """Return the photographs of a scene by name; of a thinned scene every n-th, so that about ten remain."""
    views = sorted((*scene.train_views, *scene.test_views), key=lambda view: view.name)
    return views[:: max(2, round(len(views) / THINNED))] if thin else views


def make_fold(scene: Scene, views: Sequence[View], n_folds: int, fold: int) -> Fold:
    """Return fold ``fold`` of ``n_folds`` of the photographs of a scene.

    Raises
    ------
    InputError
        Too few photographs remain.
    """
    held_out = views[fold::n_folds]
    train_views = number_views(view for i, view in enumerate(views) if i % n_folds != fold)
    if len(train_views) < TRAIN_VIEWS_MIN or not held_out:
        raise InputError(
            f"scene {scene.name}: {len(views)} photographs in {n_folds} folds leave {len(train_views)} to train on and"
            f" {len(held_out)} to measure; give another --folds, or more photographs"
        )
    coverage = tuple(count_covering_views(view, train_views, scene.points) for view in held_out)
    rows = known_points(train_views, len(scene.points))
    new_rows = np.cumsum(rows) - 1

    def with_rows(view: View) -> View:
        ids = view.point_ids
        return view if ids is None else view._replace(point_ids=new_rows[ids[rows[ids]]])

    fold_scene = scene._replace(
        train_views=tuple(map(with_rows, train_views)),
        test_views=tuple(with_rows(view)._replace(view_id=-1) for view in held_out),
        points=scene.points[rows],
        point_colors=scene.point_colors[rows],
        extent=camera_extent([view.camera for view in train_views]),
    )
    return Fold(fold_scene, coverage)


def known_points(train_views: Sequence[View], n_points: int) -> Bools:
    """Return which sparse points [P] two training photographs have found; all of a scene that has no tracks."""
    if any(view.point_ids is None for view in train_views):
        return np.ones(n_points, bool)
    counts = np.zeros(n_points, int)
    for view in train_views:
        counts[view.point_ids] += 1
    return counts >= 2


def recipe_of(text: str) -> Recipe:
    """Return a recipe by its name, with settings if there are: ``adaptive+min_slope=0.5``, ``mcmc+budget=20000``.

    Recipes with a schedule have 3,000 iterations. A setting that the recipe lacks may be a loss term of an extension
    for any recipe, with which it is then trained: ``adaptive+sfm_depth=0.1``.
    """
    names = [setting.partition("=")[0] for setting in text.split("+")[1:]]

    def find(name: str) -> Recipe:
        recipe = find_recipe(name)
        lacking = [setting for setting in names if setting not in settings_of(recipe)]
        if lacking and (extension := _extension_of_term(lacking[0])) is not None:
            recipe = find_recipe(name, extension=extension)
        return recipe if recipe.cooling is not None else scale_recipe(recipe, ITERATIONS)

    return configure_by_name(find, text)


def _extension_of_term(name: str) -> str | None:
    """Return the extension that offers a loss term to any recipe; None if there is none."""
    extensions = (e for e in load_extensions() if e.representation == GAUSSIANS)
    return next((e.name for e in extensions if any(term.name == name for term in e.losses)), None)


def measure(fold: Fold, recipe: Recipe, seed: int) -> dict[str, Any]:
    """Train on a fold, and measure its held-out photographs at the end and, roughly, on the way."""
    scene, curve = store_gains(fold.scene), []
    paused, every = 0.0, ITERATIONS // N_MOMENTS
    start = time.process_time()

    def evaluate_now(state: Any, on_view: Any = None) -> Any:
        renderer = match_calibrations(recipe, state.model).renderer
        return evaluate(
            state.model, scene.test_views, RenderSettings(scene.background, renderer=renderer), on_view=on_view
        )

    def on_step(report: StepReport) -> None:
        nonlocal paused
        if report.step % every and report.step != report.last_step:
            return
        now = time.process_time()
        value = evaluate_now(report.state)
        n = len(report.state.gaussians.means)
        curve.append([report.step, now - start - paused, value.psnr_corrected, n])
        paused += time.process_time() - now

    state = train(scene, recipe, seed=seed, on_step=on_step)
    photographs: list[dict[str, Any]] = []
    coverage = iter(fold.coverage)

    def on_view(view: View, image: Floats, metrics: ViewMetrics) -> None:
        photographs.append(describe_photograph(view, image, metrics, next(coverage)))

    evaluate_now(state, on_view)
    is_plain = (recipe.representation.population, recipe.representation.renderer) == (Gaussians, SPLATTING)
    hidden = [
        hidden_share(state.model, views, scene.points, RenderSettings(scene.background)) if is_plain else None
        for views in (scene.train_views, scene.test_views)
    ]
    return {
        "photographs": photographs,
        "curve": curve,
        "n_gaussians": len(state.gaussians.means),
        "hidden_train": hidden[0],
        "hidden_test": hidden[1],
        "switched_on": list(state.pace.switched_on),
        "decisions": [decision._asdict() for decision in state.pace.decisions],
    }


def describe_photograph(view: View, image: Floats, metrics: ViewMetrics, coverage: Ints | None) -> dict[str, Any]:
    """Return the measures of a held-out photograph; those of known pixels are None where coverage is."""
    record: dict[str, Any] = {
        "name": view.name,
        "psnr": metrics.psnr,
        "exposed": metrics.psnr_exposed,
        "corrected": metrics.psnr_corrected,
        "ssim": metrics.ssim,
        "known": None,
        "share_known": None,
    }
    if coverage is None:
        return record
    counted = np.ones(coverage.shape, bool) if view.mask is None else view.mask
    known = counted & (coverage >= KNOWN)
    record["share_known"] = float(known.sum() / counted.sum())
    if known.any():
        record["known"] = psnr(correct_colors(image, view.image, known), view.image, known)
    return record


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure.

    Raises
    ------
    InputError
        A scene, a recipe or the output folder cannot be used, or a scene has too few photographs.
    """
    recipes = {text: recipe_of(text) for text in args.recipes}
    scenes = {}
    for source in args.scenes:
        for thin in {"whole": (False,), "thinned": (True,), "both": (False, True)}[args.photographs]:
            scene = read_small(source, args.long_side)
            name = f"{scene.name}, thinned" if thin else scene.name
            views = all_photographs(scene, thin)
            if len(views) - -(-len(views) // args.folds) < TRAIN_VIEWS_MIN:
                message = f"{name} is left out: {len(views)} photographs are too few for {args.folds} folds"
                warnings.warn(one_line(message), InputWarning, stacklevel=2)
                continue
            scenes[name] = scene, views
    if not scenes:
        raise InputError(f"no scene has the photographs for {args.folds} folds; give another --folds")
    jobs = kit.jobs_of(scene=scenes, fold=range(args.folds), seed=args.seeds, recipe=recipes)
    settings = {"folds": args.folds, "long_side": args.long_side}
    first = next(iter(scenes.values()))
    records = kit.resume(
        args.out,
        settings,
        jobs,
        lambda scene, fold, seed, recipe: measure(make_fold(*scenes[scene], args.folds, fold), recipes[recipe], seed),
        lambda missing: warm_up(first[0], recipes.values() if missing else ()),
    )
    measures = [{**r, "psnr": [photograph["psnr"] for photograph in r["photographs"]]} for r in records]
    names, alike = kit.leave_out_idle(kit.arms_of(measures, "recipe", ("psnr", "n_gaussians")))
    measured, records = records, [r for r in records if r["recipe"] in names]
    recipes = {text: recipe for text, recipe in recipes.items() if text in names}
    rows = [summarise(records, scene, recipe) for scene in scenes for recipe in recipes]
    description = describe_machine()
    result = {**settings, "machine": description, "seeds": list(args.seeds), "summary": rows, "runs": measured}
    text = f"{args.folds} folds, long side at most {args.long_side} pixels, {kit.seeds_of(args)}; {description}\n\n"
    text += to_table(rows) + alike
    if len(recipes) > 1:
        text += "\n\n" + describe_differences(records, list(recipes))
        text += "\n\n" + leave_one_scene_out(records, list(recipes))
    return kit.Report(result, draw(records, list(recipes)), text)


def read_small(source: str, long_side: int) -> Scene:
    """Return a scene whose photographs are made smaller by a whole factor until no side exceeds ``long_side``."""
    scene = kit.read_scene(source, is_tested=False)
    camera = scene.train_views[0].camera
    factor = math.ceil(max(camera.width, camera.height) / long_side)
    return scene if factor == 1 else kit.read_scene(source, factor, is_tested=False)


def summarise(records: Sequence[Mapping[str, Any]], scene: str, recipe: str) -> dict[str, Any]:
    """Return the row of a recipe on a scene: over photographs, each once for every seed."""
    own = [record for record in records if (record["scene"], record["recipe"]) == (scene, recipe)]
    photographs = [photograph for record in own for photograph in record["photographs"]]
    row: dict[str, Any] = {"scene": scene, "recipe": recipe, "n": len(photographs)}
    for key in ("psnr", "exposed", "corrected", "known", "ssim", "share_known"):
        values = [p[key] for p in photographs if p[key] is not None]
        row |= {key: float(np.median(values)), f"{key}_worst": min(values)} if values else {key: None}
    row["mean"] = float(np.mean([p["corrected"] for p in photographs]))
    row["standard_error"] = standard_error([p["corrected"] for p in photographs])
    row["fall"] = float(np.mean([max(point[2] for point in r["curve"]) - r["curve"][-1][2] for r in own]))
    for key in ("n_gaussians", "hidden_test", "hidden_train"):
        values = [record[key] for record in own if record[key] is not None]
        row[key] = float(np.mean(values)) if values else None
    row["seconds"] = float(np.mean([record["curve"][-1][1] for record in own]))
    return row


def to_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows in Markdown."""
    heading = [
        "scene",
        "recipe",
        "n",
        "median",
        "worst",
        "own exposure: median",
        "corrected: median",
        "worst",
        "mean",
        "known pixels",
        "SSIM",
    ]
    heading += ["known", "below its best", "hidden", "Gaussians", "seconds"]
    return markdown_table(heading, [_cells(row) for row in rows])


def _cells(row: Mapping[str, Any]) -> list[str]:
    error = "" if row["standard_error"] is None else f" ± {row['standard_error']:.2f}"

    def form(value: float | None, text: str) -> str:
        return "-" if value is None else format(value, text)

    return [
        row["scene"],
        row["recipe"],
        str(row["n"]),
        form(row["psnr"], ".2f"),
        form(row["psnr_worst"], ".2f"),
        form(row["exposed"], ".2f"),
        form(row["corrected"], ".2f"),
        form(row["corrected_worst"], ".2f"),
        f"{row['mean']:.2f}{error}",
        form(row["known"], ".2f"),
        form(row["ssim"], ".3f"),
        form(row["share_known"], ".0%"),
        f"{row['fall']:.2f}",
        form(row["hidden_test"], ".1%"),
        f"{row['n_gaussians']:,.0f}",
        f"{row['seconds']:.0f}",
    ]


def fold_means(records: Sequence[Mapping[str, Any]], key: str = "corrected") -> dict[tuple[str, int], dict[str, float]]:
    """Return for each fold of each scene the mean of a measure over photographs and seeds, by recipe."""
    values: dict[tuple[str, int], dict[str, list[float]]] = {}
    for record in records:
        of_fold = values.setdefault((record["scene"], record["fold"]), {})
        of_fold.setdefault(record["recipe"], []).extend(p[key] for p in record["photographs"])
    return {fold: {name: float(np.mean(found)) for name, found in of.items()} for fold, of in values.items()}


def describe_differences(records: Sequence[Mapping[str, Any]], recipes: Sequence[str]) -> str:
    """Say how far the first recipe is above each other one, and above the best of them in each scene, fold by fold."""
    first, *others = recipes
    lines = []
    for key, unit, digits in (("corrected", "dB", 2), ("ssim", "of SSIM", 3)):
        means = fold_means(records, key)
        scenes = {scene for scene, _ in means}
        best = {
            scene: max(others, key=lambda o: np.mean([of[o] for (s, _), of in means.items() if s == scene]))
            for scene in scenes
        }
        for name, rival in [*((o, lambda _, o=o: o) for o in others), ("the best other recipe of the scene", best.get)]:
            found = {fold: of[first] - of[rival(fold[0])] for fold, of in means.items()}
            worst = min(found, key=lambda fold: found[fold])
            lines.append(
                f"{first} minus {name}: median {np.median(list(found.values())):+.{digits}f} {unit}, worst"
                f" {found[worst]:+.{digits}f} ({worst[0]}, fold {worst[1]}), over {len(found)} folds"
            )
    return "\n".join(lines)


def leave_one_scene_out(records: Sequence[Mapping[str, Any]], recipes: Sequence[str]) -> str:
    """Say what the recipe that is best on all other scenes does on each scene."""
    means = fold_means(records)
    whole = {scene.removesuffix(", thinned") for scene, _ in means}
    rows = []
    for left_out in sorted(whole):
        is_own = {fold: fold[0].removesuffix(", thinned") == left_out for fold in means}
        of_others = [of for fold, of in means.items() if not is_own[fold]]
        if not of_others:
            return "one scene alone: nothing to choose a recipe on"
        chosen = max(recipes, key=lambda name: np.mean([of[name] for of in of_others]))
        own = [of for fold, of in means.items() if is_own[fold]]
        gain = float(np.mean([of[chosen] - of[recipes[0]] for of in own]))
        rows.append([left_out, chosen, f"{gain:+.2f}"])
    return markdown_table(["left out", "best on the others", f"there, minus {recipes[0]} (dB)"], rows)


def draw(records: Sequence[Mapping[str, Any]], recipes: Sequence[str]) -> Figure:
    """Draw the colour-corrected PSNR of each photograph, a row for each scene, its medians as lines."""
    scenes = list(dict.fromkeys(record["scene"] for record in records))
    figure, axes = subplots((7.5, 1.0 + 0.55 * len(scenes)))
    for k, recipe in enumerate(recipes):
        color = SERIES[k % len(SERIES)]
        for row, scene in enumerate(scenes):
            own = [r for r in records if (r["scene"], r["recipe"]) == (scene, recipe)]
            values = [p["corrected"] for r in own for p in r["photographs"]]
            y = row + 0.7 * ((k + 0.5) / len(recipes) - 0.5)
            axes.plot(values, np.full(len(values), y), ".", color=color, markersize=3, alpha=0.6)
            axes.plot(np.median(values), y, "|", color=color, markersize=9, label=recipe if row == 0 else None)
    axes.set(yticks=range(len(scenes)), xlabel="PSNR of each held-out photograph after colour correction (dB)")
    axes.set_yticklabels(scenes)
    axes.invert_yaxis()
    axes.legend()
    return figure


CLAIMS = (
    declare(
        "folds",
        "recipes photograph by photograph: each is held out once",
        run,
        argument("scenes", nargs="+", metavar="SCENE", help="folders of scenes, or synthetic ones"),
        RESUMED_OUT,
        folds(4),
        argument(
            "--recipes",
            type=NAMES,
            default=("adaptive", "3dgs-accel", "mini-splatting", "mini-splatting2"),
            metavar="R,Q",
            help="the first is compared with the others; R+NAME=VALUE changes a setting (default: adaptive, and three"
            " of 3000 iterations)",
        ),
        argument(
            "--photographs",
            choices=("whole", "thinned", "both"),
            default="whole",
            metavar="P",
            help="whole: all photographs (default); thinned: about ten; both",
        ),
        LONG_SIDE,
        SEEDS,
        description="Hold out each photograph once, train recipes on the others, and measure. " + CONTINUES,
    ),
)
