"""Each pixel takes its hits in an order of its own: by their depths on its ray, all of them or within a buffer.

The core blends in the order of a tile's list, which is that of the means' depths. StopThePop (Radl et al. 2024) lets
each pixel sort its hits: exactly, or in a k-buffer, from which the nearest is taken whenever it is full. Alphas and
colours are those of any :class:`~minisplat_ref.reference.hits.Response`; the order determines ``T_g``, and which hits
are behind another.

Arrays [G, P] have one row for each primitive of the list, as in :mod:`minisplat_ref.reference.hits`, so that sums over
primitives are taken in the same order whatever the pixels' orders. The functions are the twins of those with the same
names in :mod:`minisplat_ref.cpu.compositing.hits`, whose responses have a ``buffer_size``.
"""

import heapq
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import EXACT_ORDER, LIST_ORDER, Conventions
from minisplat_ref.reference.blend_stats import add_tile_stats, median_depths
from minisplat_ref.reference.compositing import (
    TileGradient,
    add_tile_gradient,
    blend_tile,
    empty_output,
    light_gradient,
)
from minisplat_ref.reference.hits import Response, TileHits, is_accepted, tile_hits, transmit
from minisplat_ref.reference.removal import hit_colors
from minisplat_ref.types import BlendGradient, Bools, Floats, Ints, RenderOutput, TileBins


class Sorted(NamedTuple):
    """A response, and in which order a pixel takes its hits."""

    response: Response
    buffer_size: int = EXACT_ORDER
    """Size of each pixel's k-buffer: when it is full, the pixel takes the nearest of the hits in it.

    ``LIST_ORDER`` = 1 takes hits in the order of the list, ``EXACT_ORDER`` buffers any number.
    """


class SortedHits(NamedTuple):
    """The hits on the pixels of one tile, and their order."""

    tile: TileHits
    """Its rows are in the order of the list; ``transmittances`` are in front of each hit in the order of the pixel."""
    order: Ints
    """[G, P] each pixel takes the primitive of row order[0] first."""


def blending_order(is_hit: Bools, depths: Floats, buffer_size: int) -> Ints:
    """Return for each pixel the rows of its tile's list in the order in which it takes them.

    A pixel reads the list into a buffer of ``buffer_size`` hits; whenever it is full, the pixel takes the nearest, of
    equals the first. Primitives that miss the pixel take no room in the buffer.

    Parameters
    ----------
    is_hit : ndarray of shape (G, P)
        Which rows of the list hit which pixels; the other rows may come anywhere.
    depths : ndarray of shape (G, P)
        Along the pixel's ray.
    buffer_size : int
        ``LIST_ORDER`` to ``EXACT_ORDER``.

    Returns
    -------
    ndarray of shape (G, P)
        A permutation of the rows for each pixel.
    """
    n_rows, n_pixels = is_hit.shape
    if buffer_size == LIST_ORDER:
        return np.broadcast_to(np.arange(n_rows)[:, None], is_hit.shape)
    if buffer_size >= n_rows:
        return np.argsort(np.where(is_hit, depths, np.inf), axis=0, kind="stable")
    order = np.empty((n_rows, n_pixels), dtype=int)
    for pixel in range(n_pixels):
        taken = np.flatnonzero(~is_hit[:, pixel]).tolist()
        waiting: list[tuple[float, int]] = []
        for row in np.flatnonzero(is_hit[:, pixel]).tolist():
            heapq.heappush(waiting, (float(depths[row, pixel]), row))
            if len(waiting) == buffer_size:
                taken.append(heapq.heappop(waiting)[1])
        order[:, pixel] = [*taken, *(row for _, row in sorted(waiting))]
    return order


def sort_by(order: Ints, values: Floats) -> Floats:
    """Return ``values`` [G, P], given by rows of the list, in the pixels' own ``order`` [G, P]."""
    return np.take_along_axis(values, order, axis=0)


def undo_sort_by(order: Ints, values: Floats) -> Floats:
    """Return ``values`` [G, P], given in the pixels' own ``order``, by rows of the list: undo :func:`sort_by`."""
    rows = np.empty_like(values)
    np.put_along_axis(rows, order, values, axis=0)
    return rows


def sort_hits(primitives: Any, bins: TileBins, conventions: Conventions, by: Sorted) -> Iterator[SortedHits]:
    """Evaluate the tiles of an image; see :func:`minisplat_ref.reference.hits.tile_hits`, which stops by the list."""
    unstopped = conventions._replace(transmittance_min=0.0, stops_at_equality=False)
    for tile in tile_hits(primitives, bins, unstopped, by.response):
        order = blending_order(tile.alphas > 0, tile.hit.depths, by.buffer_size)
        in_order = sort_by(order, tile.alphas)
        in_order = np.where(is_accepted(transmit(in_order)[1:], conventions), in_order, 0)
        T = transmit(in_order)  # [G + 1, P]
        T_of_rows = np.concatenate([undo_sort_by(order, T[:-1]), T[-1:]])
        yield SortedHits(tile._replace(alphas=undo_sort_by(order, in_order), transmittances=T_of_rows), order)


def composite_hits(
    response: Sorted,
    primitives: Any,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    *,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> RenderOutput:
    """Blend the primitives of every tile, each pixel in its order.

    Parameters
    ----------
    response : Sorted
        What a primitive does to a pixel, and the order.
    primitives, colors, background, bins, conventions, with_stats, with_median_depth
        As for :func:`minisplat_ref.reference.compositing.composite_hits`.
    """
    output = empty_output(colors, background, bins, with_stats, with_median_depth)
    for tile, order in sort_hits(primitives, bins, conventions, response):
        pixels, shading = (tile.ys, tile.xs), response.response.shading
        output.image[pixels], output.alpha[pixels], weights = blend_tile(tile, colors, background, shading)
        if output.median_depth is not None:
            output.median_depth[pixels] = median_depths(tile)
        if output.stats is not None and len(tile.ids):
            heaviest = np.argmax(sort_by(order, weights), axis=0)  # of equals the first, which is in front
            add_tile_stats(output.stats, tile, weights, order[heaviest, np.arange(order.shape[1])])
    return output


def composite_hits_vjp(
    response: Sorted,
    primitives: Any,
    colors: Floats,
    background: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
    v_output: tuple[Floats, Floats],
) -> BlendGradient:
    """Gradient of :func:`composite_hits`, that of the core with the hits behind each by the pixel's order.

    ::

        behind_g  = sum_{j behind g} w_j (c_j . v) + T_end (v . background - v_alpha)
        v_alpha_g = T_g (c_g . v) - behind_g / (1 - alpha_g)

    Parameters
    ----------
    response, primitives, colors, background, bins, conventions
        As for the forward function.
    output, v_output
        As for :func:`minisplat_ref.reference.compositing.composite_hits_vjp`.
    """
    v_image, v_alpha = v_output
    sums = BlendGradient(
        primitives=tuple(np.zeros_like(getattr(primitives, name)) for name in response.response.fields),
        colors=np.zeros_like(colors),
        background=np.zeros_like(background),
    )
    for tile, order in sort_hits(primitives, bins, conventions, response):
        v, alphas = v_image[tile.ys, tile.xs], tile.alphas  # [P, D], [G, P]
        T, T_end = tile.transmittances[:-1], tile.transmittances[-1]  # [G, P], [P]
        weights = alphas * T
        v_c, v_dot_c, v_place = light_gradient(tile, weights, colors, response.response.shading, v)
        v_T_end = v @ background - v_alpha[tile.ys, tile.xs]  # [P]
        behind = undo_sort_by(order, _suffix_sums(sort_by(order, weights * v_dot_c))) + T_end * v_T_end
        v_alphas = np.where(alphas > 0, T * v_dot_c - behind / (1 - alphas), 0)
        v_tile = TileGradient(v_alphas, v_c, v_place, T_end @ v)
        add_tile_gradient(sums, response.response, primitives, tile, conventions, v_tile)
    return sums


def removal_changes_of_hits(
    response: Sorted,
    primitives: Any,
    colors: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
) -> Floats:
    """Return the squared change of the image without each primitive, in the order in which pixels take their hits.

    Parameters
    ----------
    response, primitives, colors, bins, conventions
        As for :func:`composite_hits`.
    output : RenderOutput
        As for :func:`minisplat_ref.reference.removal.removal_changes`.
    """
    changes = np.zeros(len(colors))
    for tile, order in sort_hits(primitives, bins, conventions, response):
        c = hit_colors(tile, colors, response.response.shading)  # [G, P, D]
        lights = (tile.alphas * tile.transmittances[:-1])[:, :, None] * c  # w_g c_g
        lights = np.take_along_axis(lights, order[:, :, None], axis=0)
        alphas = sort_by(order, tile.alphas)
        B = output.image[tile.ys, tile.xs] - np.cumsum(lights, axis=0)
        q = lights - (alphas / (1 - alphas))[:, :, None] * B
        squares: Floats = np.sum(q**2, axis=2, dtype=np.float64)  # [G, P]
        changes[tile.ids] += undo_sort_by(order, squares).sum(axis=1)
    return changes


def _suffix_sums(terms: Floats) -> Floats:
    """Return for each row the sum [G, P] of the rows after it."""
    sums = np.cumsum(terms[::-1], axis=0)[::-1]  # [G, P] including the row itself
    return np.concatenate([sums[1:], np.zeros_like(terms[:1])])
