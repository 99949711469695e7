"""The settings of a run in their file ``config.json``, and the recipe, photographs and model that they determine."""

import platform
import reprlib
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref import __version__
from minisplat_ref.app.runs.model_file import make_label
from minisplat_ref.app.runs.options import FIRST_NAMES, NAMES, Settings, first_wrong
from minisplat_ref.app.runs.run_folder import CONFIG, POINT_CLOUD, SHARED, read_json_object, write_json
from minisplat_ref.app.runs.scene_part import read_part
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import CORE, Extension, find_recipe, owner_of
from minisplat_ref.io import list_scene
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.frames import (
    Unit,
    frame_from_json,
    frame_to_json,
    place_fields,
    place_population,
    place_scene,
    return_fields,
    return_population,
)
from minisplat_ref.io.images import check_downscale
from minisplat_ref.io.npz import read_npz
from minisplat_ref.io.ply import save_ply
from minisplat_ref.io.run_files import background_in
from minisplat_ref.io.scene import Listing, build_reading, build_scene
from minisplat_ref.io.upright import FILE, Up, find_up, read_up, up_from_json, up_to_json
from minisplat_ref.mechanisms.cameras.models import check_optics
from minisplat_ref.methods import RECIPES
from minisplat_ref.metrics.lpips import Network, check_views, load_network
from minisplat_ref.strategy import importance, simplify
from minisplat_ref.training.calibration import SHIFTS
from minisplat_ref.training.recipe_settings import configure, parse_settings, settings_of
from minisplat_ref.training.schedule import Recipe, compress_recipe, describe
from minisplat_ref.types import FILE_FRAME, NOTHING, Floats, Frame, Model, Scene

CHOICES = {"sampling": simplify.by_sampling, "rank": simplify.by_rank, "merging": simplify.by_merging}
METRICS = {"indoor": importance.indoor, "outdoor": importance.outdoor}
SHARED_UNITS = {SHIFTS: Unit.LENGTH}  # of shared parameters of any recipe
REPORTED_PACKAGES = ("numpy", "numba", "scipy", "pillow", "pycolmap")  # those that are installed


def configure_recipe(settings: Settings) -> Recipe:
    """Return the recipe of a run, scaled and with what the run sets differently.

    Raises
    ------
    InputError
        There is no such recipe or extension, or the recipe has no such setting.
    """
    whole = settings.whole_iterations
    recipe = find_recipe(settings.recipe, whole or settings.schedule_iterations, extension=settings.extension)
    recipe = configure(recipe, **parse_settings(recipe, settings.set))
    options = {
        "--budget": ("budget", settings.budget),
        "--simplify": ("choose", settings.simplify and CHOICES[settings.simplify]),
        "--scene-type": ("metric", settings.scene_type and METRICS[settings.scene_type]),
    }
    for option, (name, value) in options.items():
        if value is None:
            continue
        if name not in settings_of(recipe):
            others = ", ".join(other.name for other in RECIPES.values() if name in settings_of(other))
            raise InputError(f"{option} means nothing to recipe {recipe.name}: leave it out, or take one of {others}")
        recipe = configure(recipe, **{name: value})
    return recipe if whole is None or settings.block is None else compress_recipe(recipe, settings.schedule_iterations)


def find_owner(settings: Settings) -> Extension:
    """Return the extension whose population a run trains; :data:`CORE` for the Gaussians of 3DGS."""
    return owner_of(settings.recipe, settings.extension) or CORE


def save_model(folder: Path, settings: Settings, model: Model, frame: Frame) -> None:
    """Write the population, and the shared parameters if there are any, into the folder of a run.

    Parameters
    ----------
    folder : Path
    settings : Settings
        Of the run.
    model : Model
        In its frame; the files are in that of the scene's files.
    frame : Frame
        That of the run's scene.
    """
    owner = find_owner(settings)
    model = return_model(model, owner, frame)
    owner.save(folder / POINT_CLOUD, model.gaussians, make_label(owner, model.shared, settings.set))
    if model.shared:
        with replacing(folder / SHARED) as temporary, open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, **model.shared)


def place_model(model: Model, owner: Extension, frame: Frame) -> Model:
    """Return a model of files in the frame of a run."""
    if frame == FILE_FRAME:
        return model
    return Model(
        place_population(model.gaussians, owner.representation.units, frame),
        place_fields(model.shared, {**SHARED_UNITS, **owner.representation.units}, frame),
    )


def return_model(model: Model, owner: Extension, frame: Frame) -> Model:
    """Return a model of a run in the frame of its scene's files."""
    if frame == FILE_FRAME:
        return model
    return Model(
        return_population(model.gaussians, owner.representation.units, frame),
        return_fields(model.shared, {**SHARED_UNITS, **owner.representation.units}, frame),
    )


def load_model(folder: Path, settings: Settings) -> Model:
    """Read what :func:`save_model` wrote, into the frame of the run.

    Raises
    ------
    InputError
        A file is missing or damaged, or the extension is.
    """
    owner = find_owner(settings)
    gaussians = owner.load(folder / POINT_CLOUD, owner.representation.population)
    shared = read_npz(folder / SHARED, "train again") if (folder / SHARED).exists() else NOTHING
    return place_model(Model(gaussians, shared), owner, load_frame(folder))


def _find_version(package: str) -> str | None:
    """Return the version of a package, None where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def to_config(settings: Settings, recipe: Recipe, scene: Scene) -> dict[str, Any]:
    """Return what ``config.json`` holds: the settings, the recipe spelled out, and the versions that run it."""
    versions = {package: found for package in REPORTED_PACKAGES if (found := _find_version(package)) is not None}
    return {
        "settings": asdict(settings),
        "background": scene.background.tolist(),
        **({} if scene.frame == FILE_FRAME else {"frame": frame_to_json(scene.frame)}),
        "up": up_to_json(scene_up(settings, scene)),
        "recipe": describe(recipe),
        "versions": {"minisplat_ref": __version__, "python": platform.python_version(), **versions},
        "platform": platform.platform(),
    }


def scene_up(settings: Settings, scene: Scene) -> Up:
    """Return what is up in the scene of a run: what its folder records, or what cameras and points show.

    Raises
    ------
    InputError
        The file of the scene is damaged.
    """
    cameras = [view.camera for view in (*scene.train_views, *scene.test_views)]
    return read_up(Path(settings.scene)) or find_up(cameras, scene.points)


def load_up(folder: Path) -> Up | None:
    """Read what is up in the scene of a run; None in runs that do not record it.

    Raises
    ------
    InputError
        As for :func:`load`.
    """
    recorded = _read_config(folder).get("up")
    return None if recorded is None else up_from_json(recorded, folder / CONFIG)


def record_up(folder: Path, up: Up) -> None:
    """Record what is up in the scene of a run, with the run, and with the scene for later ones."""
    write_json(folder / CONFIG, {**_read_config(folder), "up": up_to_json(up)})
    scene = Path(load(folder).scene)
    if scene.is_dir():
        write_json(scene / FILE, up_to_json(up))


def load(folder: Path) -> Settings:
    """Read the settings of a run.

    Raises
    ------
    InputError
        There is no such folder, it holds no run, or one of another version.
    """
    path, content = folder / CONFIG, _read_config(folder).get("settings")
    if not isinstance(content, dict):
        raise _version_error(path, "it has no settings")
    if lacking := [name for name in FIRST_NAMES if name not in content]:
        raise _version_error(path, f"it has no setting {lacking[0]}")
    if surplus := [name for name in content if name not in NAMES]:
        raise _version_error(path, f"{reprlib.repr(surplus[0])} is no setting")
    settings = Settings(**content)
    if wrong := first_wrong(settings):
        value = reprlib.repr(content[wrong])
        raise InputError(f"{path}: the setting {wrong} is {value}, which no training of this version has written")
    return settings


def _version_error(path: Path, why: str) -> InputError:
    return InputError(f"{path} is not the configuration of a training of this version: {why}")


def load_background(folder: Path) -> Floats:
    """Read the colour [3] in [0, 1] behind the scene of a run.

    Raises
    ------
    InputError
        As for :func:`load`.
    """
    return background_in(_read_config(folder), folder / CONFIG)


def load_frame(folder: Path) -> Frame:
    """Read the frame in which a run is trained, measured and rendered.

    Raises
    ------
    InputError
        As for :func:`load`.
    """
    frame = frame_from_json(_read_config(folder).get("frame"))
    if frame is None:
        raise InputError(f"{folder / CONFIG} has a frame without an origin of three numbers and a unit above 0")
    return frame


def _read_config(folder: Path) -> dict[str, Any]:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give the --out folder of a training")
    if not (folder / CONFIG).is_file():
        raise InputError(f"{folder} holds no run, {CONFIG} is missing: give the --out folder of a training")
    return read_json_object(folder / CONFIG)


def list_photographs(settings: Settings) -> Listing:
    """Return the cameras, points and files of a run's whole scene, without its pixels; errors as for the scene."""
    return list_scene(Path(settings.scene), settings.test_every, settings.model, settings.fold)


def load_photographs(settings: Settings, frame: Frame | None = None, listing: Listing | None = None) -> Scene:
    """Load the scene of a run as it was loaded for the training.

    Parameters
    ----------
    settings : Settings
    frame : Frame, optional
        That of the run; by default the one that suits the scene, or that of the training that a part continues.
    listing : Listing, optional
        Of the whole scene; by default it is read, or that of the part.

    Raises
    ------
    InputError
        See :func:`minisplat_ref.io.load_scene`.
    """
    owner = find_owner(settings)
    part = None if settings.block is None else read_part(Path(settings.block), Path(settings.scene))
    if listing is None:
        listing = list_photographs(settings) if part is None else part.listing
    cameras = [photo.camera for photo in (*listing.train_photos, *listing.test_photos)]
    check_downscale(settings.scene, ((camera.width, camera.height) for camera in cameras), settings.downscale)
    reading = build_reading(
        settings.downscale,
        settings.background,
        settings.undistort,
        listing.alpha_is_mask,
        as_photographed=owner.representation.takes_optics and not settings.undistort,
    )
    scene = build_scene(listing, reading)
    scene = scene if part is None else part.hide(scene)
    if frame is None and part is not None and part.extent is not None and settings.init is not None:
        frame = load_frame(Path(settings.init))
    for view in (*scene.train_views, *scene.test_views):
        try:
            check_optics(view.camera)
        except InputError as error:
            raise InputError(f"{settings.scene}: photograph {view.name}: {error}") from None
    return place_scene(scene, frame)


def check_frame(settings: Settings, scene: Scene) -> None:
    """Refuse a scene far from the origin for an extension whose own files hold float32 alone.

    Raises
    ------
    InputError
        Names the distance.
    """
    owner = find_owner(settings)
    if any(scene.frame.origin) and owner.save is not save_ply:
        distance = float(np.linalg.norm(scene.frame.origin))
        raise InputError(
            f"{settings.scene} is {distance:.4g} from the origin, where files of extension {owner.name}, of float32,"
            " cannot place it: subtract the mean of the cameras' positions from cameras and points"
        )


def load_lpips(settings: Settings, scene: Scene) -> Network | None:
    """Read the network that a run's LPIPS is measured with, None where it has none, and check that it fits the views.

    Raises
    ------
    InputError
        The file is missing or not what it should be, or a test view is too small for the network.
    """
    if settings.lpips_weights is None:
        return None
    network = load_network(settings.lpips_weights)
    check_views(network, scene.test_views)
    return network
