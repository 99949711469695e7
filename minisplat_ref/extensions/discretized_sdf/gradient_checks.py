"""The stages of the gradient check: shading pixel by pixel with the opacities of distances, and their logits alone."""

from functools import partial

import numpy as np

from minisplat_ref.extensions.discretized_sdf.method import DISTANCED, render
from minisplat_ref.extensions.discretized_sdf.reference import (
    opacity_logits,
    opacity_logits_vjp,
    projected,
    projected_vjp,
)
from minisplat_ref.mechanisms.gbuffer.gradient_checks import shading_stage
from minisplat_ref.mechanisms.gbuffer.population import WITH_OCCLUSION
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the whole renderer, the parameter transform and the projection; the latter are NumPy on every backend."""
    whole = shading_stage(
        backend,
        setting,
        rng,
        DISTANCED,
        WITH_OCCLUSION,
        render=partial(render, mirrors=True),
        shaded=lambda tape: tape.shaded,
    )
    s, log_width = rng.normal(size=7), np.array([-0.4])
    transform = Stage(
        "opacity_logits",
        {"distances": s, "log_width": log_width},
        ("logits",),
        lambda s, w: Point((opacity_logits(s, w),)),
        lambda v: opacity_logits_vjp(s, log_width, v),
    )
    g, own = setting.gaussians, rng.normal(size=len(setting.gaussians.means))
    projection = Stage(
        "projected",
        {"means": g.means, "quats": g.quats, "distances": own},
        ("points",),
        lambda m, q, s: Point((projected(m, q, s),)),
        lambda v: projected_vjp(g.quats, own, v),
    )
    return whole, transform, projection
