"""Which pixels stand at a threshold, and how much they may change when a hit falls on its other side.

An image is discontinuous where a hit's alpha is ``alpha_min``, where the transmittance reaches the stop, and where two
Gaussians change places in depth; a gradient also where alpha reaches its clamp. Two correct renderers that round
differently disagree there, by up to ``alpha_min`` and more, and no precision but the other one's own mends that. Such
pixels are found in float64 and counted; they are not averaged into an error of arithmetic, nor excused beyond what the
hits at their thresholds can change.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.backends import CPU
from minisplat_ref.constants import Conventions
from minisplat_ref.oracle.tolerances import FLIP_ALPHA, FLIP_CLAMP, FLIP_DEPTH, FLIP_RELATIVE
from minisplat_ref.reference.hits import TileHits, tile_hits
from minisplat_ref.render import RenderTape
from minisplat_ref.types import Bools, Floats, TileGrid


class Thresholds(NamedTuple):
    """What the thresholds can do to each pixel."""

    allowance: Floats
    """[H, W] bound of the change of any channel when hits at thresholds fall on the other side; mostly 0."""
    is_near: Bools
    """[H, W] whether a hit stands at a threshold of the image or of the gradient."""


def thresholds(tape: RenderTape, slack: float = 0.0) -> Thresholds:
    """Find the pixels at a threshold.

    Parameters
    ----------
    tape : RenderTape
        Of a render in float64.
    slack : float
        Relative error of alphas beyond that of float32.

    Returns
    -------
    Thresholds
    """
    splats, camera, conventions = tape.splats, tape.splats.camera, tape.splats.conventions
    # Hits just below alpha_min are hits here, and no pixel is ever finished: the true thresholds are applied below.
    margin = FLIP_ALPHA + slack * conventions.alpha_min
    lenient = conventions._replace(alpha_min=conventions.alpha_min - margin, transmittance_min=0.0)
    projection = CPU.project(*splats.primitives, camera, lenient)
    grid = TileGrid(camera.width, camera.height, CPU.tile_width, CPU.tile_height)
    allowance = np.zeros((camera.height, camera.width))
    is_near = np.zeros((camera.height, camera.width), bool)
    span = max(splats.channels.max(initial=0), splats.background.max(initial=0))  # no two colours differ by more
    for tile in tile_hits(projection, CPU.bin_gaussians(projection, grid, lenient), lenient):
        if len(tile.ids):
            change, has_kink = _of_tile(tile, projection.depths[tile.ids], conventions, slack)
            allowance[tile.ys, tile.xs] = span * change
            is_near[tile.ys, tile.xs] = (change > 0) | has_kink
    return Thresholds(allowance, is_near)


def _of_tile(tile: TileHits, depths: Floats, conventions: Conventions, slack: float) -> tuple[Floats, Bools]:
    """Return for each of P pixels how much light may change, and whether a hit stands at the clamp."""
    alpha_min, stop = conventions.alpha_min, conventions.transmittance_min
    margin = FLIP_ALPHA + slack * alpha_min
    is_skip = (tile.alphas > 0) & (tile.alphas < alpha_min + margin)  # [G, P] on either side
    alphas = np.where(tile.alphas < alpha_min, 0, tile.alphas)
    T = np.cumprod(np.concatenate([np.ones((1, alphas.shape[1])), 1 - alphas]), axis=0)  # [G + 1, P]
    before, after = T[:-1], T[1:]
    # Relative doubt about the transmittance: d ln(1 - alpha) = alpha / (1 - alpha) times the relative error of alpha.
    doubt = FLIP_RELATIVE + np.cumsum(2 * alpha_min * is_skip + slack * alphas / (1 - alphas), axis=0)
    is_open = before > stop * (1 - doubt)
    is_stop = is_open & (tile.alphas > 0) & (np.abs(after / stop - 1) < doubt)
    gaps = np.diff(depths, append=np.inf)[:, None]
    is_tie = (gaps > 0) & (gaps < FLIP_DEPTH * depths[:, None])  # of exactly equal ones the lower row is first
    behind = np.concatenate([alphas[1:], np.zeros_like(alphas[:1])])  # alpha of the next in the list
    is_clamp = is_open & (np.abs(tile.hit.unclamped - conventions.alpha_max) < FLIP_CLAMP)
    change = np.where(is_skip & is_open, before * (alpha_min + margin), 0).sum(axis=0)
    change += np.where(is_tie & is_open, before * alphas * behind, 0).sum(axis=0)
    change += np.where(is_stop, before, 0).max(axis=0)  # all that lies at and behind the hit that may stop
    return change, np.logical_or.reduce(is_clamp, axis=0)
