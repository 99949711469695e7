"""The folder that ``train`` leaves: the names of its files, and their readers and writers."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.io import run_files
from minisplat_ref.io.atomic import is_part, remove_parts, replacing
from minisplat_ref.io.json_file import read_json

CONFIG = run_files.CONFIG
POINT_CLOUD = run_files.POINT_CLOUD
SHARED = run_files.SHARED
CAMERAS = run_files.CAMERAS
METRICS = run_files.METRICS
LOG = "log.jsonl"  # one record every few steps
CURVE = "curve.jsonl"  # the test views measured every --eval-every steps, on request
EVENTS = "events.jsonl"  # one record each time that an event of the recipe acted
CHECKPOINT = "checkpoint.npz"  # the state that `--resume` continues
PREVIOUS = "checkpoint-previous.npz"  # the one before, should that be damaged
DECISIONS = "decisions.json"  # measurements and decisions of a training that makes any
REPORT = "report.html"  # a report of all of it
BLOCK_PLAN = "plan.png"  # the blocks seen from above
BLOCKS = "blocks"  # the trainings of which it was merged, where it was trained in blocks
FOLDER_OF_SCENE = "scene"  # in the folder of `photos` and of `demo`, which is the one that a person has named
RENDERS = "renders"  # truth | render | error of each test view

WORK = {CHECKPOINT, PREVIOUS, POINT_CLOUD, METRICS}  # files that have taken time; a run without any has not begun


def check_free(folder: Path) -> None:
    """Refuse a folder for new output that already holds something; a run that has not begun is nothing.

    Raises
    ------
    InputError
        ``folder`` is a file or a folder with anything in it.
    """
    if not folder.exists():
        return
    names = {path.name for path in folder.iterdir() if not is_part(path)} if folder.is_dir() else {folder.name}
    if CONFIG in names and names & WORK:
        raise InputError(
            f"{folder} already holds a run: give another --out, or continue it with train --resume {folder}"
        )
    if BLOCKS in names:
        raise InputError(
            f"{folder} already holds a training in blocks: give another --out, or continue it with train --resume"
            f" {folder}"
        )
    if names and CONFIG not in names:
        raise InputError(f"{folder} is not an empty folder: give another --out")


def has_begun(folder: Path) -> bool:
    """Return whether a run has files that took time; if not, it can begin again."""
    return any((folder / name).exists() for name in WORK)


@contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Keep other processes from writing into a run, and remove unfinished files of killed ones.

    The lock is the system's, on the folder itself, and ends with the process. Windows and some network disks have none.

    Raises
    ------
    InputError
        Another process holds the folder.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"another process is writing into {folder}: wait until it ends, or end it") from None
        except OSError:  # a disk without locks
            pass
        else:
            remove_parts(folder)
        yield
    finally:
        os.close(descriptor)


def scene_title(scene: Path) -> str:
    """Return the name of a scene by that of its folder, or of the folder in which ``photos`` and ``demo`` make it."""
    folder = scene.resolve()
    return folder.parent.name if folder.name == FOLDER_OF_SCENE else folder.name


def create(folder: Path) -> None:
    """Make the folder, after everything that could be wrong with the input has been checked.

    Raises
    ------
    InputError
        The folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be created ({error.strerror}): give another --out") from error


def measured_step(folder: Path) -> int | None:
    """Return the iteration that ``point_cloud.ply`` and ``metrics.json`` are of, None where nothing was measured."""
    return read_json_object(folder / METRICS).get("iterations") if (folder / METRICS).exists() else None


def is_finished(folder: Path, iterations: int) -> bool:
    """Return whether a run has been measured after its last iteration, which is its final step.

    Parameters
    ----------
    folder : Path
    iterations : int
        The requested ones; a recipe that decides its own length may have ended before.
    """
    if not (folder / METRICS).exists():
        return False
    metrics = read_json_object(folder / METRICS)
    return metrics.get("iterations") == iterations or metrics.get("has_ended_early") is True


def remove(folder: Path) -> None:
    """Remove the files of a training that could not begin, and the folder if nothing else is in it."""
    for name in (CONFIG, CAMERAS, LOG, CURVE, EVENTS, DECISIONS, CHECKPOINT, PREVIOUS):
        (folder / name).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON; a reader sees the old file or the new one, never a part of it."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that must hold an object.

    Raises
    ------
    InputError
        The file is not JSON or holds something else.
    """
    value = read_json(path, "give another folder or train again")
    if not isinstance(value, Mapping):
        raise InputError(f"{path} does not hold a JSON object")
    return dict(value)
