"""Stages of the gradient check for shaded surfels, and on which side of its steps a shaded point is."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from minisplat_ref.io.srgb import KNEE
from minisplat_ref.mechanisms.gbuffer.around import light_around
from minisplat_ref.mechanisms.gbuffer.brdf import SIZE
from minisplat_ref.mechanisms.gbuffer.environment import locate
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.population import STAGE
from minisplat_ref.mechanisms.gbuffer.prefilter import KNOTS, Filtered
from minisplat_ref.mechanisms.gbuffer.renderer import ReflectiveTape, coefficients, has_own_colors
from minisplat_ref.mechanisms.gbuffer.shading import Surface, mirror_rays
from minisplat_ref.mechanisms.surfels import gradient_checks as of_surfels
from minisplat_ref.oracle.models import Drawn, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, RenderOutput, Scene

ROWS = 4  # of the environment: fewer kinks, and fewer derivatives, than training has


def sides_of(surface: Surface, light: Filtered, linear: Floats) -> list[np.ndarray]:
    """Return the texels that are read of every map, the cells of both tables, and the sides of all clamps.

    Parameters
    ----------
    surface, light
        The arguments of :func:`minisplat_ref.mechanisms.gbuffer.shading.shade`.
    linear : ndarray of shape (P, 3)
        The colours that it returned, before the curve of sRGB.
    """
    cosines, r = mirror_rays(surface)
    sides = [locate(r, *image.shape[:2]).texels for image in light.maps]
    rows = [r @ (0, 0, 1.0) > np.cos(np.pi * (0.5 / len(image))) for image in light.maps]  # beyond the first
    rows += [r @ (0, 0, -1.0) > np.cos(np.pi * (0.5 / len(image))) for image in light.maps]
    cells = [np.floor(x * (SIZE - 1)) for x in (cosines, surface.roughness)]
    return [*sides, *rows, np.searchsorted(KNOTS, surface.roughness), *cells, cosines > 0, linear > KNEE]


def shading_stage(
    backend: Backend,
    setting: Setting,
    rng: np.random.Generator,
    representation: Representation,
    stage: int,
    *,
    render: Callable[..., tuple[RenderOutput, Any]],
    shaded: Callable[[Any], ReflectiveTape],
    further: Callable[[Drawn], Sequence[np.ndarray]] = lambda drawn: (),
    fixed: Sequence[str] = (),
) -> Stage:
    """Return a renderer at a stage of shading; the light along reflected rays has fixed random values.

    Parameters
    ----------
    backend, setting, rng
        As for :func:`minisplat_ref.oracle.models.model_stage`.
    representation : Representation
        Of shaded surfels.
    stage : int
        Of shading.
    render : callable
        ``render(model, view, request, visibility)``, that of the representation.
    shaded : callable
        Returns of the renderer's tape that of the shading.
    further : callable
        Returns the sides of the representation's own kinks.
    fixed : sequence of str
        As for :func:`minisplat_ref.oracle.models.model_stage`.
    """
    visibility = rng.uniform(size=(setting.camera.height, setting.camera.width))

    def sides(drawn: Drawn) -> list[np.ndarray]:
        tape = shaded(drawn.tape)
        surface, light, *_ = tape.shading
        g, own = drawn.model.gaussians, list(further(drawn))
        if has_own_colors(g):
            own.append(light_around(tape.sight, coefficients(g, tape.rows)) > 0)
            own.append(tape.blend.shown.colors[:, :3] > 0)  # own colours
        return [*of_surfels.sides_of(tape.blend.shown), *sides_of(surface, light, tape.linear), *own]

    def shared(scene: Scene, rng: np.random.Generator) -> dict[str, Floats]:
        first = dict(representation.shared(scene, rng))
        light = rng.normal(size=(ROWS, 2 * ROWS, 3))  # of contrast: without it, roughness would hardly matter
        return {**first, ENVIRONMENT: light, STAGE: np.full(1, float(stage))}

    renderer = representation.renderer._replace(render=partial(render, visibility=visibility))
    held = representation._replace(renderer=renderer, shared=shared)
    return model_stage(backend, setting, held, rng, sides_of=sides, fixed=fixed)
