"""The stage of the gradient check: the renderer."""

import numpy as np

from minisplat_ref.extensions.vr.method import BUFFER, HEADSET
from minisplat_ref.mechanisms.tangent.gradient_checks import renderer_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer with its buffer as a stage."""
    return (renderer_stage(backend, setting, HEADSET, BUFFER, rng),)
