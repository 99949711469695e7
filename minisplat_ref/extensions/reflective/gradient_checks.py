"""The stages of the gradient check: shading surfel by surfel, and pixel by pixel with occlusion."""

from functools import partial

import numpy as np

from minisplat_ref.extensions.reflective.method import SHADED
from minisplat_ref.mechanisms.gbuffer.gradient_checks import shading_stage
from minisplat_ref.mechanisms.gbuffer.population import PER_SURFEL, WITH_OCCLUSION
from minisplat_ref.mechanisms.gbuffer.renderer import render_reflective
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return both; the second has the name of the whole renderer and replaces its check."""
    stage_of = partial(
        shading_stage,
        backend,
        setting,
        rng,
        SHADED,
        render=partial(render_reflective, mirrors=True),
        shaded=lambda tape: tape,
    )
    per_surfel = stage_of(PER_SURFEL, fixed=("sh_dc", "sh_rest"))
    return per_surfel._replace(name="render, shaded surfel by surfel"), stage_of(WITH_OCCLUSION)
