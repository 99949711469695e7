"""The start of a training other than the scene's points: a point cloud, or the model of a run (``--init``)."""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.app.runs.checkpoints import newest_model
from minisplat_ref.app.runs.run_folder import POINT_CLOUD
from minisplat_ref.app.runs.settings import find_owner, load, load_frame, place_model, return_model
from minisplat_ref.errors import InputError
from minisplat_ref.io.frames import place_points
from minisplat_ref.io.ply import MEANS, NORMALS, load_points
from minisplat_ref.io.ply_file import property_names
from minisplat_ref.strategy.initialization import N_NEIGHBOURS, are_seen
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.calibration import EXPOSURE, LEARNED
from minisplat_ref.training.initial_state import begin_with, initial_state
from minisplat_ref.training.representation import Representation, convert_population
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Gaussians, Model, Scene


class Start(NamedTuple):
    """The state before the first iteration of a training with a given start."""

    state: TrainState
    source: str | None
    """The source of the start, in one line; None for the scene's own points."""
    notices: list[str]
    """Sentences about missing parts of the source."""


def make_start(path: str | Path | None, scene: Scene, recipe: Recipe, seed: int) -> Start:
    """Return the start from the scene's points, a file, or the model of a run where the path is a folder.

    Parameters
    ----------
    path : str or Path, optional
        See :func:`load_start` and :func:`continue_model`; some representations read files of their own. By default the
        scene's own points.
    scene : Scene
    recipe : Recipe
    seed : int
        Of all random draws.

    Raises
    ------
    InputError
        The path holds neither, it does not fit the scene or the recipe, or there is none and the recipe needs one.
    """
    from_file = recipe.representation.from_file
    if path is None:
        if from_file is not None:
            raise InputError(
                f"recipe {recipe.name} trains {recipe.representation.name}, which do not start from the scene's points:"
                " give --init FILE, or a run of that recipe"
            )
        return Start(initial_state(scene, recipe, seed), None, [])
    recipe = recipe._replace(starts_densely=False)  # from these points, as requested
    if Path(path).is_dir():
        return continue_model(Path(path), scene, recipe, seed)
    if from_file is not None:
        state = initial_state(scene, recipe, seed, partial(from_file, Path(path), scene, recipe.sh_degree))
        return Start(state, f"{n_rows(state.gaussians):,} {recipe.representation.name} of {path}", [])
    start, notices = load_start(path, scene)
    return Start(initial_state(start, recipe, seed), f"{len(start.points):,} points of {path}", notices)


def continue_model(folder: Path, scene: Scene, recipe: Recipe, seed: int) -> Start:
    """Return the start of a training from the model of a run, which may have another recipe and another renderer.

    The Gaussians of 3DGS become the recipe's population as those of the scene's points would, unless the recipe trains
    and renders them as they are. Only the model of the run is continued: moments, statistics and the order of the views
    begin afresh.

    Parameters
    ----------
    folder : Path
        Of a run that has ended or has a checkpoint.
    scene : Scene
        In the same world as the run's.
    recipe : Recipe
    seed : int

    Raises
    ------
    InputError
        The folder holds no run; its population, or its parameters of photographs and sky, are not those of the recipe;
        or no training view sees the model.
    """
    theirs = load(folder)
    owner = find_owner(theirs)
    saved = newest_model(folder, theirs)
    model = place_model(return_model(saved.model, owner, load_frame(folder)), owner, scene.frame)
    if not are_seen(model.gaussians.means, [view.camera for view in scene.train_views]).any():
        raise InputError(
            f"{folder}: no training view sees any of its {n_rows(model.gaussians):,} Gaussians; give a run of scene"
            f" {scene.name}"
        )
    state = initial_state(scene, recipe, seed)
    rng = np.random.default_rng(seed)
    population = _convert_population(folder, model, owner.representation, recipe, rng)
    _check_shared(folder, model, state, recipe)
    begin_with(state, population, model.shared, rng)
    theirs_name, our_name = (part.representation.renderer.name for part in (owner, recipe))
    source = (
        f"{n_rows(state.gaussians):,} Gaussians of {folder}, trained with {theirs.recipe} and rendered by {theirs_name}"
    )
    unfinished = f"{folder} has not ended: this is its checkpoint of iteration {saved.unfinished}"
    notices = [] if saved.unfinished is None else [unfinished]
    return Start(state, source if theirs_name == our_name else f"{source}, here by {our_name}", notices)


def _convert_population(
    folder: Path, model: Model, theirs: Representation, recipe: Recipe, rng: np.random.Generator
) -> Any:
    """Return a model's primitives as the recipe's population.

    Raises
    ------
    InputError
        They are of another kind that has fields which the recipe does not train.
    """
    converted = convert_population(model.gaussians, theirs, recipe.representation, rng)
    if converted is not None:
        return converted
    further = ", ".join(field for field in model.gaussians._fields if field not in Gaussians._fields)
    raise InputError(
        f"{folder} holds {theirs.name} with {further or 'other fields'}, which recipe {recipe.name} does not train:"
        f" take a recipe of its extension, or give --init {folder / POINT_CLOUD} to start from its points alone"
    )


def _check_shared(folder: Path, model: Model, state: TrainState, recipe: Recipe) -> None:
    """Refuse parameters without rows that the recipe does not train, or for another number of photographs."""
    for name, values in model.shared.items():
        if name not in state.shared:
            switches = [c.name for c in recipe.calibrations if name in c.initial(1)]
            value = LEARNED if switches == [EXPOSURE.name] else "true"
            way_out = f"add --set {switches[0]}={value}" if switches else "take the recipe of that run"
            raise InputError(
                f"{folder} has parameters {name} besides its Gaussians, which recipe {recipe.name} does not train:"
                f" {way_out}"
            )
        if state.shared[name].shape != values.shape:
            raise InputError(
                f"{folder} has parameters {name} of shape {values.shape}, and here they have"
                f" {state.shared[name].shape}: give the photographs of that run, divided by the same --test-every"
            )


def load_start(path: str | Path, scene: Scene) -> tuple[Scene, list[str]]:
    """Read a point cloud and replace the scene's points by it.

    The scene that is returned is for the start alone: its views have no ids of the points that they see.

    Parameters
    ----------
    path : str or Path
        A PLY, in the frame of the scene's files; see :func:`minisplat_ref.io.ply.load_points`.
    scene : Scene

    Returns
    -------
    start : Scene
        For :func:`minisplat_ref.training.loop.initial_state`.
    notices : list of str
        Sentences about missing parts of the file.

    Raises
    ------
    InputError
        The file is missing or not a point cloud, has too few points, or no training view sees any of them.
    """
    cloud = load_points(path)
    cloud = cloud._replace(points=place_points(cloud.points, scene.frame))
    n = len(cloud.points)
    if n <= N_NEIGHBOURS:
        raise InputError(
            f"{path}: {n} point{'s'[: n != 1]}{f', as {cloud.dropped}' if cloud.dropped else ''}; to start from them,"
            f" give at least {N_NEIGHBOURS + 1}, or leave --init out"
        )
    if not are_seen(cloud.points, [view.camera for view in scene.train_views]).any():
        raise InputError(
            f"{path}: no training view sees any of the {n:,} points; give them in the world frame of scene {scene.name}"
        )
    notices = [f"{path}: {cloud.dropped} and left out"] if cloud.dropped else []
    if not cloud.has_colors:
        others = ", ".join(name for name in property_names(path) if name not in (*MEANS, *NORMALS))
        notices.append(
            f"{path}: no properties red, green, blue{f', but {others}' if others else ''}; all points start gray"
        )
    return scene._replace(points=cloud.points, point_colors=cloud.colors), notices
