"""Measuring a run again, later: where the measures go, so that those of one thing never replace those of another.

``metrics.json`` and ``renders/`` of a run are of its result on its own test views. Anything else has a separate folder:
another split of the same photographs, a run that has not ended, and other photographs on request.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.app.runs import fingerprint, run_folder
from minisplat_ref.app.runs.checkpoints import Saved, newest_model
from minisplat_ref.app.runs.first_use import warn_if_not_kept
from minisplat_ref.app.runs.model_file import choose_owner, find_label, read_population
from minisplat_ref.app.runs.notices import warn_of_model
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.scoring import choose_render_settings, score, to_metrics
from minisplat_ref.app.runs.settings import (
    find_owner,
    load,
    load_frame,
    load_lpips,
    load_photographs,
    place_model,
)
from minisplat_ref.errors import InputError
from minisplat_ref.metrics import Evaluation
from minisplat_ref.strategy.track_gains import store_gains
from minisplat_ref.types import Model, Scene


class Measured(NamedTuple):
    """An evaluation and where it has been written."""

    evaluation: Evaluation
    folder: Path
    notes: list[str]
    """Notes for a reader of the metrics, a line each."""


def evaluate_run(
    folder: Path,
    *,
    scene: Path | None = None,
    model: Path | None = None,
    test_every: int | None = None,
    out: Path | None = None,
    lpips_weights: Path | None = None,
) -> Measured:
    """Measure the newest model of a run, and write ``metrics.json`` and ``renders/``.

    Parameters
    ----------
    folder : Path
        The run.
    scene : Path, optional
        Where the photographs are now, or others; where they were by default.
    model : Path, optional
        Gaussians instead of those of the run: a PLY or a compact file.
    test_every : int, optional
        Measure every K-th view; those that the run held out by default.
    out : Path, optional
        Where to write; by default the run's folder, or one inside it if something else is measured than its result.
    lpips_weights : Path, optional
        Weights of LPIPS; those that the training was given by default.

    Raises
    ------
    InputError
        The scene is not the run's and ``out`` is not given, there is nothing to measure, or a file is damaged.
    """
    settings = load(folder)
    requested = replace(
        settings,
        scene=str(scene or settings.scene),
        test_every=settings.test_every if test_every is None else test_every,
        fold=settings.fold if test_every is None else 0,
        lpips_weights=settings.lpips_weights if lpips_weights is None else str(lpips_weights),
    )
    saved, frame = newest_model(folder, settings), load_frame(folder)
    if model is not None:
        owner = find_owner(settings)
        choose_owner(model, find_label(model), owner, f"run {folder}")
        given = place_model(Model(read_population(model, owner)), owner, frame)
        saved = Saved(saved.model._replace(gaussians=given.gaussians), None)
    warn_of_model(saved.model, folder)
    warn_if_not_kept(settings.backend)
    photographs = store_gains(load_photographs(requested, frame))
    if not photographs.test_views:
        raise InputError(f"{requested.scene} has no test views: give --test-every above 0")
    network = load_lpips(requested, photographs)
    entries = fingerprint.read(folder)
    fingerprint.warn_of_unchecked(folder, entries)
    notes = []
    parts = [] if saved.unfinished is None else [f"iteration-{saved.unfinished}"]
    parts += [] if model is None else [model.name]
    if entries is not None:
        others = fingerprint.take_fingerprint(photographs)
        if differs := fingerprint.difference(entries, others):
            if out is None:
                raise InputError(
                    f"{requested.scene} is not the scene of {folder}: {differs}; --scene PATH says where that is now,"
                    " --out DIR measures on this one all the same"
                )
            notes.append(f"not the scene that it was trained on: {differs}")
        if not fingerprint.is_split_alike(entries, others):
            parts.append(f"test-every-{requested.test_every}")
        notes += _describe_training_views(entries, photographs)
    render_settings = choose_render_settings(settings, saved.model, photographs.background)
    target = out or (folder / "-".join(["eval", *parts]) if parts else folder)
    if target == folder:
        with run_folder.hold_folder(folder):
            evaluation = score(folder, photographs.test_views, saved.model, render_settings, network)
            metrics = _read_metrics(folder) | to_metrics(evaluation)
            run_folder.write_json(
                folder / run_folder.METRICS, metrics | {"n_gaussians": len(saved.model.gaussians.means)}
            )
        return Measured(evaluation, folder, notes)
    _check_target(target)
    run_folder.create(target)
    evaluation = score(target, photographs.test_views, saved.model, render_settings, network)
    about = _about(folder, requested, saved.unfinished, notes)
    about |= {} if model is None else {"model": str(model.resolve())}
    run_folder.write_json(
        target / run_folder.METRICS,
        {**about, "n_gaussians": len(saved.model.gaussians.means), **to_metrics(evaluation)},
    )
    return Measured(evaluation, target, notes)


def _read_metrics(folder: Path) -> dict[str, Any]:
    path = folder / run_folder.METRICS
    return run_folder.read_json_object(path) if path.exists() else {}


def _about(folder: Path, requested: Settings, unfinished: int | None, notes: list[str]) -> dict[str, Any]:
    """Describe the measured views, for metrics in a separate folder."""
    iterations = _read_metrics(folder).get("iterations") if unfinished is None else unfinished
    return {
        "run": str(folder.resolve()),
        "scene": str(Path(requested.scene).resolve()),
        "test_every": requested.test_every,
        "iterations": iterations,
        "notes": notes,
    }


def _describe_training_views(entries: fingerprint.Entries, scene: Scene) -> list[str]:
    """Report how many of the measured views the run was trained on."""
    names = fingerprint.list_trained(entries)
    n_known = sum(view.name in names for view in scene.test_views)
    if not n_known:
        return []
    return [f"{n_known} of the {len(scene.test_views)} views were trained on, which flatters the measures"]


def _check_target(folder: Path) -> None:
    """Refuse a folder that holds anything but an earlier evaluation, which is replaced."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file: give another --out")
    names = {path.name for path in folder.iterdir()} if folder.exists() else set()
    if names - {run_folder.METRICS, run_folder.RENDERS}:
        raise InputError(f"{folder} holds something other than an evaluation: give another --out")
