"""Files of a run that relatives read, too: their names, and their places for a command that takes a run or a PLY.

The application opens whole runs, with their recipe and photographs (:mod:`minisplat_ref.app.runs`).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io import viewpoints
from minisplat_ref.io.json_file import as_array, read_json
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.types import Floats

CONFIG = "config.json"  # everything needed to run it again
POINT_CLOUD = "point_cloud.ply"  # the Gaussians
SHARED = "shared.npz"  # parameters that belong to no Gaussian, if there are any
CAMERAS = "cameras.json"  # cameras of all views and hashes of their photographs: to render and recognise them
METRICS = "metrics.json"  # metrics of the test views


def model_file(path: Path) -> Path:
    """Return the PLY of a run if ``path`` is a folder, else ``path``."""
    return path / POINT_CLOUD if path.is_dir() else path


def read_cameras(file: Path, given: Path | None = None) -> list[Viewpoint]:
    """Read the cameras beside a PLY, or those of the file that was given.

    Raises
    ------
    InputError
        There are none, or the file is damaged.
    """
    beside = file.parent / CAMERAS
    if given is None and not beside.is_file():
        raise InputError(f"{file} has no {CAMERAS} beside it: give --cameras JSON")
    return viewpoints.read(given or beside)


def read_background(file: Path, given: Sequence[float] | None = None) -> Floats:
    """Return the colour [3] in [0, 1] behind the scene of a PLY: given, or that of its run, or black if it has none.

    Raises
    ------
    InputError
        The configuration beside the PLY is damaged.
    """
    beside = file.parent / CONFIG
    if given is not None:
        return np.array(given, np.float64)
    if not beside.is_file():
        return np.zeros(3)
    return background_in(read_json(beside, "give --background R,G,B"), beside)


def background_in(config: Any, path: Path) -> Floats:
    """Return the background [3] that the content of a run's configuration at ``path`` has.

    Raises
    ------
    InputError
        It has none.
    """
    background = as_array(config.get("background"), (3,)) if isinstance(config, dict) else None
    if background is None or not ((background >= 0) & (background <= 1)).all():
        raise InputError(f"{path} has no background of three numbers from 0 to 1")
    return background
