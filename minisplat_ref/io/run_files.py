"""Files of a run that relatives read, too: their names, and their places for a command that takes a run or a PLY.

The application opens whole runs, with their recipe and photographs (:mod:`minisplat_ref.app.runs`).
"""

from pathlib import Path

from minisplat_ref.errors import InputError
from minisplat_ref.io import viewpoints
from minisplat_ref.io.viewpoints import Viewpoint

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
