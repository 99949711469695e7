"""The stage of the gradient check: the renderer with the thresholds of its integrals."""

import numpy as np

from minisplat_ref.extensions.analytic.method import INTEGRATED
from minisplat_ref.extensions.analytic.reference import RESPONSE
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import POSE, Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import Floats, TileGrid


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer as a stage whose points record which integrals are blended and which are clamped.

    The reference computes these records again, so that the check notices a step across a threshold; those of the
    core's stages are about values at pixel centres.
    """
    stage = model_stage(backend, setting, INTEGRATED, rng)
    conventions = setting.conventions._replace(eps2d=0.0)
    camera = setting.camera
    grid = TileGrid(camera.width, camera.height, REFERENCE.tile_width, REFERENCE.tile_height)

    def function(*args: Floats) -> Point:
        point, named = stage.function(*args), dict(zip(stage.inputs, args, strict=True))
        R, t = (named[name] for name in POSE)
        moved = camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        opacities = 1 / (1 + np.exp(-named["opacity_logits"]))
        scales = np.exp(named["log_scales"])
        projection = REFERENCE.project(named["means"], named["quats"], scales, opacities, moved, conventions)
        bins = REFERENCE.bin_gaussians(projection, grid, conventions)
        tiles = list(tile_hits(projection, bins, conventions, RESPONSE))
        blended = np.concatenate([np.ravel(tile.alphas > 0) for tile in tiles])
        clamped = np.concatenate([np.ravel(tile.is_clamped) for tile in tiles])
        return Point(point.outputs, (*point.sides, bins.gaussian_ids, blended, clamped))

    return (stage._replace(function=function),)
