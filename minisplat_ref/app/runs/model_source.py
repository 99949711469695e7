"""The input of ``render`` and ``view``: a run, or a file of Gaussians that any program wrote, ready to be rendered."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.model_file import find_file, read_model
from minisplat_ref.app.runs.scoring import Trained, load_trained
from minisplat_ref.app.runs.settings import load_frame, load_up, place_model
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.io import viewpoints
from minisplat_ref.io.frames import frame_of_means, place_camera
from minisplat_ref.io.upright import UNKNOWN, Up, choose_up
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.mechanisms.gbuffer.lighting import relight
from minisplat_ref.types import Frame, Model


class Source(NamedTuple):
    """A model with its renderer, and the cameras that it was trained with."""

    trained: Trained
    """In its frame, like the cameras."""
    cameras: list[Viewpoint]
    """Of the run; empty for a file."""
    path: Path
    """The opened source."""
    frame: Frame
    up: Up = UNKNOWN
    """What is up."""

    def beside(self, name: str) -> Path:
        """Return the default folder of the output: inside of a run, beside a file."""
        return self.path / name if self.path.is_dir() else self.path.with_name(f"{self.path.stem}-{name}")


def open_source(
    path: Path,
    extension: str | None = None,
    environment: Path | None = None,
    axes: str | None = None,
    up: str | None = None,
    **given: Any,
) -> Source:
    """Open a run, a PLY or a compact file.

    Parameters
    ----------
    path : Path
        Folder of a run, or file.
    extension : str, optional
        The one that renders a file, ``core`` for 3DGS; by default the one recorded in the file.
    environment : Path, optional
        Other light for a model that is lit.
    axes : str, optional
        Those of an .spz, instead of those that it names.
    up : str, optional
        What is up (:func:`minisplat_ref.io.upright.given_up`), instead of what is recorded or found.
    **given
        ``background``, ``profile`` and ``backend`` instead of the run's; None counts as not given.

    Raises
    ------
    InputError
        There is no such path, it holds no model, a run has no cameras, or an option does not fit.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist: give the --out folder of a training or a PLY file")
    folder, path = path, find_file(path)
    if axes is not None and path.is_dir():
        raise InputError(f"{path}: --axes is for .spz, whose programs disagree about them: leave it out")
    source = _open_run(path, extension) if path.is_dir() else _open_file(path, extension, axes, folder)
    source = source._replace(up=_choose_up(source, up))
    given = {name: value for name, value in given.items() if value is not None}
    if environment is not None:
        given["model"] = relight(source.trained.model, environment)
    return source._replace(trained=source.trained._replace(**given))


def _choose_up(source: Source, given: str | None) -> Up:
    """Return what is up: as given, as the run has recorded, or as cameras and Gaussians show."""
    recorded = load_up(source.path) if source.path.is_dir() else None
    return choose_up(given, recorded, source.cameras, source.trained.model.gaussians.means) or source.up


def _open_run(folder: Path, extension: str | None) -> Source:
    if extension is not None:
        raise InputError(f"{folder} has its extension recorded: leave out --extension {extension}")
    frame = load_frame(folder)
    cameras = place_viewpoints(viewpoints.read(folder / run_folder.CAMERAS), frame)
    return Source(load_trained(folder), cameras, folder, frame)


def _open_file(path: Path, extension: str | None, axes: str | None, folder: Path) -> Source:
    read = read_model(path, extension, axes)
    frame = frame_of_means(read.population.means)
    model = place_model(Model(read.population), read.owner, frame)
    trained = Trained(model, read.owner.representation.renderer, np.zeros(3), GSPLAT_MAIN.name, "cpu")
    cameras = folder / run_folder.CAMERAS  # of a folder that another program has left
    views = place_viewpoints(viewpoints.read(cameras), frame) if folder.is_dir() and cameras.is_file() else []
    return Source(trained, views, path, frame)


def place_viewpoints(views: Sequence[Viewpoint], frame: Frame) -> list[Viewpoint]:
    """Return viewpoints of the files in the frame of the model."""
    return [view._replace(camera=place_camera(view.camera, frame)) for view in views]
