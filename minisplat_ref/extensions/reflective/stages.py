"""The stages of the gradient check: shading surfel by surfel, and pixel by pixel with occlusion."""

from functools import partial

import numpy as np

from minisplat_ref.extensions.reflective.method import SHADED
from minisplat_ref.mechanisms.gbuffer.population import PER_SURFEL, WITH_OCCLUSION
from minisplat_ref.mechanisms.gbuffer.renderer import render
from minisplat_ref.mechanisms.gbuffer.stages import shading_stage
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return both; the second has the name of the whole renderer and replaces its check."""
    stage_of = partial(
        shading_stage, backend, setting, rng, SHADED, render=partial(render, mirrors=True), shaded=lambda tape: tape
    )
    per_surfel = stage_of(PER_SURFEL)
    no_light = {name: array for name, array in per_surfel.inputs.items() if name not in ("sh_dc", "sh_rest")}
    around = {name: per_surfel.inputs[name] for name in ("sh_dc", "sh_rest")}

    def function(*args: Floats) -> Point:
        named = {**dict(zip(no_light, args, strict=True)), **around}
        return per_surfel.function(*(named[name] for name in per_surfel.inputs))

    def vjp(v_image: Floats, v_alpha: Floats) -> tuple[Floats, ...]:
        found = dict(zip(per_surfel.inputs, per_surfel.vjp(v_image, v_alpha), strict=True))
        return tuple(found[name] for name in no_light)

    alone = per_surfel._replace(name="render, shaded surfel by surfel", inputs=no_light, function=function, vjp=vjp)
    return alone, stage_of(WITH_OCCLUSION)
