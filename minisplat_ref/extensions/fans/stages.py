"""Stages for the gradient proof: the renderer, with the layers of every pixel as its thresholds."""

import numpy as np

from minisplat_ref.extensions.fans.method import FANS_OF_GAUSSIANS, render
from minisplat_ref.extensions.fans.shapes import Fans
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import POSE, Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import Floats, Model, view_from


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer; which triangles a pixel meets, and in which order, is found by the reference."""
    stage = model_stage(backend, setting, FANS_OF_GAUSSIANS, rng)

    def function(*args: Floats) -> Point:
        point, named = stage.function(*args), dict(zip(stage.inputs, args, strict=True))
        R, t = (named[name] for name in POSE)
        view = view_from(setting.camera._replace(cam_from_world_R=R, cam_from_world_t=t))
        request = Request(named["background"], conventions=setting.conventions, backend=REFERENCE)
        _, tape = render(Model(Fans(*(named[name] for name in Fans._fields))), view, request)
        found = tape.peeled.tape.fragments
        return Point(point.outputs, (*point.sides, found.pixels, found.faces))

    return (stage._replace(function=function),)
