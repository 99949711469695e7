"""Mini-Splatting on tangent planes: the representation, the recipes, and what the gradient check covers.

The renderer is that of :mod:`minisplat_ref.mechanisms.tangent`.
"""

from functools import partial

import numpy as np

from minisplat_ref.mechanisms.tangent.gradient_checks import renderer_stage
from minisplat_ref.mechanisms.tangent.renderer import render_planes, render_planes_vjp
from minisplat_ref.methods.gaussian_splatting import FINE_TUNING
from minisplat_ref.methods.mini_splatting2 import MINI_SPLATTING2
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering import SPLATTING, Renderer
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation

BUFFER = 16  # hits that a pixel sorts in its buffer

HEADSET = Representation(
    "gaussians on tangent planes, sorted in a buffer",
    renderer=Renderer("vr", partial(render_planes, buffer_size=BUFFER), render_planes_vjp, SPLATTING.channels),
)

VR = MINI_SPLATTING2._replace(name="vr")
"""The recipe ``vr``: Mini-Splatting2 on tangent planes, from the first iteration to the last."""

VR_FINE_TUNING = FINE_TUNING._replace(name="vr-fine-tuning", iterations=5_000)
"""The recipe ``vr-fine-tuning``: a finished Mini-Splatting model gets used to its new footprints, as in the paper."""


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer with its buffer as a stage."""
    return (renderer_stage(backend, setting, HEADSET, BUFFER, rng),)
