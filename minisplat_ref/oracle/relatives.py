"""The gradient proof of a relative of 3DGS: everything that it has of its own, on every backend.

That is its renderer, with every field and shared parameter and, where a recipe of it switches calibrations on, with
these around it; its loss terms, except those that a stage of the same name replaces; and the stages that it
names. Renderer and stages must also compute the same on every backend. Everything that it shares with 3DGS is checked
elsewhere. A relative without anything to check does not pass: the check could not have found an error.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.methods import RECIPES
from minisplat_ref.oracle.agreement import agreement_cases
from minisplat_ref.oracle.cases import Case, Report
from minisplat_ref.oracle.gradients import by_backend
from minisplat_ref.oracle.loss_terms import loss_cases, own_terms, stage_name
from minisplat_ref.oracle.models import TIME, Stages, model_cases
from minisplat_ref.oracle.pieces import SEED
from minisplat_ref.rendering import SPLATTING
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import Floats, Gaussians, Scene


class Relative(NamedTuple):
    """The parts of an extension that have gradients."""

    name: str
    representation: Representation
    losses: tuple[LossTerm, ...]
    """That join those of any recipe."""
    recipes: tuple[Recipe, ...]
    """May have further loss terms, and calibrations that are on."""
    stages: Stages | None


def check_relative_gradients(backends: Sequence[Backend], conventions: Conventions, relative: Relative) -> Report:
    """Check everything that a relative adds to 3DGS.

    Parameters
    ----------
    backends : sequence of Backend
        One after the other, in float64.
    conventions : Conventions
        Profile of the check.
    relative : Relative
        What is checked.

    Returns
    -------
    Report
        The cases of all backends; their names begin with the backend's if there are several. One that failed if there
        is nothing to check.
    """
    names = ", ".join(backend.name for backend in backends)
    same = agreement_cases(backends, conventions, _own_representation(relative), relative.stages)
    of_backends = [_cases(b, conventions, relative) + agrees for b, agrees in zip(backends, same, strict=True)]
    cases = by_backend(backends, of_backends) if any(of_backends) else (_nothing(relative),)
    settings = {"backend": names, "profile": conventions.name, "dtype": "float64", "seed": SEED, "time": TIME}
    return Report(f"gradients of {relative.name} on {names}, profile {conventions.name}, float64", cases, settings)


def _cases(backend: Backend, conventions: Conventions, relative: Relative) -> list[Case]:
    cases = model_cases(backend, conventions, _own_representation(relative), relative.stages)
    for recipe in relative.recipes:
        if recipe.active_calibrations:
            calibrated = _add_calibrations(relative.representation, recipe)
            cases += model_cases(backend, conventions, calibrated, None)
    core = [term for recipe in RECIPES.values() for term in recipe.losses]
    terms = own_terms([*relative.losses, *(term for recipe in relative.recipes for term in recipe.losses)], core)
    checked = {case.name.rpartition(":")[0] for case in cases}
    left = [term for term in terms if stage_name(term) not in checked]
    for term in with_progress(left, f"{backend.name}, losses", "terms"):
        cases += loss_cases(term, backend, conventions, relative.representation)
    return cases


def _own_representation(relative: Relative) -> Representation | None:
    """Return the representation whose renderer is checked; None where that is 3DGS, however its Gaussians begin."""
    own = relative.representation
    return None if (own.population, own.renderer) == (Gaussians, SPLATTING) else own


def _add_calibrations(representation: Representation, recipe: Recipe) -> Representation:
    """Return the representation with a recipe's calibrations, whose parameters are among the shared ones."""

    def shared(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
        own = dict(representation.shared(scene, rng))
        for calibration in recipe.active_calibrations:
            own |= calibration.initial(len(scene.train_views))
        return own

    names = ", ".join(calibration.name for calibration in recipe.active_calibrations)
    renderer = recipe._replace(representation=representation).renderer
    return representation._replace(name=f"{representation.name} with {names}", shared=shared, renderer=renderer)


def _nothing(relative: Relative) -> Case:
    note = (
        f"nothing was checked: {relative.name} has no renderer, loss term or stage of its own; what it shares with 3DGS"
        " is checked without --extension"
    )
    return Case(relative.name, False, {}, note)
