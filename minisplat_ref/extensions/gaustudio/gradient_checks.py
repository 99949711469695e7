"""The stages of the gradient check: Gaussians before small backgrounds. Surfels are checked by their own extension."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from minisplat_ref.extensions.gaustudio import backgrounds, representations
from minisplat_ref.extensions.gaustudio.backgrounds import Background, white_ball
from minisplat_ref.extensions.gaustudio.method import STUDIO, render
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.sky import SKY, clear_sky
from minisplat_ref.types import Floats

SMALL: dict[str, Floats] = {
    "ball": white_ball(24).astype(float),
    "sky_map": np.full((4, 8, 3), 0.5),
    "harmonics": clear_sky(0)[SKY].astype(float),
}


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the stages; the first replaces that of the renderer as a whole, whose ball is larger."""
    chosen = [
        composed(STUDIO.name, backgrounds.ball),
        composed("gaustudio, harmonics", backgrounds.harmonics),
        composed("gaustudio, map", backgrounds.sky_map),
    ]
    return tuple(model_stage(backend, setting, representation, rng) for representation in chosen)


def composed(name: str, background: Callable[[], Background]) -> Representation:
    """Return the representation with this background, whose parameter is small."""

    def shared(scene: object, rng: object) -> Mapping[str, Floats]:
        return {SKY: SMALL[background.__name__]}

    drawn = partial(render, representation=representations.gaussians, background=background)
    return STUDIO._replace(name=name, shared=shared, renderer=STUDIO.renderer._replace(render=drawn))
