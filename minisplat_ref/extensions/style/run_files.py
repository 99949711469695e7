"""A run read to be styled, and the run that comes of it: its files, without the application that wrote them.

Extensions are below :mod:`minisplat_ref.app`, so this reads ``config.json`` itself. The output is an ordinary run
without a checkpoint, like that of ``simplify``: ``render``, ``eval``, ``info`` and ``convert`` take it.
"""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.constants import PROFILES, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.io import load_ply, load_scene, save_ply
from minisplat_ref.io.frames import frame_from_json, place_population, place_scene, return_population
from minisplat_ref.io.json_file import read_json
from minisplat_ref.io.label import NO_LABEL
from minisplat_ref.io.run_files import CAMERAS, CONFIG, METRICS, POINT_CLOUD, SHARED
from minisplat_ref.rendering import SPLATTING
from minisplat_ref.training.representation import WORLD_UNITS
from minisplat_ref.types import Gaussians, Scene

OTHER = "give the --out folder of a training that has ended"


class OpenRun(NamedTuple):
    """A trained scene with its photographs, in the frame that it was trained in."""

    folder: Path
    config: Mapping[str, Any]
    gaussians: Gaussians
    scene: Scene
    conventions: Conventions


def open_run(folder: Path, scene: Path | None = None) -> OpenRun:
    """Read a run of Gaussians without further parameters.

    Parameters
    ----------
    folder : Path
    scene : Path, optional
        Where the photographs are now; where they were by default.

    Raises
    ------
    InputError
        There is no run, it has not ended, its photographs are not there, or it trains something else or more.
    """
    if not (folder / CONFIG).is_file() or not (folder / POINT_CLOUD).is_file():
        missing = CONFIG if not (folder / CONFIG).is_file() else POINT_CLOUD
        raise InputError(f"{folder} has no {missing}: {OTHER}")
    config = read_json(folder / CONFIG, OTHER)
    try:
        settings = config["settings"]
        name, extension, profile = settings["recipe"], settings["extension"], PROFILES[settings["profile"]]
        reading = {key: settings[key] for key in ("downscale", "test_every", "background", "undistort", "model")}
        reading["offset"] = settings.get("fold", 0)
        path, frame = Path(scene or settings["scene"]), frame_from_json(config.get("frame"))
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{folder / CONFIG} is not the configuration of a training of this version: {error}"
        ) from error
    representation = find_recipe(name, extension=extension).representation
    if (representation.population, representation.renderer) != (Gaussians, SPLATTING):
        raise InputError(f"{folder} is a run of recipe {name}, which is not rendered as 3DGS: give one of 3dgs-accel")
    if (folder / SHARED).exists():
        raise InputError(
            f"{folder} has parameters besides its Gaussians ({SHARED}: a sky, exposures or poses), which painting would"
            " have to undo: train without them, for example by recipe 3dgs-accel"
        )
    if frame is None:
        raise InputError(f"{folder / CONFIG} has a frame without an origin of three numbers and a unit above 0")
    if not path.exists():
        raise InputError(f"{path}, the scene of {folder}, is not there: --scene PATH says where it is now")
    gaussians = load_ply(folder / POINT_CLOUD)
    if len(gaussians.means) == 0:
        raise InputError(f"{folder} holds no Gaussians: {OTHER}")
    photographs = place_scene(load_scene(path, **reading), frame)
    return OpenRun(folder, config, place_population(gaussians, WORLD_UNITS, frame), photographs, profile)


def write_run(folder: Path, run: OpenRun, gaussians: Gaussians, about: Mapping[str, Any]) -> None:
    """Write the files that make a folder a run: configuration, Gaussians, cameras, and the number of Gaussians.

    Parameters
    ----------
    folder : Path
        Empty.
    run : OpenRun
        That was styled.
    gaussians : Gaussians
        In the run's frame.
    about : mapping
        How it was styled, for ``config.json``.
    """
    files = return_population(gaussians, WORLD_UNITS, run.scene.frame)
    save_ply(folder / POINT_CLOUD, files, NO_LABEL)
    _write_json(folder / CONFIG, {**run.config, "styled": dict(about)})
    if (run.folder / CAMERAS).exists():
        shutil.copyfile(run.folder / CAMERAS, folder / CAMERAS)
    metrics = {"n_gaussians": len(gaussians.means), "n_gaussians_before": len(run.gaussians.means)}
    _write_json(folder / METRICS, {**metrics, "iterations": run.config["settings"]["iterations"]})


def _write_json(path: Path, value: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
