"""What the gradient proof checks."""

from collections.abc import Mapping

import numpy as np

from minisplat_ref.backends import Backend
from minisplat_ref.extensions.rays.geometry import whiten
from minisplat_ref.extensions.rays.method import TRACED
from minisplat_ref.extensions.rays.reference import meeting_of
from minisplat_ref.mechanisms.rays.blending import Meeting
from minisplat_ref.mechanisms.rays.stages import traced_stages
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.types import Floats


def _meeting_of(fields: Mapping[str, Floats]) -> Meeting:
    opacities = 1 / (1 + np.exp(-fields["opacity_logits"]))
    return meeting_of(whiten(fields["means"], fields["quats"], fields["log_scales"], opacities))


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer of 3D Gaussians."""
    return traced_stages(TRACED, _meeting_of, backend, setting, rng)
