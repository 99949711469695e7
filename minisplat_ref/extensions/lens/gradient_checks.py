"""The stages of the gradient check: the renderer through a pinhole, through Brown's distortion and a fisheye."""

import numpy as np

from minisplat_ref.extensions.lens.method import THROUGH_LENS
from minisplat_ref.extensions.lens.renderer import prepare
from minisplat_ref.mechanisms.cameras.ray_footprints import RESPONSE
from minisplat_ref.oracle.models import Drawn, hit_sides, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.types import Optics

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

    def sides(drawn: Drawn) -> list[np.ndarray]:
        prepared = prepare(drawn.model, drawn.view.camera, drawn.request._replace(backend=REFERENCE))
        bins = prepared.listed()
        return [bins.gaussian_ids, *hit_sides(tile_hits(prepared.footprints, bins, setting.conventions, RESPONSE))]

    return model_stage(backend, bent, THROUGH_LENS._replace(name=name), rng, sides_of=sides)
