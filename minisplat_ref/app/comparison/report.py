"""The ``report.html`` of a comparison, and the sentences that its table needs."""

import os
from collections.abc import Sequence

from minisplat_ref import __version__
from minisplat_ref.app.comparison.crops import Crop
from minisplat_ref.app.comparison.figures import (
    chamfer_over_iterations,
    is_chamfer_known,
    psnr_over_count,
    psnr_over_iterations,
    psnr_over_time,
)
from minisplat_ref.app.comparison.metrics import METRICS, RecipeMetrics
from minisplat_ref.app.comparison.plan import Plan
from minisplat_ref.app.comparison.results import Results
from minisplat_ref.app.comparison.table import photograph_cells, table_cells
from minisplat_ref.app.reports.page import (
    cards,
    curves,
    folded,
    grid,
    make_list,
    page,
    panel,
    paragraph,
    section,
    slider,
    table,
)
from minisplat_ref.app.reports.plots import to_svg
from minisplat_ref.app.runs.recipe_actions import Fired
from minisplat_ref.app.runs.report_parts import fired_tables
from minisplat_ref.datasets.synthetic.surface import NEAR, OPACITY_MIN
from minisplat_ref.types import Scene

CURVES_TEXT = """\
A line per training; up and to the left is better. A star is the best that a training has reached: where the held-out
views get worse after it, the training fits its own views alone. Over the number of Gaussians, the thin line is the way
that a training took, and the disc its end."""

FIRED_TEXT = """\
What the recipes do besides gradient steps, in these runs: how often, in how many steps as published, when, and by how
many Gaussians their number rose or fell, each time counted by itself. A short run leaves out much of a schedule. What
never acted here, or acted late, is not what this comparison measures."""


def notes(plan: Plan, results: Results) -> list[str]:
    """Return the notes for a reader of the table."""
    first = plan.recipes[0]
    seeds = ", ".join(map(str, plan.seeds))
    values = f"Mean and standard deviation of seeds {seeds}" if len(plan.seeds) > 1 else f"Seed {seeds}"
    if plan.folds is not None:
        values = f"Otherwise: mean and standard deviation of {plan.folds} folds, {_seeds_in_words(plan)}"
    steps = ", ".join(f"{n}" for n in dict.fromkeys(run.eval_every for run in plan.runs))
    sentences = [
        f"{values}; in brackets the ratio to {first}, or the difference from it.",
        f"Test views were measured every {steps} iterations, with the clock stopped. Until {first}'s final PSNR: the"
        " first time that at least this was measured. The best on the way is chosen by the test views themselves,"
        " which flatters it a little.",
        "Model, gradients and moments: their arrays, at most; while densifying is until cloning and splitting ends,"
        " which is when Mini-Splatting simplifies.",
        "Peak memory of the process: photographs, compiler and measuring included, LPIPS not.",
        "Rendering: all models in one process, interleaved, the median of several rounds.",
    ]
    if plan.folds is not None:
        sentences.insert(0, _describe_folds(plan, results.recipes[0]))
    elif len(plan.seeds) > 1:
        sentences.insert(
            1,
            "After a difference stands its standard error: the deviation of the differences between runs of one seed,"
            f" over the root of {len(plan.seeds)}.",
        )
    if is_chamfer_known(results.curves):
        sentences.append(
            "Chamfer distance: mean distance of the Gaussians' centres to the nearest point that the training views"
            f" truly show, and of these points to the nearest centre, added; centres of opacity {OPACITY_MIN} and"
            f" more, within {NEAR:g} extents of the cameras; right after an opacity reset there are none."
        )
    if results.lpips_network is None:
        return [*sentences, f"LPIPS null: {results.lpips_reason}."]
    return [*sentences, f"LPIPS by {results.lpips_network}, colours from -1 to 1; 0 is equal."]


def _seeds_in_words(plan: Plan) -> str:
    return f"seed{'s'[: len(plan.seeds) > 1]} {', '.join(map(str, plan.seeds))}"


def _describe_folds(plan: Plan, first: RecipeMetrics) -> str:
    of_seeds = ", each the mean of its seeds" if len(plan.seeds) > 1 else ""
    return (
        f"PSNR, SSIM and LPIPS: each of the {len(first.photographs)} photographs was held out once, from one of"
        f" {plan.folds} trainings. Mean of the photographs{of_seeds}, and its standard error; in brackets the"
        f" difference from {first.recipe}, photograph by photograph, and the standard error of its mean. These errors"
        " take the photographs for independent, while those of a fold share a training."
    )


def report_html(plan: Plan, scene: Scene, results: Results) -> str:
    """Return the page as text of one self-contained HTML file."""
    n_train, n_test = len(scene.train_views), len(scene.test_views)
    introduction = (
        f"The same {n_train} photographs, trained in {len(plan.recipes)} ways on the CPU,"
        f" and measured on {n_test} more that no training saw."
        if plan.folds is None
        else f"{n_train + n_test} photographs in {plan.folds} folds, trained in {len(plan.recipes)} ways on the CPU:"
        " each photograph is measured where it was held out."
    )
    heading, *cells = table_cells(results.recipes)
    sections = [
        cards(map(_card, results.recipes)),
        section("Measures", table(cells, heading), make_list(notes(plan, results))),
        *_photographs(plan, results),
        section("On the way", paragraph(CURVES_TEXT), _curves(results)),
        section("What fired, and when", paragraph(FIRED_TEXT), *(_fired_table(fired) for fired in results.fired)),
        section(
            "Parts of held-out views",
            paragraph(
                "Half of them are where the recipes differ most, the others where there is most detail;"
                f" seed {plan.seeds[0]}{'' if plan.folds is None else ', fold 0'}."
            ),
            grid([_crop_panel(crop, plan.recipes) for crop in results.crops], is_smooth=False),
        ),
        section("What was run", table(_settings(plan, scene, results))),
    ]
    return page(f"{_enumerate(plan.recipes)} on {scene.name}", introduction, sections)


def _photographs(plan: Plan, results: Results) -> list[str]:
    if plan.folds is None:
        return []
    heading, *cells = photograph_cells(results.recipes)
    return [folded("Photograph by photograph", table(cells, heading))]


def _card(recipe: RecipeMetrics) -> tuple[str, str]:
    psnr, count, seconds, rate = (
        "null" if value is None else f"{value:{metric.format}}"
        for metric, value in ((m, recipe.compute_spread(m).mean) for m in METRICS)
        if metric.key in ("psnr", "n_gaussians", "train_seconds", "render_fps")
    )
    return f"{psnr} dB", f"{recipe.recipe}: {count} Gaussians, trained in {seconds} s, {rate} views/s"


def _curves(results: Results) -> str:
    figures = [psnr_over_time(results.curves), psnr_over_iterations(results.curves), psnr_over_count(results.curves)]
    if is_chamfer_known(results.curves):
        figures.append(chamfer_over_iterations(results.curves))
    return curves([to_svg(figure) for figure in figures], n_columns=2)


def _fired_table(fired: Fired) -> str:
    return "\n".join([paragraph(fired_title(fired)), *fired_tables(fired)])


def fired_title(fired: Fired) -> str:
    """Return the line over the table of a recipe's mechanisms."""
    return f"{fired.recipe}: {fired.iterations:,} iterations, published for {fired.published_iterations:,}"


def _crop_panel(crop: Crop, recipes: Sequence[str]) -> str:
    renders = dict(zip(recipes, crop.renders, strict=True))
    return panel(f"{crop.view}: {crop.reason}", [slider(crop.truth, renders)], n_columns=1)


def _settings(plan: Plan, scene: Scene, results: Results) -> list[tuple[str, str]]:
    camera = scene.test_views[0].camera
    lengths = zip(plan.recipes, plan.iterations, strict=True)
    return [
        (
            "Scene",
            f"{scene.name}: {_describe_views(plan, scene)} of {camera.width} x {camera.height} pixels,"
            f" {len(scene.points):,} points",
        ),
        ("Iterations", ", ".join(f"{recipe} {iterations:,}" for recipe, iterations in lengths)),
        ("Seeds", ", ".join(map(str, plan.seeds))),
        *((name.replace("_", " ").capitalize(), str(value)) for name, value in plan.options.items()),
        *([] if plan.init is None else [("Starts from", str(plan.init.resolve()))]),
        ("Machine", f"{results.machine}, {os.cpu_count()} cores"),
        ("Program", f"minisplat_ref {__version__}"),
        ("Files", f"{plan.folder.resolve()}: a folder per run, compare.json, table.csv, table.tex, the figures as PNG"),
    ]


def _describe_views(plan: Plan, scene: Scene) -> str:
    n_train, n_test = len(scene.train_views), len(scene.test_views)
    if plan.folds is None:
        return f"{n_train} training and {n_test} test views"
    return f"{n_train + n_test} photographs in {plan.folds} folds"


def _enumerate(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
