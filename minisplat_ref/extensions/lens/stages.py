"""The stages of the gradient check: the renderer through a pinhole, through Brown's distortion and a fisheye."""

import numpy as np

from minisplat_ref.extensions.lens.method import THROUGH_LENS
from minisplat_ref.extensions.lens.renderer import prepare
from minisplat_ref.mechanisms.cameras.ray_footprints import RESPONSE
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import POSE, Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import Floats, Gaussians, Model, Optics

OPTICS = (
    None,
    Optics("brown", (-0.2, 0.05, 0.01, 0.02, 0.01, 0.0, 0.01, -0.02)),
    Optics("fisheye", (0.05, -0.02, 0.01, 0.0)),
)


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer with each lens; points record which hits are listed, blended and clamped."""
    return tuple(_stage(backend, setting, optics, rng) for optics in OPTICS)


def _stage(backend: Backend, setting: Setting, optics: Optics | None, rng: np.random.Generator) -> Stage:
    camera = setting.camera._replace(optics=optics)
    bent = setting._replace(camera=camera)
    name = THROUGH_LENS.name if optics is None else f"{THROUGH_LENS.name}, {optics.model}"
    stage = model_stage(backend, bent, THROUGH_LENS._replace(name=name), rng)

    def function(*args: Floats) -> Point:
        point, named = stage.function(*args), dict(zip(stage.inputs, args, strict=True))
        R, t = (named[name] for name in POSE)
        moved = camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        gaussians = Gaussians(*(named[name] for name in Gaussians._fields))
        prepared = prepare(Model(gaussians), moved, Request(conventions=setting.conventions, backend=REFERENCE))
        bins = prepared.listed()
        tiles = list(tile_hits(prepared.footprints, bins, setting.conventions, RESPONSE))
        blended = np.concatenate([np.ravel(tile.alphas > 0) for tile in tiles])
        clamped = np.concatenate([np.ravel(tile.is_clamped) for tile in tiles])
        return Point(point.outputs, (*point.sides, bins.gaussian_ids, blended, clamped))

    return stage._replace(function=function)
