"""Per-pixel sorting: a buffer of waiting hits, from which each pixel takes the nearest.

For a row of eight pixels a loop over the tile's list writes down every hit; the waiting hits are a queue of their
indices, which each of the eight pixels sorts by its own depths::

    hits   [M * 8, F]  row 8 h + i: hit h in pixel i | alpha | v_alpha | weight | D channels |
    queue  [M, 2, 8]   depths and rows of hits       | taken ... | first: nearest | ... | end: farthest |

A new hit is inserted at the end and moves forward past deeper ones. When ``buffer_size`` hits wait, or the list has
ended, the first is taken. In a pixel that the primitive misses, the hit has depth -infinity: it is taken next, has no
effect, and uses no room in the pixel's buffer.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.cpu.gaussian_rows import eight_rows
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, iota, load, reduce_any, scatter, select, store
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.types import Floats, Ints

ALPHA, V_ALPHA, WEIGHT, CHANNELS = range(4)  # columns of a hit
MISSED = np.float32(-np.inf)  # depth


class HitBuffer(NamedTuple):
    """The hits of a row of eight pixels."""

    hits: Floats  # [M * 8, CHANNELS + D]
    queue: Floats  # [M * 2 * 8]
    members: Ints  # [M] index in the tile's list of each hit


@scalar
def hit_buffer(n, n_channels, as_data):
    """Return a buffer for a list of ``n`` primitives."""
    hits = np.empty((n * WIDTH, CHANNELS + n_channels), as_data)
    return HitBuffer(hits, np.empty(n * 2 * WIDTH, as_data), np.empty(n, np.int64))


@scalar
def hit_rows(h):
    """Return the eight rows of hit ``h``."""
    return eight_rows(h * WIDTH, (h + 1) * WIDTH)


@scalar
def enqueue(queue, first, end, depth, row):
    """Insert eight hits into ``queue``, which occupies the positions [first, end)."""
    at = end
    while at > first:
        other = load(queue, (at - 1) * 2 * WIDTH)
        is_deeper = other > depth  # of equals, the first in the list stays the first
        if not reduce_any(is_deeper):
            break
        other_row = load(queue, (at - 1) * 2 * WIDTH + WIDTH)
        store(queue, at * 2 * WIDTH, (select(is_deeper, other, depth), select(is_deeper, other_row, row)))
        depth, row = select(is_deeper, depth, other), select(is_deeper, row, other_row)
        at -= 1
    store(queue, at * 2 * WIDTH, (depth, row))


@scalar
def load_queued(queue, at):
    """Return the eight rows of hits at a position of ``queue``."""
    i = at * 2 * WIDTH + WIDTH
    near = np.int64(queue[i]), np.int64(queue[i + 1]), np.int64(queue[i + 2]), np.int64(queue[i + 3])
    far = np.int64(queue[i + 4]), np.int64(queue[i + 5]), np.int64(queue[i + 6]), np.int64(queue[i + 7])
    return (*near, *far)


def walk_sorted(response: KernelResponse, n_channels: int, take: Callable) -> Callable:
    """Return a function that passes the hits of a row to ``take``, nearest first, and returns their number.

    ``take(state, hits, rows, frame)`` reads and changes ``state``, whose first eight numbers are the transmittances.
    """
    hit, shade, hit_row = response.hit, response.shade, response.hit_row

    @scalar
    def walk(state, buffer, primitives, row, buffer_size, frame):
        as_data = state.dtype.type
        zero, hits, queue = broadcast(as_data(0)), buffer.hits, buffer.queue
        first = end = 0
        for m in row.members:
            n = row.ids[m]
            unclamped, depth, place = hit_row(hit, primitives, n, row)
            is_hit = unclamped >= frame.alpha_min
            if not reduce_any(is_hit):
                continue
            rows = hit_rows(end)
            scatter(hits, rows, ALPHA, unclamped)
            scatter(hits, rows, V_ALPHA, zero)
            scatter(hits, rows, WEIGHT, zero)
            for k in range(n_channels):
                scatter(hits, rows, CHANNELS + k, zero + shade(primitives.colors, n, k, place))
            buffer.members[end] = m
            enqueue(queue, first, end, select(is_hit, zero + depth, MISSED), iota(as_data(0)) + as_data(end * WIDTH))
            end += 1
            if end - first == buffer_size:
                take(state, hits, load_queued(queue, first), frame)
                first += 1
            if not reduce_any(load(state, 0) > ZERO):
                break
        while first < end and reduce_any(load(state, 0) > ZERO):
            take(state, hits, load_queued(queue, first), frame)
            first += 1
        return end

    return walk
