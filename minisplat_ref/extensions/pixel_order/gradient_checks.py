"""The stages of the gradient check: the renderer, sorted exactly and with a small buffer."""

from functools import partial

import numpy as np

from minisplat_ref.extensions.pixel_order.method import ORDERED
from minisplat_ref.mechanisms.tangent.gradient_checks import renderer_stage
from minisplat_ref.mechanisms.tangent.renderer import render_planes
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend

BUFFER = 4  # hits


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer in both orders as stages."""
    renderer = ORDERED.renderer._replace(render=partial(render_planes, buffer_size=BUFFER))
    buffered = ORDERED._replace(name=f"{ORDERED.name}, buffer of {BUFFER}", renderer=renderer)
    return (
        renderer_stage(backend, setting, ORDERED, None, rng),
        renderer_stage(backend, setting, buffered, BUFFER, rng),
    )
