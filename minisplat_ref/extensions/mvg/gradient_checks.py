"""The stage of the gradient check: the surfels' renderer, which records the side of its steps for each point."""

import numpy as np

from minisplat_ref.mechanisms.surfels.discs import DISCS
from minisplat_ref.mechanisms.surfels.gradient_checks import renderer_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return it; the loss terms need none of their own."""
    return (renderer_stage(backend, setting, DISCS, rng),)
