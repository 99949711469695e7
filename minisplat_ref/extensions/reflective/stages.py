"""The stages of the gradient check: shading surfel by surfel, and pixel by pixel with what hides the environment."""

import numpy as np

from minisplat_ref.backends import Backend
from minisplat_ref.extensions.reflective.around import light_around
from minisplat_ref.extensions.reflective.method import SHADED
from minisplat_ref.extensions.reflective.population import (
    PER_SURFEL,
    STAGE,
    WITH_OCCLUSION,
)
from minisplat_ref.extensions.reflective.renderer import coefficients, render
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.stages import sides_of as sides_of_shading
from minisplat_ref.mechanisms.surfels.stages import sides_of
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering import Request
from minisplat_ref.types import Floats, Model, RenderOutput, View

ROWS = 4  # of the environment: fewer kinks, and fewer derivatives, than training has


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return both; the second has the name of the whole renderer and takes the place of its check."""
    per_surfel = _stage(backend, setting, rng, PER_SURFEL)
    no_light = {name: array for name, array in per_surfel.inputs.items() if name not in ("sh_dc", "sh_rest")}
    around = {name: per_surfel.inputs[name] for name in ("sh_dc", "sh_rest")}

    def function(*args: Floats) -> Point:
        named = {**dict(zip(no_light, args, strict=True)), **around}
        return per_surfel.function(*(named[name] for name in per_surfel.inputs))

    def vjp(v_image: Floats, v_alpha: Floats) -> tuple[Floats, ...]:
        found = dict(zip(per_surfel.inputs, per_surfel.vjp(v_image, v_alpha), strict=True))
        return tuple(found[name] for name in no_light)

    alone = per_surfel._replace(name="render, shaded surfel by surfel", inputs=no_light, function=function, vjp=vjp)
    return alone, _stage(backend, setting, rng, WITH_OCCLUSION)


def _stage(backend: Backend, setting: Setting, rng: np.random.Generator, stage: int) -> Stage:
    """Return the renderer at a stage of shading; what reflected rays see is held at random values."""
    visibility = rng.uniform(size=(setting.camera.height, setting.camera.width))
    sides: list[np.ndarray] = []

    def watched(model: Model, view: View, request: Request) -> tuple[RenderOutput, object]:
        output, tape = render(model, view, request, visibility, mirrors=True)
        sides[:] = [*sides_of(tape.blend.shown), *sides_of_shading(tape.shading, tape.linear)]
        light = light_around(tape.sight, coefficients(model.gaussians, tape.rows), tape.degree)
        sides.append(light > 0)
        return output, tape

    def shared(scene: object, rng: np.random.Generator) -> dict[str, Floats]:
        return {ENVIRONMENT: np.zeros((ROWS, 2 * ROWS, 3)), STAGE: np.full(1, float(stage))}

    renderer = SHADED.renderer._replace(render=watched)
    made = model_stage(backend, setting, SHADED._replace(renderer=renderer, shared=shared), rng)

    def function(*args: Floats) -> Point:
        point = made.function(*args)
        return Point(point.outputs, (*point.sides, *sides))

    return made._replace(function=function)
