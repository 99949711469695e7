"""The stage of the gradient check: the renderer with the thresholds of its rays."""

import numpy as np

from minisplat_ref.backends import Backend
from minisplat_ref.extensions.rays.geometry import pixel_rays, whiten
from minisplat_ref.extensions.rays.method import TRACED
from minisplat_ref.extensions.rays.reference import list_hits
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import POSE, Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.types import Floats


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer as a stage whose points record which hits are blended, in which order, and which are clamped.

    The reference computes these records again, so that the check notices a step across a threshold.
    """
    stage = model_stage(backend, setting, TRACED, rng)

    def function(*args: Floats) -> Point:
        point, named = stage.function(*args), dict(zip(stage.inputs, args, strict=True))
        R, t = (named[name] for name in POSE)
        camera = setting.camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        opacities = 1 / (1 + np.exp(-named["opacity_logits"]))
        gaussians = whiten(named["means"], named["quats"], named["log_scales"], opacities)
        hits = list_hits(gaussians, pixel_rays(camera, setting.conventions), setting.conventions)
        is_clamped = hits.unclamped > setting.conventions.alpha_max
        return Point(point.outputs, (*point.sides, hits.offsets, hits.gaussian_ids, is_clamped))

    return (stage._replace(function=function),)
