"""Reflective surfels: the representation, the recipe, and what the gradient check covers.

Population, renderer and the three stages of training are those of :mod:`minisplat_ref.mechanisms.gbuffer`.
"""

from functools import partial

import numpy as np

from minisplat_ref.mechanisms.gbuffer.gradient_checks import shading_stage
from minisplat_ref.mechanisms.gbuffer.population import (
    PER_SURFEL,
    WITH_OCCLUSION,
    ReflectiveSurfels,
    first_light,
    with_materials,
)
from minisplat_ref.mechanisms.gbuffer.renderer import REFLECTIVE, render_reflective
from minisplat_ref.mechanisms.gbuffer.training import (
    ITERATIONS,
    NORMALS,
    OWN_RATES,
    SH_MILESTONES,
    SHADING_EVENTS,
    SHADING_RATES,
)
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation

SHADED = Representation(
    "reflective surfels",
    population=ReflectiveSurfels,
    extend=with_materials,
    shared=first_light,
    renderer=REFLECTIVE,
    rates=SHADING_RATES,
)

RECIPE = GS_ACCEL._replace(
    name="reflective",
    iterations=ITERATIONS,
    learning_rates=GS_ACCEL.learning_rates.change(**OWN_RATES),
    sh_milestones=SH_MILESTONES,
    losses=(*GS_ACCEL.losses, NORMALS),
    events=SHADING_EVENTS,
)
"""``reflective``: surfels shaded one by one up to iteration 18,000, then pixel by pixel, in the end with occlusion."""


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return shading surfel by surfel, and pixel by pixel with occlusion, which replaces the check of the renderer."""
    stage_of = partial(
        shading_stage,
        backend,
        setting,
        rng,
        SHADED,
        render=partial(render_reflective, mirrors=True),
        shaded=lambda tape: tape,
    )
    per_surfel = stage_of(PER_SURFEL, fixed=("sh_dc", "sh_rest", "around_dc", "around_rest"))
    return per_surfel._replace(name="render, shaded surfel by surfel"), stage_of(WITH_OCCLUSION)
