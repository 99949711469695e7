"""The stages of the gradient check of a representation of surfels: all channels, and the measures along rays."""

import numpy as np

from minisplat_ref.constants import MEDIAN_TRANSMITTANCE
from minisplat_ref.mechanisms.surfels.projection import GSPLAT, SurfelGradient, Surfels, project, project_vjp
from minisplat_ref.mechanisms.surfels.renderer import CHANNELS, Shown, list_tiles
from minisplat_ref.mechanisms.surfels.response import Layout, surfel_response
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import POSE, Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Primitives


def renderer_stage(
    backend: Backend, setting: Setting, representation: Representation, rng: np.random.Generator
) -> Stage:
    """Return the renderer with all its channels as a stage whose points record on which side of its steps they are."""
    wants = frozenset(CHANNELS)
    return model_stage(
        backend, setting, representation, rng, wants=wants, sides_of=lambda drawn: sides_of(drawn.tape.shown)
    )


def rays_stage(backend: Backend, setting: Setting, rng: np.random.Generator) -> Stage:
    """Return median depth and distortion by gsplat's rules as a function of activated surfels, and of given depths."""
    g, camera, conventions = setting.gaussians, setting.camera, setting.conventions
    primitives = Primitives(g.means, g.quats, np.exp(g.log_scales), 1 / (1 + np.exp(-g.opacity_logits)))
    depths = rng.uniform(1, 2, size=len(g.means))
    inputs = {**primitives._asdict(), "depths": depths, **setting.pose}

    def shown_of(named: dict[str, Floats]) -> tuple[Primitives, Shown]:
        moved = camera._replace(cam_from_world_R=named[POSE[0]], cam_from_world_t=named[POSE[1]])
        p = Primitives(*(named[name] for name in Primitives._fields))
        surfels = project(p, moved, conventions, GSPLAT)
        bins = list_tiles(surfels, moved, conventions, REFERENCE)
        no_colors = np.zeros((len(depths), 0))
        given = surfels._replace(depths=named["depths"] * (surfels.radii[:, 0] > 0))
        return p, Shown(given, no_colors, np.zeros(0), bins, conventions, backend, Layout())

    def function(*args: Floats) -> Point:
        _, shown = shown_of(dict(zip(inputs, args, strict=True)))
        measures = shown.measure_rays()
        return Point((measures.median, measures.distortion), (shown.bins.gaussian_ids, *sides_of(shown)))

    def vjp(v_median: Floats, v_distortion: Floats) -> tuple[Floats, ...]:
        p, shown = shown_of(inputs)
        v_T, v_c, v_o, v_z = shown.measure_rays_vjp(shown.measure_rays(), v_median, v_distortion)
        v = project_vjp(
            p, camera, conventions, shown.surfels, SurfelGradient(v_T, v_c, v_o, 0 * v_z, np.zeros((len(v_z), 3)))
        )
        of_pose = (v.cam_from_world_R, v.cam_from_world_t)
        return (v.means, v.quats, v.scales, v.opacities, v_z, *of_pose)

    return Stage("rays", inputs, ("median", "distortion"), function, vjp)


def sides_of(shown: Shown) -> list[np.ndarray]:
    """Return on which side of each step the hits of a view are, as the reference computes them.

    Hits are blended or not, and clamped or not; they meet a disc or its low-pass; they are in front of the median or
    behind it.
    """
    surfels: Surfels = shown.surfels
    sides = [shown.bins.gaussian_ids, surfels.radii[:, 0] > 0]
    for tile in tile_hits(surfels, shown.bins, shown.conventions, surfel_response(shown.layout)):
        is_in_front = tile.transmittances[:-1] > MEDIAN_TRANSMITTANCE
        sides += [side.ravel() for side in (tile.alphas > 0, tile.is_clamped, tile.hit.place.is_met, is_in_front)]
    return sides
