"""The stage of the gradient check of Gaussians with a payload: their renderer with the thresholds of their hits."""

from collections.abc import Callable

import numpy as np

from minisplat_ref.oracle.models import Drawn, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.hits import TileHits, tile_hits
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats


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

    def sides(drawn: Drawn) -> list[np.ndarray]:
        footprints, coefficients, _, bins = drawn.tape.blended
        tiles = tile_hits(footprints, bins, setting.conventions, drawn.tape.payload.response)
        return [bins.gaussian_ids, *(side for tile in tiles for side in sides_of(tile, coefficients))]

    return model_stage(backend, setting, representation, rng, wants=wants, sides_of=sides)
