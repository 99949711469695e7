"""Places at which a training can be killed: between two files, in the middle of one, of a step or of an event.

A process that calls :func:`train_until` kills itself by SIGKILL when it gets there, so that nothing is cleaned up. Used
by :mod:`data_tools.kill_points.survival`.
"""

import importlib
import io
import json
import os
import runpy
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from minisplat_ref.app.runs import checkpoints, run_folder

Install = Callable[[], None]
"""Prepares a process to die at its place."""


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _patch(where: str, wrap: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
    """Replace ``module:name``, where its callers look it up."""
    module, _, name = where.partition(":")
    owner = importlib.import_module(f"minisplat_ref.{module}")
    setattr(owner, name, wrap(getattr(owner, name)))


class _Stand:
    """Stands for a module in one other, which looks its functions up there."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


def before(where: str, nth: int = 1) -> Install:
    """Die when a function is called for the n-th time."""

    def wrap(function: Callable[..., Any]) -> Callable[..., Any]:
        n_calls = 0

        def dying(*args: Any, **named: Any) -> Any:
            nonlocal n_calls
            n_calls += 1
            if n_calls == nth:
                _die()
            return function(*args, **named)

        return dying

    return lambda: _patch(where, wrap)


def after(where: str, nth: int = 1) -> Install:
    """Die when a function has done its work for the n-th time."""

    def wrap(function: Callable[..., Any]) -> Callable[..., Any]:
        n_calls = 0

        def dying(*args: Any, **named: Any) -> Any:
            nonlocal n_calls
            result = function(*args, **named)
            n_calls += 1
            if n_calls == nth:
                _die()
            return result

        return dying

    return lambda: _patch(where, wrap)


def renaming(name: str, is_done: bool, nth: int = 1) -> Install:
    """Die before or after a finished file takes its name for the n-th time."""

    def wrap(system: Any) -> Any:
        n_calls = 0

        class Dying(_Stand):
            def replace(self, source: Any, target: Any) -> None:
                nonlocal n_calls
                n_calls += Path(target).name == name
                is_it = Path(target).name == name and n_calls == nth
                if is_it and not is_done:
                    _die()
                system.replace(source, target)
                if is_it:
                    _die()

        return Dying(system)

    return lambda: _patch("io.atomic:os", wrap)


def half_a_checkpoint(nth: int) -> Install:
    """Die when half of the n-th checkpoint is in its file."""

    def wrap(numpy: Any) -> Any:
        n_calls = 0

        class Dying(_Stand):
            def savez(self, file: Any, **arrays: Any) -> None:
                nonlocal n_calls
                n_calls += 1
                content = io.BytesIO()
                numpy.savez(content, **arrays)
                file.write(content.getvalue()[: content.tell() // 2 if n_calls == nth else None])
                file.flush()
                if n_calls == nth:
                    _die()

        return Dying(numpy)

    return lambda: _patch("io.checkpoint:np", wrap)


def half_a_line(name: str, nth: int) -> Install:
    """Die when half of the n-th record of a log is in its file."""

    def wrap(append: Callable[..., Any]) -> Callable[..., Any]:
        n_calls = 0

        def dying(path: Path, record: Any) -> None:
            nonlocal n_calls
            n_calls += path.name == name
            if path.name == name and n_calls == nth:
                line = json.dumps(record)
                with open(path, "a", encoding="utf-8") as file:
                    file.write(line[: len(line) // 2])
                _die()
            append(path, record)

        return dying

    def install() -> None:
        for module in ("progress", "curve"):
            _patch(f"app.runs.{module}:append_log", wrap)

    return install


def saving_always(install: Install) -> Install:
    """Write a checkpoint in every iteration, and die as told."""

    def both() -> None:
        checkpoints.SECONDS = -1.0
        install()

    return both


def compiling(n_stages: int) -> Install:
    """Die when this many stages have been compiled; the cache must be empty."""

    def wrap(warm_up: Callable[..., Any]) -> Callable[..., Any]:
        def dying(*args: Any) -> Iterator[Any]:
            for count, stage in enumerate(warm_up(*args)):
                if count == n_stages:
                    _die()
                yield stage

        return dying

    return lambda: _patch("app.runs.first_use:warm_up", wrap)


NOWHERE, OFTEN_SAVED = "nowhere", "nowhere, a checkpoint in each iteration"
POINTS: dict[str, Install] = {
    "start: photographs read": after("app.runs.settings:build_scene"),
    "start: first state made": after("training.initial_state:initial_state"),
    "start: folder made": after("app.runs.run_folder:create"),
    "start: config.json written, not named": renaming(run_folder.CONFIG, is_done=False),
    "start: config.json there": renaming(run_folder.CONFIG, is_done=True),
    "start: cameras.json there": renaming(run_folder.CAMERAS, is_done=True),
    "start: half of the first checkpoint": half_a_checkpoint(1),
    "start: first checkpoint there": renaming(run_folder.CHECKPOINT, is_done=True),
    "compiling: first kernel": compiling(0),
    "compiling: fifth kernel": compiling(4),
    "training: first view drawn": before("training.iteration:take_step"),
    "training: half of an Adam step": before("training.iteration:_add", 7),
    "training: Adam's step 57, no event yet": after("training.iteration:take_step", 57),
    "training: half a line of log.jsonl": half_a_line(run_folder.LOG, 9),
    "training: after iteration 133": after("training.iteration:run_events", 133),
    "event: before the population is replaced": before("methods.gaussian_splatting:apply_edit"),
    "event: population new, moments old": before("training.state:inherit_fields"),
    "event: densified, not pruned": after("methods.gaussian_splatting:apply_edit"),
    "event: importance measured": after("methods.mini_splatting:measure_importance"),
    "event: simplified": after("methods.mini_splatting:apply_edit"),
    "event: tail pruned, moments not reset": after("methods.mini_splatting:apply_edit", 2),
    "checkpoint: half of it": saving_always(half_a_checkpoint(112)),
    "checkpoint: whole, the one before not kept": saving_always(renaming(run_folder.PREVIOUS, False, 60)),
    "checkpoint: the one before kept": saving_always(renaming(run_folder.PREVIOUS, True, 60)),
    "checkpoint: there": saving_always(renaming(run_folder.CHECKPOINT, True, 160)),
    "evaluation: half a line of curve.jsonl": saving_always(half_a_line(run_folder.CURVE, 2)),
    "evaluation: last checkpoint there": before("app.runs.run:save_model"),
    "evaluation: PLY written, not named": renaming(run_folder.POINT_CLOUD, is_done=False),
    "evaluation: first image there": after("app.runs.scoring:write_image"),
    "evaluation: renders/ there": renaming(run_folder.RENDERS, is_done=True),
    "evaluation: metrics.json written, not named": renaming(run_folder.METRICS, is_done=False),
    "evaluation: metrics.json there": renaming(run_folder.METRICS, is_done=True),
}
"""What is done to a training so that it dies, by where that is."""


def train_until(point: str, arguments: Sequence[str]) -> None:
    """Run a command line of the program in this process, to be killed at a point.

    Parameters
    ----------
    point : str
        Key of :data:`POINTS`; NOWHERE not to be killed, or OFTEN_SAVED to be killed by others.
    arguments : sequence of str
        Without the program's name.
    """
    if point == OFTEN_SAVED:
        saving_always(lambda: None)()
    elif point != NOWHERE:
        POINTS[point]()
    sys.argv = ["minisplat-ref", *arguments]
    runpy.run_module("minisplat_ref", run_name="__main__")
