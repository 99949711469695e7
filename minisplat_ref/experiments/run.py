"""Runs a training into its folder: progress, checkpoints, and everything that the folder holds in the end."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.backends import get_backend
from minisplat_ref.constants import PROFILES
from minisplat_ref.experiments import curve, events, run_folder
from minisplat_ref.experiments.progress import Progress
from minisplat_ref.experiments.scoring import measure, score, to_metrics
from minisplat_ref.experiments.settings import Settings, save_model, to_config
from minisplat_ref.experiments.surface import Surface, surface_distance, true_surface
from minisplat_ref.io import viewpoints
from minisplat_ref.lpips import Network
from minisplat_ref.metrics import Evaluation
from minisplat_ref.training.loop import StepReport, save_state, train
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Scene

CHECKPOINT_SECONDS = 60.0  # a crash loses at most this much work


class Outcome(NamedTuple):
    """How a training ended."""

    evaluation: Evaluation
    """Of the test views."""
    seconds: float
    """Time in the training loop, compilation and the earlier parts of a continued run included."""
    is_complete: bool
    """False when Ctrl-C ended it; everything has been saved then, too."""


def run_training(
    folder: Path,
    scene: Scene,
    settings: Settings,
    recipe: Recipe,
    state: TrainState,
    network: Network | None = None,
) -> Outcome:
    """Train, save and measure.

    Parameters
    ----------
    folder : Path
        The run; exists.
    scene : Scene
        The loaded scene.
    settings : Settings
        Of the run; ``iterations`` says where to stop.
    recipe : Recipe
        The recipe of the settings, scaled to ``settings.schedule_iterations``.
    state : TrainState
        Where to start; changed in place.
    network : Network, optional
        Of the settings, to measure LPIPS with: read before the training, so that nothing can be wrong with it after.

    Returns
    -------
    Outcome
    """
    run_folder.write_json(folder / run_folder.CONFIG, to_config(settings, recipe, scene))
    run_folder.write_json(folder / run_folder.CAMERAS, viewpoints.to_json(viewpoints.scene_viewpoints(scene)))
    progress = Progress(folder / run_folder.LOG, state.step, settings.iterations)
    callbacks: list[Callable[[StepReport], None]] = [progress]
    if state.step == 0 or (folder / run_folder.EVENTS).exists():  # else half a record would hide what fired before
        curve.keep_until(folder / run_folder.EVENTS, state.step)
        callbacks.append(_events(folder / run_folder.EVENTS))
    surface = None
    if settings.eval_every:
        surface = true_surface(Path(settings.scene), scene)
        curve.keep_until(folder / run_folder.CURVE, state.step)
        callbacks.append(_curve(folder / run_folder.CURVE, scene, settings, progress, surface))
    callbacks.append(_checkpoints(folder, recipe))  # after the records: what it continues from is in them

    def on_step(report: StepReport) -> None:
        for callback in callbacks:
            callback(report)

    is_complete = True
    with progress:
        try:
            train(
                scene,
                recipe._replace(iterations=settings.iterations),
                seed=settings.seed,
                state=state,
                on_step=on_step,
                backend=get_backend(settings.backend),
                conventions=PROFILES[settings.profile],
            )
        except KeyboardInterrupt:
            is_complete = False
        seconds = progress.seconds
    save_state(folder / run_folder.CHECKPOINT, state, recipe)
    save_model(folder, settings, state.model)
    peak_mb = peak_rss_mb()  # before the network of LPIPS takes more than the training did
    evaluation = score(folder, scene, state.model, settings, network)
    n_gaussians = len(state.gaussians.means)
    if settings.eval_every:
        further = _chamfer(state.gaussians, surface)
        curve.append(folder / run_folder.CURVE, state.step, seconds, evaluation, n_gaussians, **further)
    metrics = {
        "n_gaussians": n_gaussians,
        "iterations": state.step,
        "train_seconds": seconds,
        "peak_rss_mb": peak_mb,
        **to_metrics(evaluation),
    }
    run_folder.write_json(folder / run_folder.METRICS, metrics)
    return Outcome(evaluation, seconds, is_complete)


def _checkpoints(folder: Path, recipe: Recipe) -> Callable[[StepReport], None]:
    """Return a callback of the loop that saves the state every CHECKPOINT_SECONDS."""
    last_saved = time.monotonic()

    def on_step(report: StepReport) -> None:
        nonlocal last_saved
        if time.monotonic() - last_saved > CHECKPOINT_SECONDS:
            save_state(folder / run_folder.CHECKPOINT, report.state, recipe)
            last_saved = time.monotonic()

    return on_step


def _events(path: Path) -> Callable[[StepReport], None]:
    """Return a callback of the loop that records what fired."""
    return lambda report: events.append(path, report.step, report.fired)


def _curve(
    path: Path, scene: Scene, settings: Settings, progress: Progress, surface: Surface | None
) -> Callable[[StepReport], None]:
    """Return a callback of the loop that measures the test views on the way, off the training's clock."""

    def on_step(report: StepReport) -> None:
        if report.step % settings.eval_every or report.step == settings.iterations:  # the end is measured anyway
            return
        seconds, model = progress.seconds, report.state.model
        with progress.paused():
            evaluation, further = measure(scene, model, settings), _chamfer(model.gaussians, surface)
            curve.append(path, report.step, seconds, evaluation, len(model.gaussians.means), **further)

    return on_step


def _chamfer(gaussians: Any, surface: Surface | None) -> dict[str, float | None]:
    return {} if surface is None else {"chamfer": surface_distance(gaussians, surface)}


def peak_rss_mb() -> float | None:
    """Return the most memory that this process has held, MB; None on systems that do not say."""
    try:
        import resource  # absent on Windows
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)  # macOS counts bytes, the others kB
