"""The stage of the gradient check of Gaussians with a payload: their renderer with the thresholds of their hits."""

from collections.abc import Callable
from typing import Any

import numpy as np

from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.models import model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import TileHits, tile_hits
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Model, RenderOutput, View


def renderer_stage(
    backend: Backend,
    setting: Setting,
    representation: Representation,
    sides_of: Callable[[TileHits, Floats], tuple[np.ndarray, ...]],
    rng: np.random.Generator,
    wants: frozenset[str] = frozenset({"depth"}),
) -> Stage:
    """Return the renderer as a stage whose points record the hits, which the reference computes again.

    Parameters
    ----------
    backend, setting, representation, rng
        As for :func:`minisplat_ref.oracle.models.model_stage`; the renderer is one of
        :func:`minisplat_ref.mechanisms.payload.renderer.payload_renderer`.
    sides_of : callable
        Returns, for a tile's hits and the coefficients [N, S] of the colours, on which sides of thresholds they are.
    wants : frozenset of str
        Channels that are rendered besides RGB.
    """
    sides: list[np.ndarray] = []

    def watched(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
        output, tape = representation.renderer.render(model, view, request._replace(wants=wants))
        footprints, coefficients, _, bins = tape.blended
        tiles = tile_hits(footprints, bins, setting.conventions, tape.payload.response)
        sides[:] = [bins.gaussian_ids, *(side for tile in tiles for side in sides_of(tile, coefficients))]
        return output, tape

    renderer = representation.renderer._replace(render=watched)
    stage = model_stage(backend, setting, representation._replace(renderer=renderer), rng)

    def function(*args: Floats) -> Point:
        point = stage.function(*args)
        return Point(point.outputs, (*point.sides, *sides))

    return stage._replace(function=function)
