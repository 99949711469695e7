"""Catch numbers that are not finite where they arise, and name the first by stage, view and row.

One NaN in a gradient is a NaN parameter after the step, and the projection culls what is not finite: the image loses
a Gaussian, and nothing says so. The loss is checked in every iteration, which costs nothing; all parameters and their
gradient every few iterations, and when rows are added or removed. If one of them is not finite, the view is rendered
and differentiated again with a backend that checks every stage: the first whose output is not finite is the culprit.
Its inputs are written to a file, which ``minisplat-ref oracle replay FILE`` runs through every backend.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.rendering import RenderGradient
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.adam import named_fields
from minisplat_ref.training.case import Case, save_case
from minisplat_ref.training.losses import Loss, Rendered, total_loss
from minisplat_ref.types import NOTHING, Floats, Model, RenderOutput

FILE = "bad-numbers-{}.npz"  # of an iteration
PARAMETERS, GRADIENT = "parameters", "gradient"  # what is checked before and after the stages
_WATCHED: dict[str, tuple[str, ...]] = {
    "project": ("means2d", "depths", "conics", "opacities"),
    "sh_colors": ("colors",),
    "composite": ("image", "alpha"),
    "photometric_loss": ("loss",),
    "photometric_loss_vjp": ("image",),
    "composite_vjp": ("means2d", "conics", "opacities", "colors", "background"),
    "sh_colors_vjp": ("means", "sh_dc", "sh_rest"),
    "project_vjp": ("means", "quats", "scales", "opacities"),
}
"""The numeric outputs of every stage; a stage with one output has no name for it."""


class Wrong(NamedTuple):
    """A number that is not finite."""

    stage: str
    """A stage of the backend, ``parameters``, ``gradient``, or an event's name."""
    name: str
    """Of the array; derivatives begin with ``v_``."""
    place: tuple[int, ...]
    """Index of the first such number in the array."""
    value: float
    size: tuple[int, ...]
    """Shape of the array."""

    def __str__(self) -> str:
        """Describe it in half a line."""
        if not self.place:
            return f"{self.stage}: {self.name} is {self.value}"
        if self.name in ("image", "alpha", "v_image"):
            return f"{self.stage}: {self.name} is {self.value} at pixel ({self.place[1]}, {self.place[0]})"
        return f"{self.stage}: {self.name} is {self.value} in row {self.place[0]:,} of {self.size[0]:,}"


def first_wrong(stage: str, arrays: Mapping[str, Any]) -> Wrong | None:
    """Return the first number that is not finite of the first array that has one."""
    for name, array in arrays.items():
        is_wrong = ~np.isfinite(array)
        if is_wrong.any():
            index = tuple(int(i) for i in np.argwhere(is_wrong)[0])
            return Wrong(stage, name, index, float(np.asarray(array)[index]), np.shape(array))
    return None


class Examination(NamedTuple):
    """A view's rendering and gradient, and what is wrong with them."""

    wrong: Wrong | None
    """The first number that is not finite, in the order of computation."""
    loss: Loss
    output: RenderOutput
    gradient: RenderGradient


def examine(case: Case) -> Examination:
    """Render and differentiate a view, and check every stage on the way."""
    renderer = case.recipe.renderer
    found: list[Wrong] = []

    def look(stage: str, arrays: Mapping[str, Any]) -> None:
        if not found and (wrong := first_wrong(stage, arrays)):
            found.append(wrong)

    look(PARAMETERS, _parameters(case.model))
    request = case.request._replace(backend=_watch(case.request.backend, look))
    with np.errstate(all="ignore"):  # the checks report what is wrong
        output, tape = renderer.render(case.model, case.view, request)
        channels = renderer.channels(request.wants)
        rendered = Rendered(output, channels, case.view, case.scene, case.model, case.step, request)
        loss = total_loss(case.terms, rendered)
        look("loss", {"loss": loss.value, "v_image": loss.v_image})
        gradient = renderer.render_vjp(tape, loss.v_image, loss.v_alpha)
    look(GRADIENT, _gradients(gradient, loss))
    return Examination(found[0] if found else None, loss, output, gradient)


def _parameters(model: Model) -> dict[str, Floats]:
    return {**named_fields(model.gaussians), **model.shared}


def _gradients(gradient: RenderGradient, loss: Loss) -> dict[str, Floats]:
    """Return the derivatives with respect to the parameters: those via the image, and the direct ones of loss terms."""
    through_image = {**named_fields(gradient.gaussians), **gradient.shared}
    direct = {f"{name} (direct)": array for name, array in {**loss.v_gaussians, **loss.v_shared}.items()}
    return {f"v_{name}": array for name, array in {**through_image, **direct}.items()}


def _watch(backend: Backend, look: Callable[[str, Mapping[str, Any]], None]) -> Backend:
    """Return the backend with every stage wrapped so that ``look`` sees its outputs."""

    def watched(stage: str) -> Callable[..., Any]:
        function = getattr(backend, stage)

        def watching(*args: Any, **named: Any) -> Any:
            output = function(*args, **named)
            look(stage, dict(_outputs(stage, output)))
            return output

        return watching

    stages: dict[str, Any] = {stage: watched(stage) for stage in _WATCHED}
    return replace(backend, **stages)


def _outputs(stage: str, output: Any) -> Iterator[tuple[str, Any]]:
    """Yield the numeric outputs of a stage by name."""
    names, prefix = _WATCHED[stage], "v_" if stage.endswith("_vjp") else ""
    if len(names) == 1:
        yield prefix + names[0], output[0] if stage == "photometric_loss" else output  # without the loss's tape
    else:
        yield from ((prefix + name, getattr(output, name)) for name in names)


class BadNumbers(InputError):
    """A training was stopped because a number in it was not finite."""


class Guard(NamedTuple):
    """The checks of a training's numbers, and the reaction to one that is not finite."""

    every: int = 10
    """Iterations from one check of parameters and gradient to the next; the loss is checked in every iteration."""
    drops_steps: bool = False
    """Skip the step whose gradient is wrong, and continue; then every iteration is checked."""
    folder: Path | None = None
    """Folder to which the case is written; by default it is not."""
    settings: Mapping[str, Any] = NOTHING
    """Settings of the run, stored in the file for its replay."""

    def is_due(self, step: int) -> bool:
        """Return whether parameters and gradient are checked in iteration ``step``."""
        return self.drops_steps or step % self.every == 0

    def check_step(self, case: Case, loss: Loss, gradient: RenderGradient) -> Wrong | None:
        """Return the number that is not finite if the step must be dropped, None if it may be taken.

        Raises
        ------
        BadNumbers
            A number is wrong and steps are not dropped, or it is a parameter, which dropping a step does not repair.
        """
        is_close = self.is_due(case.step)
        if math.isfinite(loss.value) and not (
            is_close and (first_wrong("", _gradients(gradient, loss)) or first_wrong("", _parameters(case.model)))
        ):
            return None
        wrong = examine(case).wrong or Wrong("loss", "loss", (), loss.value, ())
        if self.drops_steps and wrong.stage != PARAMETERS:
            self._save(case, wrong)
            return wrong
        raise self.stop(case, wrong)

    def check_parameters(self, case: Case, stage: str) -> None:
        """Check the parameters after a step or an event.

        Raises
        ------
        BadNumbers
            One is not finite.
        """
        if wrong := first_wrong(stage, _parameters(case.model)):
            raise self.stop(case, wrong)

    def stop(self, case: Case, wrong: Wrong) -> BadNumbers:
        """Write the case and return the error that names what is wrong."""
        text = f"iteration {case.step}, view {case.view.name}, {wrong}"
        if wrong.stage == PARAMETERS and self.every > 1:
            text += f", since one of the last {self.every} iterations; --check-every 1 finds which"
        if path := self._save(case, wrong):
            text += f"; minisplat-ref oracle replay {path} shows it with every backend"
        return BadNumbers(text)

    def _save(self, case: Case, wrong: Wrong) -> Path | None:
        """Write the case, only the first of many dropped steps, and return where."""
        if self.folder is None or (self.drops_steps and any(self.folder.glob(FILE.format("*")))):
            return None
        path = self.folder / FILE.format(case.step)
        save_case(path, case, str(wrong), self.settings)
        return path
