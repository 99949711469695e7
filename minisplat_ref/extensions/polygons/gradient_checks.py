"""Stages for the gradient proof."""

from collections.abc import Mapping

import numpy as np

from minisplat_ref.extensions.polygons.geometry import polygons_of
from minisplat_ref.extensions.polygons.method import TRACED
from minisplat_ref.extensions.polygons.reference import prepare_meeting
from minisplat_ref.mechanisms.rays.blending import Meeting
from minisplat_ref.mechanisms.rays.gradient_checks import trace_stages
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats, Gaussians


def _prepare_meeting(fields: Mapping[str, Floats]) -> Meeting:
    population = Gaussians(*(fields[name] for name in Gaussians._fields))
    return prepare_meeting(polygons_of(population, 1 / (1 + np.exp(-population.opacity_logits))))


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer of polygons."""
    return trace_stages(TRACED, _prepare_meeting, backend, setting, rng)
