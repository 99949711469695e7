"""Stages for the gradient proof: the renderer, with the layers of every pixel as its thresholds."""

import numpy as np

from minisplat_ref.extensions.fans.method import FANS_OF_GAUSSIANS, render
from minisplat_ref.oracle.models import Drawn, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import REFERENCE, Backend


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer; which triangles a pixel meets, and in which order, is found by the reference."""

    def sides(drawn: Drawn) -> list[np.ndarray]:
        _, tape = render(drawn.model, drawn.view, drawn.request._replace(backend=REFERENCE))
        found = tape.peeled.tape.fragments
        return [found.pixels, found.faces]

    return (model_stage(backend, setting, FANS_OF_GAUSSIANS, rng, sides_of=sides),)
