"""Stages of a ray tracer for the gradient proof: the renderer, with the thresholds that its rays cross."""

from collections.abc import Callable, Mapping

import numpy as np

from minisplat_ref.mechanisms.rays.blending import Meeting, list_hits
from minisplat_ref.mechanisms.rays.pixel_rays import pixel_rays
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import POSE, Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats


def trace_stages(
    representation: Representation,
    meeting_of: Callable[[Mapping[str, Floats]], Meeting],
    backend: Backend,
    setting: Setting,
    rng: np.random.Generator,
) -> tuple[Stage, ...]:
    """Return the renderer; which hits are blended, in which order, and which are clamped, the reference finds out.

    Parameters
    ----------
    representation : Representation
        What is traced.
    meeting_of : callable
        ``meeting_of(fields)``: how rays meet a population, by the names of its fields.
    backend, setting, rng
        As for ``Extension.stages``.
    """
    stage = model_stage(backend, setting, representation, rng)

    def function(*args: Floats) -> Point:
        point, named = stage.function(*args), dict(zip(stage.inputs, args, strict=True))
        R, t = (named[name] for name in POSE)
        camera = setting.camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        hits = list_hits(meeting_of(named), pixel_rays(camera, setting.conventions), setting.conventions)
        is_clamped = hits.unclamped > setting.conventions.alpha_max
        return Point(point.outputs, (*point.sides, hits.offsets, hits.gaussian_ids, is_clamped))

    return (stage._replace(function=function),)
