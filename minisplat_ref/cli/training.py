"""Runs a training into its folder: progress, checkpoints, and everything that the folder holds in the end."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from minisplat_ref.backends import get_backend
from minisplat_ref.cli import run_folder, viewpoints
from minisplat_ref.cli.progress import Progress
from minisplat_ref.cli.scoring import score, to_metrics
from minisplat_ref.cli.settings import Settings, to_config
from minisplat_ref.constants import PROFILES
from minisplat_ref.events import TrainState
from minisplat_ref.io import save_ply
from minisplat_ref.metrics import Evaluation
from minisplat_ref.recipes import Recipe
from minisplat_ref.train import StepReport, save_state, train
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


def run_training(folder: Path, scene: Scene, settings: Settings, recipe: Recipe, state: TrainState) -> Outcome:
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

    Returns
    -------
    Outcome
    """
    run_folder.write_json(folder / run_folder.CONFIG, to_config(settings, recipe, scene))
    run_folder.write_json(folder / run_folder.CAMERAS, viewpoints.to_json(viewpoints.scene_viewpoints(scene)))
    progress = Progress(folder / run_folder.LOG, state.step, settings.iterations)
    is_complete = True
    with progress:
        try:
            train(
                scene,
                recipe._replace(iterations=settings.iterations),
                seed=settings.seed,
                state=state,
                on_step=_with_checkpoints(progress, folder, recipe),
                backend=get_backend(settings.backend),
                conventions=PROFILES[settings.profile],
            )
        except KeyboardInterrupt:
            is_complete = False
        seconds = progress.seconds
    save_state(folder / run_folder.CHECKPOINT, state, recipe)
    save_ply(folder / run_folder.POINT_CLOUD, state.gaussians)
    evaluation = score(folder, scene, state.gaussians, settings)
    metrics = {
        "n_gaussians": len(state.gaussians.means),
        "iterations": state.step,
        "train_seconds": seconds,
        "peak_rss_mb": peak_rss_mb(),
        **to_metrics(evaluation),
    }
    run_folder.write_json(folder / run_folder.METRICS, metrics)
    return Outcome(evaluation, seconds, is_complete)


def _with_checkpoints(progress: Progress, folder: Path, recipe: Recipe) -> Callable[[StepReport], None]:
    """Return the callback of the loop: progress, and every CHECKPOINT_SECONDS a checkpoint."""
    last_saved = time.monotonic()

    def on_step(report: StepReport) -> None:
        nonlocal last_saved
        progress(report)
        if time.monotonic() - last_saved > CHECKPOINT_SECONDS:
            save_state(folder / run_folder.CHECKPOINT, report.state, recipe)
            last_saved = time.monotonic()

    return on_step


def peak_rss_mb() -> float | None:
    """Return the most memory that this process has held, MB; None on systems that do not say."""
    try:
        import resource  # absent on Windows
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)  # macOS counts bytes, the others kB
