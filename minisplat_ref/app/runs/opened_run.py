"""A run opened to be simplified: its model, recipe and photographs, and the folds by which its sizes are measured."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from minisplat_ref.app.runs import fingerprint, run_folder
from minisplat_ref.app.runs.checkpoints import newest_model
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.settings import configure_recipe, find_owner, load, load_frame, load_photographs
from minisplat_ref.constants import PROFILES
from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.extensions.extension import Extension
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import get_backend
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.recipe_settings import match_calibrations
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import Model, Scene, number_views

N_FOLDS = 3  # parts of the training views, each of which is held out once
VIEWS_MIN = 4  # training views: at least two are trained on while the others are held out


class Run(NamedTuple):
    """The run to be simplified, with all that its training needs."""

    folder: Path
    settings: Settings
    recipe: Recipe
    """With the calibrations that the model has parameters of."""
    owner: Extension
    """The owner of the population."""
    scene: Scene
    """Training views numbered."""
    model: Model
    step: int | None
    """Iterations that the model has been trained, as far as the folder has them."""
    unfinished: int | None
    """Iteration of the checkpoint that the model is of; None where the run has ended."""

    @property
    def render_settings(self) -> RenderSettings:
        """The settings with which the run renders its views."""
        conventions, backend = PROFILES[self.settings.profile], get_backend(self.settings.backend)
        return RenderSettings(self.scene.background, conventions, backend, self.recipe.renderer)

    @property
    def folds(self) -> "list[Fold]":
        """The training views, divided so that each is held out in one fold, and each fold spreads over the scene."""
        ids = range(len(self.scene.train_views))
        return [
            Fold([k for k in ids if k % N_FOLDS != f], [k for k in ids if k % N_FOLDS == f]) for f in range(N_FOLDS)
        ]


class Fold(NamedTuple):
    """Two parts of the training views, by their numbers."""

    trained: list[int]
    """Those that fine-tune."""
    held_out: list[int]
    """The views that measure the result."""


def open_run(folder: Path, scene: Path | None = None) -> Run:
    """Read a run and its photographs.

    Parameters
    ----------
    folder : Path
        Of a training that has ended or has a checkpoint.
    scene : Path, optional
        Where the photographs are now; where they were by default.

    Raises
    ------
    InputError
        The folder holds no run, the photographs are not there or not the run's, there are too few, or the model cannot
        be simplified.
    """
    settings = load(folder)
    saved = newest_model(folder, settings)
    if saved.unfinished is not None:
        message = f"{folder} has not ended: this is its checkpoint of iteration {saved.unfinished}"
        warnings.warn(one_line(message), InputWarning, stacklevel=2)
    settings = settings if scene is None else replace(settings, scene=str(scene.resolve()))
    if not Path(settings.scene).exists():
        raise InputError(f"{settings.scene}, the scene of {folder}, is not there: --scene PATH says where it is now")
    photographs = load_photographs(settings, load_frame(folder))
    fingerprint.check(folder, photographs, settings.scene)
    check_views(photographs, "simplify")
    if n_rows(saved.model.gaussians) < 2:
        raise InputError(f"{folder} holds {n_rows(saved.model.gaussians)} Gaussians, of which none can go: train more")
    recipe = configure_recipe(settings)
    run = Run(
        folder,
        settings,
        match_calibrations(recipe, saved.model),
        find_owner(settings),
        photographs._replace(train_views=number_views(photographs.train_views)),
        saved.model,
        run_folder.measured_step(folder) if saved.unfinished is None else saved.unfinished,
        saved.unfinished,
    )
    check_renderer(run)
    return run


def check_views(scene: Scene, what: str) -> None:
    """Refuse a scene with too few training views to hold some out; ``what`` names the purpose."""
    n_views = len(scene.train_views)
    if n_views < VIEWS_MIN:
        raise InputError(
            f"{what} needs at least {VIEWS_MIN} training views, some of which are held out in turn to measure what is"
            f" lost, and scene {scene.name} has {n_views}: train with more photographs"
        )


def check_renderer(run: Run) -> None:
    """Refuse a renderer without the blend weight of each row."""
    settings, reason = run.render_settings, ""
    try:
        if settings.render_view(run.model, run.scene.train_views[0], frozenset({"stats"}))[0].stats is not None:
            return
    except InputError as error:
        reason = f" ({error})"
    raise InputError(
        f"{run.folder}: renderer {settings.renderer.name} of extension {run.owner.name} gives no blend weights, by"
        f" which simplify chooses{reason}: give a run of another recipe"
    )
