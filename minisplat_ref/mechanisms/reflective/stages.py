"""The renderer at one stage of shading as a stage of the gradient check: its points record every kink they are near."""

from collections.abc import Callable
from typing import Any

import numpy as np

from minisplat_ref.backends import Backend
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.stages import sides_of as sides_of_shading
from minisplat_ref.mechanisms.reflective.around import light_around
from minisplat_ref.mechanisms.reflective.population import STAGE
from minisplat_ref.mechanisms.reflective.renderer import coefficients
from minisplat_ref.mechanisms.surfels.stages import sides_of
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering import Request
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Model, RenderOutput, View

ROWS = 4  # of the environment: fewer kinks, and fewer derivatives, than training has


def shading_stage(
    backend: Backend, setting: Setting, representation: Representation, rng: np.random.Generator, stage: int
) -> Stage:
    """Return the renderer at a stage of shading; what reflected rays see is held at random values.

    The representation's renderer takes that as ``visibility``, and its tape is a
    :class:`~minisplat_ref.mechanisms.reflective.renderer.ReflectiveTape`.
    """
    visibility = rng.uniform(size=(setting.camera.height, setting.camera.width))
    sides: list[np.ndarray] = []
    render: Callable[..., tuple[RenderOutput, Any]] = representation.renderer.render

    def watched(model: Model, view: View, request: Request) -> tuple[RenderOutput, object]:
        output, tape = render(model, view, request, visibility)
        sides[:] = [*sides_of(tape.blend.shown), *sides_of_shading(tape.shading, tape.linear)]
        light = light_around(tape.sight, coefficients(model.gaussians, tape.rows), tape.degree)
        sides.append(light > 0)
        return output, tape

    def shared(scene: object, rng: np.random.Generator) -> dict[str, Floats]:
        return {ENVIRONMENT: np.zeros((ROWS, 2 * ROWS, 3)), STAGE: np.full(1, float(stage))}

    renderer = representation.renderer._replace(render=watched)
    made = model_stage(backend, setting, representation._replace(renderer=renderer, shared=shared), rng)

    def function(*args: Floats) -> Point:
        point = made.function(*args)
        return Point(point.outputs, (*point.sides, *sides))

    return made._replace(function=function)
