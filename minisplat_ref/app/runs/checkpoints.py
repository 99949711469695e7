"""The checkpoints of a run: their schedule, the choice of the newest whole one, and the model in it.

The last two are kept. One that is damaged, by a faulty disk or a person, is skipped with a line about it.
"""

import contextlib
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar

from minisplat_ref import memory
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.run_folder import CHECKPOINT, POINT_CLOUD, PREVIOUS, measured_step
from minisplat_ref.app.runs.settings import configure_recipe, load_model
from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.checkpoint import WAY_OUT, DamagedCheckpoint, load_checkpoint, load_metadata
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.schedule import DatedEvent, Recipe
from minisplat_ref.training.state import StepReport, TrainState
from minisplat_ref.types import Model

SECONDS = 60.0  # a crash loses at most this much work

Content = TypeVar("Content")


def save(folder: Path, state: TrainState, recipe: Recipe) -> None:
    """Write the newest checkpoint of a run; the one before is kept beside it."""
    save_state(folder / CHECKPOINT, state, recipe, previous=folder / PREVIOUS)


def save_regularly(folder: Path, recipe: Recipe) -> Callable[[StepReport], None]:
    """Return a callback of the loop that saves every SECONDS, and before an iteration that may run out of memory."""
    last_saved = time.monotonic()

    def on_step(report: StepReport) -> None:
        nonlocal last_saved
        if time.monotonic() - last_saved > SECONDS or _may_burst(report, recipe):
            save(folder, report.state, recipe)
            last_saved = time.monotonic()

    return on_step


def _may_burst(report: StepReport, recipe: Recipe) -> bool:
    """Return whether rows may be added in the next iteration while memory has no room for twice as many."""
    if not any(isinstance(event, DatedEvent) and event.is_due(report.step + 1) for event in recipe.events):
        return False
    n = report.n_gaussians
    return memory.rows_that_fit(n, report.n_bytes, report.output.n_pairs, memory.free_bytes()) < 2 * n


def newest(folder: Path, read: Callable[[Path], Content]) -> Content:
    """Return the result of ``read`` for the newest checkpoint that is whole.

    Raises
    ------
    DamagedCheckpoint
        None is.
    """
    problems: list[DamagedCheckpoint] = []
    for path in (folder / CHECKPOINT, folder / PREVIOUS):
        try:
            content = read(path)
        except DamagedCheckpoint as error:
            problems.append(error)
            continue
        if problems:
            how = "is damaged" if (folder / CHECKPOINT).exists() else "is missing"
            message = f"{folder / CHECKPOINT} {how}: taking {path}, the one before"
            warnings.warn(one_line(message), InputWarning, stacklevel=2)
        return content
    raise problems[0]


def load(folder: Path, settings: Settings) -> TrainState:
    """Return the state in which a run was saved last, by whatever length its schedule had then.

    Raises
    ------
    InputError
        No checkpoint is whole, or it is of another recipe than the run's.
    """

    def read(path: Path) -> TrainState:
        recipe = load_checkpoint(path)[1].get("recipe")
        length = recipe.get("iterations") if isinstance(recipe, dict) else None
        if type(length) is not int or length < 1:
            raise InputError(f"{path} does not say how long its schedule is; {WAY_OUT}")
        return load_state(path, configure_recipe(replace(settings, schedule_iterations=length)))

    return newest(folder, read)


def read_step(folder: Path) -> int | None:
    """Return the iteration of the newest checkpoint, None where there is none."""
    for path in (folder / CHECKPOINT, folder / PREVIOUS):
        with contextlib.suppress(DamagedCheckpoint):
            step = load_metadata(path).get("step")
            return step if type(step) is int else None
    return None


class Saved(NamedTuple):
    """The newest model of a run."""

    model: Model
    unfinished: int | None
    """Iteration of the checkpoint that it comes from; None where the run has ended and the model is its result."""


def newest_model(folder: Path, settings: Settings) -> Saved:
    """Return the model that a run has ended with, or that of its checkpoint if this is newer or all there is.

    Raises
    ------
    InputError
        There is neither, or the files are damaged.
    """
    step = read_step(folder)
    if (folder / POINT_CLOUD).exists() and (step is None or (measured_step(folder) or 0) >= step):
        return Saved(load_model(folder, settings), None)
    if step is None:
        raise InputError(f"{folder} has no Gaussians yet, neither {POINT_CLOUD} nor a checkpoint: train it first")
    state = load(folder, settings)
    return Saved(state.model, state.step)
