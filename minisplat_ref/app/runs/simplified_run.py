"""The folder that ``simplify`` leaves: a run like others, without a checkpoint, and the evidence for its size.

``config.json`` is that of the run with one entry more, so ``render``, ``eval``, ``info`` and ``convert`` take the
folder like that of a training. Nothing in it depends on the time: the same run gives the same bytes.
"""

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.app.reports.images import Image8, to_8_bits
from minisplat_ref.app.reports.plots import save_png
from minisplat_ref.app.runs import fingerprint, run_folder
from minisplat_ref.app.runs.opened_run import Run, open_run
from minisplat_ref.app.runs.rate_distortion import Point, paired_drop
from minisplat_ref.app.runs.scoring import score, to_metrics
from minisplat_ref.app.runs.settings import save_model
from minisplat_ref.app.runs.simplification import (
    Decision,
    Target,
    decide,
    expect_time,
    finish,
    is_merged,
    make_measure,
)
from minisplat_ref.app.runs.simplification_report import Shown, plot, report_html
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.metrics import Evaluation, ViewMetrics, evaluate
from minisplat_ref.types import Floats, Model, View

RESULT, FIGURE = "result.json", "figure.png"  # the decision, in addition to the files of every run
N_SHOWN = 3  # test views


class SimplifyOptions(NamedTuple):
    """The options of the command line."""

    run: Path
    out: Path
    target: Target
    fine_tune: int
    """Iterations."""
    scene: Path | None = None
    """The present folder of the photographs, if they have moved."""


def simplify_run(options: SimplifyOptions) -> dict[str, Any]:
    """Simplify a run into a new folder; where it is as small as it gets, that holds the run's own model.

    Returns
    -------
    result : dict
        What ``result.json`` holds.

    Raises
    ------
    InputError
        The run, its photographs or the folder cannot be used, or not even one Gaussian fits; there is no folder then.
    """
    with making_folder(options.out) as folder:
        run = open_run(options.run, options.scene)
        expected = expect_time(run, options.fine_tune)
        decision = decide(run, options.target, make_measure(run, options.fine_tune, expected), expected)
        is_unchanged, n = decision.is_unchanged, decision.chosen.n_gaussians
        model = run.model if is_unchanged else finish(run, n, options.fine_tune)
        save_model(folder, run.settings, model, run.scene.frame)
        views, render_settings = run.scene.test_views, run.render_settings
        after = score(folder, views, model, render_settings)
        before = after if is_unchanged else evaluate(run.model, views, render_settings)
        result = {**to_result(run, options, decision), "test": compare_test_views(before, after)}
        _write_run(folder, run, result, after)
        run_folder.write_json(folder / RESULT, result)
        save_png(plot(result), folder / FIGURE)
        (folder / run_folder.REPORT).write_text(
            report_html(options.out, result, _render_both(run, model)), encoding="utf-8"
        )
    return result


def _images(run: Run, model: Model) -> dict[str, Image8]:
    """Render the first test views, by their names."""
    images: dict[str, Image8] = {}

    def keep(view: View, image: Floats, _: ViewMetrics) -> None:
        images[view.name] = to_8_bits(image)

    evaluate(model, run.scene.test_views[:N_SHOWN], run.render_settings, on_view=keep)
    return images


def _render_both(run: Run, model: Model) -> list[Shown]:
    """Return the first test views as the run and the new model render them."""
    before, after = _images(run, run.model), _images(run, model)
    views = [view.load() for view in run.scene.test_views[:N_SHOWN]]
    return [Shown(view.name, view.image, before[view.name], after[view.name]) for view in views]


def to_result(run: Run, options: SimplifyOptions, decision: Decision) -> dict[str, Any]:
    """Return the decision on a size, for JSON."""
    size = run.scene.train_views[0].camera
    return {
        "run": str(options.run.resolve()),
        "scene": run.scene.name,
        "size": [size.width, size.height],
        "recipe": run.settings.recipe,
        "iterations": run.step,
        "target": str(options.target),
        **options.target._asdict(),
        "max_drop": options.target.limit,
        "is_merged": is_merged(run),
        "fine_tune": options.fine_tune,
        "folds": len(run.folds),
        "views": [view.name for view in run.scene.train_views],
        "run_psnr": decision.run_psnr,
        "all": _describe_point(decision.reference),
        "curve": [_describe_point(point) for point in decision.points],
        "chosen": _describe_point(decision.chosen),
        "is_unchanged": decision.is_unchanged,
        "is_all_that_matter": decision.is_all_that_matter,
    }


def _describe_point(point: Point) -> dict[str, Any]:
    values = {**point._asdict(), "psnrs": list(point.psnrs), "ssims": list(point.ssims)}
    return {**values, "psnr": point.psnr, "ssim": point.ssim}


def compare_test_views(before: Evaluation, after: Evaluation) -> dict[str, Any] | None:
    """Return the change of the test views, for JSON.

    Parameters
    ----------
    before : Evaluation
        Of the run.
    after : Evaluation
        Of the new model.

    Returns
    -------
    test : dict or None
        PSNR of both in dB; ``drop`` from the first to the second, with its standard error, which one view does not
        have; None without test views.
    """
    if before.psnr is None:
        return None
    drop, standard_error = paired_drop(*([view.psnr for view in e.per_view] for e in (before, after)))
    return {
        "views": [view.name for view in before.per_view],
        "psnr_before": before.psnr,
        "psnr_after": after.psnr,
        "ssim_before": before.ssim,
        "ssim_after": after.ssim,
        "drop": drop,
        "standard_error": standard_error if len(before.per_view) > 1 else None,
    }


def _write_run(folder: Path, run: Run, result: dict[str, Any], after: Evaluation) -> None:
    """Write the files that make the folder a run: its configuration, cameras and metrics."""
    config = run_folder.read_json_object(run.folder / run_folder.CONFIG)
    about = {name: result[name] for name in ("run", "target", "fine_tune")}
    config |= {"settings": asdict(run.settings), "simplified": about}
    run_folder.write_json(folder / run_folder.CONFIG, config)
    if (run.folder / run_folder.CAMERAS).exists():
        shutil.copyfile(run.folder / run_folder.CAMERAS, folder / run_folder.CAMERAS)
    else:
        run_folder.write_json(folder / run_folder.CAMERAS, fingerprint.take_fingerprint(run.scene))
    test, lost = result["test"] or {}, _lost(result)
    metrics = {
        "n_gaussians": result["chosen"]["n_gaussians"],
        "n_gaussians_before": result["all"]["n_gaussians"],
        "iterations": result["iterations"],
        "fine_tune": result["fine_tune"],
        **lost,
        **{name: test[name] for name in ("psnr_before", "ssim_before") if name in test},
        **to_metrics(after),
    }
    run_folder.write_json(folder / run_folder.METRICS, metrics)


def _lost(result: dict[str, Any]) -> dict[str, Any]:
    """Return the loss of the chosen size on held-out training views, for ``metrics.json``."""
    chosen = result["chosen"]
    return {
        "drop": chosen["drop"],
        "drop_standard_error": chosen["standard_error"],
        "ssim_drop": result["all"]["ssim"] - chosen["ssim"],
    }
