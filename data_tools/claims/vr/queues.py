"""StopThePop's hierarchy of queues against exact order: which hits come out in the wrong order, and for how much work.

A pixel that sorts all its hits is exact and slow. StopThePop (Radl et al. 2024, arXiv 2402.00525) lets neighbours share
the work. Gaussians stream through four stages, each of which knows their depths on fewer rays than the one before:

- the list of a tile of 16 x 16 pixels, sorted by depth where the Gaussian is strongest in the tile;
- a queue of 64 for each block of 4 x 4 pixels, then one of 8 for each block of 2 x 2, by depth where it is strongest
  in the block;
- a queue of 4 for each pixel, by depth on its ray. What leaves it is blended.

A queue that is full passes on its nearest. A Gaussian enters only the queues of blocks that it touches. Any other order
is the same function with other stages: 3DGS has a list and no queue, the buffer of this extension a list by distance
and one queue of 16 for each pixel, exact order one without a limit.

Work is counted in depths on rays that are evaluated, and in steps of insertion: a new entry moves forward past deeper
ones. Where a Gaussian is strongest is chosen among the pixels' centres; the released code solves for the point. The
sizes of the queues are those of the released code.
"""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import EXACT_ORDER, LIST_ORDER, Conventions
from minisplat_ref.mechanisms.tangent.planes import TangentFootprints
from minisplat_ref.mechanisms.tangent.rays import count_misordered
from minisplat_ref.mechanisms.tangent.renderer import RESPONSE, Prepared
from minisplat_ref.reference.hits import TileHits, is_accepted, tile_hits
from minisplat_ref.types import Bools, Floats, Ints


class Stages(NamedTuple):
    """A way of ordering hits."""

    name: str
    first: str
    """What the tile's list is sorted by: a key of ``FIRST``."""
    queues: tuple[tuple[int, int], ...]
    """(pixels per side of the block, size of its queue), from coarse to fine; the last is that of the pixels."""


SIDES, SIZES = (4, 2, 1), (64, 8, 4)
HIERARCHY = Stages("queues of 4 x 4, 2 x 2 and pixel", "tile", tuple(zip(SIDES, SIZES, strict=True)))
EXACT = Stages("exact order", "distance", ((1, EXACT_ORDER),))
ORDERS = (
    Stages("list by z of the means (3DGS)", "z", ((1, LIST_ORDER),)),
    Stages("list by distance", "distance", ((1, LIST_ORDER),)),
    Stages("list by depth in the tile", "tile", ((1, LIST_ORDER),)),
    HIERARCHY,
    *(Stages(f"buffer of {k} per pixel", "distance", ((1, k),)) for k in (4, 8, 16)),
    EXACT,
)


class Work(NamedTuple):
    """What an order costs and gets wrong, as totals over an image."""

    n_hits: int
    n_depths: int
    """Depths on rays that were evaluated."""
    n_steps: int
    """Entries that new ones passed in queues."""
    n_pairs: int
    """Pairs of hits of a pixel."""
    n_wrong: int
    """Those in the opposite order to their depths."""


class Rays(NamedTuple):
    """The hits of G Gaussians on the P pixels of a tile."""

    is_hit: Bools  # [G, P]
    alphas: Floats  # [G, P]
    depths: Floats  # [G, P] on the ray
    ys: Ints  # [P] in the tile
    xs: Ints  # [P] in the tile

    def depths_in(self, rows: Ints, pixels: Ints) -> Floats:
        """Return depths [G'] of rows where each is strongest among some pixels."""
        strongest = np.argmax(self.alphas[np.ix_(rows, pixels)], axis=1)
        found: Floats = self.depths[rows, pixels[strongest]]
        return found


def pass_queue(keys: Sequence[float], size: int) -> tuple[list[int], int]:
    """Return in which order a queue passes on what enters it, as indices, and the number of steps of insertion.

    Whenever ``size`` entries wait, the one with the least key leaves, of equals the first.
    """
    waiting: list[tuple[float, int]] = []
    passed, n_steps = [], 0
    for i, key in enumerate(keys):
        at = bisect_right(waiting, (key, i))
        n_steps += len(waiting) - at
        waiting.insert(at, (key, i))
        if len(waiting) == size:
            passed.append(waiting.pop(0)[1])
    return passed + [i for _, i in waiting], n_steps


def order_hits(rays: Rays, rows: Ints, queues: Sequence[tuple[int, int]]) -> tuple[list[Ints], int, int]:
    """Return each pixel's hits in the order in which it blends them, and the work.

    Parameters
    ----------
    rays : Rays
    rows : ndarray of shape (G,)
        The list of the tile.
    queues : sequence
        As in :class:`Stages`.

    Returns
    -------
    orders : list of ndarray
        Rows of ``rays``, one array for each pixel.
    n_depths, n_steps : int
        As in :class:`Work`.
    """
    orders: list[Ints] = [np.zeros(0, int)] * len(rays.xs)
    n_depths = n_steps = 0

    def descend(rows: Ints, pixels: Ints, level: int) -> None:
        nonlocal n_depths, n_steps
        side, size = queues[level]
        for block in _blocks(rays, pixels, side):
            touched = rows[rays.is_hit[np.ix_(rows, block)].any(axis=1)]
            if size > LIST_ORDER:
                passed, steps = pass_queue(rays.depths_in(touched, block).tolist(), size)
                touched, n_depths, n_steps = touched[passed], n_depths + len(touched), n_steps + steps
            if level + 1 < len(queues):
                descend(touched, block, level + 1)
            else:
                orders[block[0]] = touched

    descend(rows, np.arange(len(rays.xs)), 0)
    return orders, n_depths, n_steps


def _blocks(rays: Rays, pixels: Ints, side: int) -> Iterator[Ints]:
    """Return the pixels of each block with ``side`` pixels per side."""
    blocks = np.stack([rays.ys[pixels] // side, rays.xs[pixels] // side])
    _, which = np.unique(blocks, axis=1, return_inverse=True)
    which = which.ravel()
    for block in range(which.max(initial=-1) + 1):
        yield pixels[which == block]


def _first_list(first: str, rays: Rays, tile: TileHits, footprints: TangentFootprints) -> Ints:
    """Return the rows of a tile's list, sorted by z or distance of the means, or by depth where strongest in it."""
    if first == "tile":
        keys = rays.depths_in(np.arange(len(tile.ids)), np.arange(len(tile.xs)))
    else:
        keys = {"z": footprints.depths, "distance": footprints.distances}[first][tile.ids]
    return np.argsort(keys, kind="stable")


def draw(prepared: Prepared, orders: Sequence[Stages]) -> tuple[list[Floats], list[Work]]:
    """Return the image [H, W, 3] and the work of each way of ordering the hits of a view."""
    bins, conventions = prepared.listed(), prepared.conventions
    shape = bins.grid.height, bins.grid.width, len(prepared.background)
    images: list[Floats] = [np.zeros(shape) for _ in orders]
    works = [Work(0, 0, 0, 0, 0) for _ in orders]
    unstopped = conventions._replace(transmittance_min=0.0, stops_at_equality=False)  # hits, whatever is before them
    for tile in tile_hits(prepared.footprints, bins, unstopped, RESPONSE):
        corner_y, corner_x = tile.ys.min(), tile.xs.min()
        rays = Rays(tile.alphas > 0, tile.alphas, tile.hit.depths, tile.ys - corner_y, tile.xs - corner_x)
        for k, stages in enumerate(orders):
            rows = _first_list(stages.first, rays, tile, prepared.footprints)
            found, n_depths, n_steps = order_hits(rays, rows, stages.queues)
            n_depths += len(rows) if stages.first == "tile" else 0
            n_pairs, n_wrong = _count(rays, found)
            more = Work(int(rays.is_hit.sum()), n_depths, n_steps, n_pairs, n_wrong)
            works[k] = Work(*(a + b for a, b in zip(works[k], more, strict=True)))
            for p, order in enumerate(found):
                weights = _weights(rays.alphas[order, p], conventions)
                light = weights @ prepared.channels[tile.ids[order]] + (1 - weights.sum()) * prepared.background
                images[k][tile.ys[p], tile.xs[p]] = light
    return images, works


def _count(rays: Rays, orders: list[Ints]) -> tuple[int, int]:
    """Return the pairs of hits of all pixels, and those in the wrong order."""
    n_all = n_wrong = 0
    for p, order in enumerate(orders):
        of_pixel = count_misordered(np.ones((len(order), 1), bool), rays.depths[order, p][:, None])
        n_all, n_wrong = n_all + of_pixel[0], n_wrong + of_pixel[1]
    return n_all, n_wrong


def _weights(alphas: Floats, conventions: Conventions) -> Floats:
    """Return the weights of hits in their order, 0 from the one on that the stop threshold leaves out."""
    after = np.cumprod(1 - alphas)
    weights: Floats = np.where(is_accepted(after, conventions), alphas * np.append(1, after)[:-1], 0)
    return weights
