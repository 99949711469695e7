"""Stages of a ray tracer for the gradient proof: the renderer, with the thresholds that its rays cross."""

from collections.abc import Callable, Mapping

import numpy as np

from minisplat_ref.mechanisms.rays.blending import Meeting, list_hits
from minisplat_ref.mechanisms.rays.pixel_rays import pixel_rays
from minisplat_ref.oracle.models import Drawn, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats


def trace_stages(
    representation: Representation,
    meeting_of: Callable[[Mapping[str, Floats]], Meeting],
    backend: Backend,
    setting: Setting,
    rng: np.random.Generator,
) -> tuple[Stage, ...]:
    """Return the renderer; which hits are blended, in which order, and which are clamped, the reference finds out.

    Parameters
    ----------
    representation : Representation
        What is traced.
    meeting_of : callable
        ``meeting_of(fields)``: how rays meet a population, by the names of its fields.
    backend, setting, rng
        As for ``Extension.stages``.
    """

    def sides(drawn: Drawn) -> list[np.ndarray]:
        conventions = setting.conventions
        meeting = meeting_of(drawn.model.gaussians._asdict())
        hits = list_hits(meeting, pixel_rays(drawn.view.camera, conventions), conventions)
        return [hits.offsets, hits.gaussian_ids, hits.unclamped > conventions.alpha_max]

    return (model_stage(backend, setting, representation, rng, sides_of=sides),)
