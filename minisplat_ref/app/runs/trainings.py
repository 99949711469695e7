"""Trainings as separate processes, with folders from which they continue: the status of each, and its next command.

A separate process has a separate peak memory, and when it is killed, nothing else ends.
"""

import contextlib
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Literal

from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.options import NAMES, OPTIONS, Settings
from minisplat_ref.app.runs.settings import load
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import option_name

SAVING_SECONDS = 5.0  # after Ctrl-C; a training that continues for longer has not been told
PROGRAM = (sys.executable, "-m", "minisplat_ref")

Status = Literal["finished", "cut off", "lost", "new"]
"""The status of a training: complete, at a checkpoint, before the first one, or not begun."""

HEADINGS: dict[Status, str] = {
    "finished": ": finished, kept",
    "cut off": ": continued from its checkpoint",
    "lost": ": has no checkpoint, started again",
    "new": ": started",
}

REPORTED_CODES = (0, 2, 130)  # after which the training has printed its line of explanation


def find_status(folder: Path, requested: Settings) -> Status:
    """Return the status of the training in a folder.

    Raises
    ------
    InputError
        The folder holds a run of other settings, or something else.
    """
    if not (folder / run_folder.CONFIG).exists():
        run_folder.check_free(folder)
        return "new"
    ours = load(folder)
    for name in NAMES:
        is_, should = getattr(ours, name), getattr(requested, name)
        if is_ != should:
            raise InputError(
                f"{folder} holds a run of other settings, {name} is {is_} and not {should}: move it away, or give"
                " another --out"
            )
    if run_folder.is_finished(folder, requested.iterations):
        return "finished"
    has_checkpoint = any((folder / name).exists() for name in (run_folder.CHECKPOINT, run_folder.PREVIOUS))
    return "cut off" if has_checkpoint else "lost"


def spell_remaining_command(folder: Path, requested: Settings, first: Sequence[str]) -> list[str] | None:
    """Return the command that completes a training, as words; None if it has ended.

    Files of a training without a checkpoint are removed.

    Parameters
    ----------
    folder : Path
    requested : Settings
        That it must have.
    first : sequence of str
        The words that begin it.
    """
    status = find_status(folder, requested)
    if status == "finished":
        return None
    if status == "cut off":
        return ["train", "--resume", str(folder)]
    if status == "lost":
        shutil.rmtree(folder)
    return list(first)


def spell_command(settings: Settings, folder: Path) -> list[str]:
    """Return the command that begins a training with these settings in a folder, as words."""
    words = ["train", settings.scene, "--out", str(folder)]
    for name in OPTIONS:
        value = getattr(settings, name)
        if name in ("set", "background") or value is None or value is False:
            continue
        words += [option_name(name)] if value is True else [option_name(name), str(value)]
    for name, text in settings.set.items():
        words += ["--set", f"{name}={text}"]
    if settings.background is not None:
        words += ["--background", ",".join(str(round(255 * value)) for value in settings.background)]
    return words


def train_here(words: Sequence[str]) -> int:
    """Carry out a command in a process here; return its exit code.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C or SIGTERM, when it has saved its state.
    CalledProcessError
        It has been killed or has a programming error.
    """
    command = [*PROGRAM, *words]
    with subprocess.Popen(command) as process, _raising_terminated():
        try:
            code = process.wait()
        except _Terminated:
            process.terminate()  # it saves now, as after Ctrl-C, however long that takes
            process.wait()
            raise
        except KeyboardInterrupt:
            # A terminal's Ctrl-C has reached the training, too, which saves now and is better left alone.
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(SAVING_SECONDS)
            process.send_signal(signal.SIGINT)  # does nothing when the training has ended
            process.wait()
            raise
    if code not in REPORTED_CODES:
        raise subprocess.CalledProcessError(code, command)
    return code


class _Terminated(KeyboardInterrupt):
    """SIGTERM, which the system sends to this process alone, while Ctrl-C reaches its trainings too."""


@contextlib.contextmanager
def _raising_terminated() -> Iterator[None]:
    """Make SIGTERM raise :class:`_Terminated`, in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def raise_terminated(number: int, frame: FrameType | None) -> None:
        raise _Terminated

    previous = signal.signal(signal.SIGTERM, raise_terminated)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
