"""Save one view of one iteration with everything that its numbers depend on, to recompute them elsewhere."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.io.checkpoint import load_checkpoint, save_checkpoint
from minisplat_ref.rendering import Request
from minisplat_ref.training.adam import named_fields
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import Camera, Floats, Model, Optics, Scene, View

_KIND = "case"  # distinguishes the file from a checkpoint


class Case(NamedTuple):
    """One view of one iteration."""

    step: int
    model: Model
    view: View
    scene: Scene
    """A loss term may use its points and its extent."""
    request: Request
    recipe: Recipe
    """Its renderer and loss terms."""

    @property
    def terms(self) -> Sequence[LossTerm]:
        """Return the loss terms that are due."""
        return self.recipe.due_terms(self.step)


def save_case(path: Path, case: Case, wrong: str, settings: Mapping[str, Any]) -> None:
    """Write a case.

    Parameters
    ----------
    path : Path
    case : Case
    wrong : str
        Description of what is wrong in it.
    settings : mapping
        Of the run; anything that JSON can hold. Empty unless the run was started from the command line.
    """
    view, request, camera, degree = case.view, case.request, case.view.camera, case.request.sh_degree
    optional = {
        "view.mask": view.mask,
        "view.point_ids": view.point_ids,
        "request.background": request.background,
        "request.is_visible": request.is_visible,
        "request.sh_degree": degree if isinstance(degree, np.ndarray) else None,
    }
    arrays = {
        **{f"gaussians.{name}": array for name, array in named_fields(case.model.gaussians).items()},
        **{f"shared.{name}": array for name, array in case.model.shared.items()},
        "view.image": view.image,
        "view.R": camera.cam_from_world_R,
        "view.t": camera.cam_from_world_t,
        "scene.points": case.scene.points,
        "scene.background": case.scene.background,
        **{name: array for name, array in optional.items() if array is not None},
    }
    metadata = {
        "kind": _KIND,
        "step": case.step,
        "wrong": wrong,
        "settings": dict(settings),
        "recipe": [case.recipe.name, case.recipe.iterations],
        "view": {"name": view.name, "view_id": view.view_id, "time": view.time},
        "intrinsics": [float(value) for value in camera[2:8]],
        "optics": None if camera.optics is None else [camera.optics.model, camera.optics.coefficients],
        "extent": float(case.scene.extent),
        "request": {
            "sh_degree": None if isinstance(degree, np.ndarray) else degree,
            "conventions": request.conventions._asdict(),
            "wants": sorted(request.wants),
            "opacity_factor": request.opacity_factor,
        },
    }
    save_checkpoint(path, arrays, metadata)


class SavedCase(NamedTuple):
    """The contents of a file; the caller, which knows where recipes are, supplies the recipe."""

    arrays: Mapping[str, Any]
    metadata: Mapping[str, Any]

    @property
    def wrong(self) -> str:
        """Return what was found to be wrong."""
        return self.metadata["wrong"]

    def of(self, recipe: Recipe) -> Case:
        """Return the case, with the recipe's type of population."""
        arrays, about, request = self.arrays, self.metadata["view"], self.metadata["request"]
        fx, fy, cx, cy, width, height = self.metadata["intrinsics"]
        optics = self.metadata.get("optics")  # of a file without it: none
        optics = None if optics is None else Optics(optics[0], tuple(optics[1]))
        camera = Camera(arrays["view.R"], arrays["view.t"], fx, fy, cx, cy, int(width), int(height), optics)
        view = View(image=arrays["view.image"], camera=camera, mask=None, **about)
        view = view._replace(mask=arrays.get("view.mask"), point_ids=arrays.get("view.point_ids"))
        points = arrays["scene.points"]
        colors = np.zeros(points.shape, np.uint8)
        scene = Scene(view.name, (view,), (), points, colors, arrays["scene.background"], self.metadata["extent"])
        return Case(
            self.metadata["step"],
            Model(recipe.representation.population(**self._group("gaussians")), self._group("shared")),
            view,
            scene,
            Request(
                arrays.get("request.background"),
                arrays.get("request.sh_degree", request["sh_degree"]),
                Conventions(**request["conventions"]),
                is_visible=arrays.get("request.is_visible"),
                opacity_factor=request.get("opacity_factor", 1.0),  # of a file without it: none
                wants=frozenset(request["wants"]),
            ),
            recipe,
        )

    def _group(self, name: str) -> dict[str, Floats]:
        return {key.removeprefix(f"{name}."): a for key, a in self.arrays.items() if key.startswith(f"{name}.")}


def load_case(path: str | Path) -> SavedCase:
    """Read what :func:`save_case` wrote.

    Raises
    ------
    InputError
        The file is missing, damaged, or not a case.
    """
    arrays, metadata = load_checkpoint(path)
    if metadata.get("kind") != _KIND:
        raise InputError(f"{path} is no case of bad numbers: give a file that a training has written when it stopped")
    return SavedCase(arrays, metadata)
