"""The folder that ``train`` leaves: which file is called what, and how each is read and written."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.json_file import read_json

CONFIG = "config.json"  # everything needed to run it again
POINT_CLOUD = "point_cloud.ply"  # the Gaussians
SHARED = "shared.npz"  # parameters that belong to no Gaussian, if there are any
METRICS = "metrics.json"  # what was measured on the test views
LOG = "log.jsonl"  # one record every few steps
CURVE = "curve.jsonl"  # the test views measured every --eval-every steps, if that was asked for
EVENTS = "events.jsonl"  # one record each time that an event of the recipe acted
CHECKPOINT = "checkpoint.npz"  # what `--resume` continues from
CAMERAS = "cameras.json"  # cameras of all views, so that they can be rendered without the photographs
RENDERS = "renders"  # truth | render | error of each test view


def check_free(folder: Path) -> None:
    """Refuse a folder for new output that already holds something.

    Raises
    ------
    InputError
        ``folder`` is a file or a folder with anything in it.
    """
    if (folder / CONFIG).exists():
        raise InputError(
            f"{folder} already holds a run: give another --out, or continue it with train --resume {folder}"
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} is not an empty folder: give another --out")


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


def is_finished(folder: Path, iterations: int) -> bool:
    """Return whether a run has been measured after its last iteration: that is what it does in the end."""
    return (folder / METRICS).exists() and read_json_object(folder / METRICS).get("iterations") == iterations


def remove(folder: Path) -> None:
    """Take back a folder that :func:`create` made and a training that cannot go on has begun to fill."""
    shutil.rmtree(folder)


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
    value = read_json(path, "give another folder or train anew")
    if not isinstance(value, Mapping):
        raise InputError(f"{path} does not hold a JSON object")
    return dict(value)
