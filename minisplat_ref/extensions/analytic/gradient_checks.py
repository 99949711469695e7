"""The stage of the gradient check: the renderer with the thresholds of its integrals."""

import numpy as np

from minisplat_ref.extensions.analytic.method import INTEGRATED
from minisplat_ref.extensions.analytic.reference import RESPONSE
from minisplat_ref.oracle.models import Drawn, hit_sides, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import TileGrid


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer as a stage whose points record which integrals are blended and which are clamped.

    The reference computes these records again, so that the check notices a step across a threshold; those of the
    core's stages are about values at pixel centres.
    """
    conventions = setting.conventions._replace(eps2d=0.0)
    camera = setting.camera
    grid = TileGrid(camera.width, camera.height, REFERENCE.tile_width, REFERENCE.tile_height)

    def sides(drawn: Drawn) -> list[np.ndarray]:
        g = drawn.model.gaussians
        opacities, scales = 1 / (1 + np.exp(-g.opacity_logits)), np.exp(g.log_scales)
        projection = REFERENCE.project(g.means, g.quats, scales, opacities, drawn.view.camera, conventions)
        bins = REFERENCE.bin_gaussians(projection, grid, conventions)
        return [bins.gaussian_ids, *hit_sides(tile_hits(projection, bins, conventions, RESPONSE))]

    return (model_stage(backend, setting, INTEGRATED, rng, sides_of=sides),)
