"""Stages for the gradient proof."""

from collections.abc import Mapping

import numpy as np

from minisplat_ref.extensions.rays.geometry import whiten
from minisplat_ref.extensions.rays.method import TRACED
from minisplat_ref.extensions.rays.reference import prepare_meeting
from minisplat_ref.mechanisms.rays.blending import Meeting
from minisplat_ref.mechanisms.rays.gradient_checks import trace_stages
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats


def _prepare_meeting(fields: Mapping[str, Floats]) -> Meeting:
    opacities = 1 / (1 + np.exp(-fields["opacity_logits"]))
    return prepare_meeting(whiten(fields["means"], fields["quats"], fields["log_scales"], opacities))


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer of 3D Gaussians."""
    return trace_stages(TRACED, _prepare_meeting, backend, setting, rng)
