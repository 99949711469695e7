"""Blend statistics of any primitive: the loop of :mod:`.plain`, which sums weights instead of colours.

A pair is a primitive in one tile. Only the thread of the tile writes its numbers and pixels, so the sums over pairs,
which NumPy takes in the order of the lists, have the same bytes at any number of threads::

    pairs [M, 3]     | sum of w | largest w | number of hits |
    changes [M]      | squared change of the image without it |
    state of a row   | T | largest w | its index in the list | its depth | median depth |     eight numbers each

Where pixels sort their hits, a hit's depth replaces its channels in the buffer of :mod:`.hit_buffer`.
"""

import functools
from collections.abc import Callable

import numpy as np

from minisplat_ref.constants import LIST_ORDER, MEDIAN_TRANSMITTANCE
from minisplat_ref.cpu.compositing.hit_buffer import ALPHA, CHANNELS, V_ALPHA, WEIGHT, hit_buffer, hit_rows, walk_sorted
from minisplat_ref.cpu.compositing.pixel_rows import (
    full_transmittance,
    list_rows,
    load_field,
    row_of_tile,
    row_pixels,
)
from minisplat_ref.cpu.compositing.responses import KernelResponse
from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import (
    WIDTH,
    broadcast,
    gather,
    load,
    reduce_any,
    reduce_max,
    reduce_sum,
    scatter,
    select,
    store,
)
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.jit.scheduling import dynamic_range, make_shared_counter
from minisplat_ref.scalar.compositing import blend
from minisplat_ref.scalar.removal import odds, removal_change

BEHIND = WIDTH  # of a state for changes, after the transmittance: light from behind the current hit, by channels
WEIGHT_SUM, WEIGHT_MAX, HITS, N_NUMBERS = range(4)  # of a pair
LARGEST, HEAVIEST, NEAREST, MEDIAN, N_FIELDS = range(1, 6)  # of a state, after the transmittance
_FAR = np.float32(np.inf)
_MEDIAN_TRANSMITTANCE = np.float32(MEDIAN_TRANSMITTANCE)


@functools.cache
def statistics_kernel(response: KernelResponse) -> Callable:
    """Compile the kernel of blend statistics and median depths for a response."""
    hit, hit_row, is_sorted = response.hit, response.hit_row, response.buffer_size > LIST_ORDER

    @scalar
    def blend_one(state, unclamped, depth, frame):
        """Blend one hit in each pixel; keep the depth of the one that takes the transmittance below one half."""
        T = load(state, 0)
        after, weight = blend(T, unclamped, frame)
        is_median = (weight > ZERO) & (T >= _MEDIAN_TRANSMITTANCE) & (after < _MEDIAN_TRANSMITTANCE)
        store(state, MEDIAN * WIDTH, select(is_median, depth, load(state, MEDIAN * WIDTH)))
        store(state, 0, after)
        return weight

    @scalar
    def count(pairs, state, m, weight, depth):
        """Add the weights of one primitive in eight pixels to its numbers; of equal weights the nearest dominates."""
        one = broadcast(state.dtype.type(1))
        pairs[m, WEIGHT_SUM] += reduce_sum(weight)
        pairs[m, WEIGHT_MAX] = max(pairs[m, WEIGHT_MAX], reduce_max(weight))
        pairs[m, HITS] += reduce_sum(select(weight > ZERO, one, ZERO))
        largest, nearest = load(state, LARGEST * WIDTH), load(state, NEAREST * WIDTH)
        to_beat = select(weight > largest, one * _FAR, nearest)
        is_heavier = (weight > ZERO) & (weight >= largest) & (depth < to_beat)
        store(state, LARGEST * WIDTH, select(is_heavier, weight, largest))
        store(state, HEAVIEST * WIDTH, select(is_heavier, one * state.dtype.type(m), load(state, HEAVIEST * WIDTH)))
        store(state, NEAREST * WIDTH, select(is_heavier, depth, nearest))

    @scalar
    def count_row(pairs, state, primitives, row, frame):
        """Blend the members of a row's list, in its order."""
        for m in row.members:
            unclamped, depth, _ = hit_row(hit, primitives, row.ids[m], row)
            depth = broadcast(state.dtype.type(0)) + depth
            weight = blend_one(state, unclamped, depth, frame)
            # In the list's order the first of equal weights is in front, whatever its depth on this ray.
            count(pairs, state, m, weight, broadcast(state.dtype.type(0)))
            if not reduce_any(load(state, 0) > ZERO):
                break

    walk = walk_sorted(response._replace(hit=with_depth(hit), shade=hit_depth), 1, _take(blend_one))

    @scalar
    def count_sorted_row(pairs, buffer, state, primitives, row, buffer_size, frame):
        """Do :func:`count_row` where pixels sort their hits."""
        for h in range(walk(state, buffer, primitives, row, buffer_size, frame)):
            rows = hit_rows(h)
            weight, depth = gather(buffer.hits, rows, WEIGHT), gather(buffer.hits, rows, CHANNELS)
            count(pairs, state, buffer.members[h], weight, depth)

    @kernel()
    def count_tiles(primitives, lists, frame, n_threads, pairs, dominant_ids, median_depth):
        taken = make_shared_counter()
        for _ in prange(n_threads):
            state = np.empty(N_FIELDS * WIDTH, pairs.dtype)
            for tile in dynamic_range(taken, lists.offsets.size - 1):
                first, n_listed = lists.offsets[tile], lists.offsets[tile + 1] - lists.offsets[tile]
                buffer = hit_buffer(n_listed if is_sorted else 0, 1, state.dtype)
                members, counts = list_rows(primitives.boxes, tile, lists, frame)
                for i in range(counts.size):
                    row = row_of_tile(i, tile, members, counts, lists, frame)
                    if row.x >= frame.width or row.y >= frame.height:
                        continue
                    state[:] = ZERO
                    store(state, 0, full_transmittance(row, frame, state.dtype.type))
                    if is_sorted:
                        count_sorted_row(pairs[first:], buffer, state, primitives, row, lists.buffer_size, frame)
                    else:
                        count_row(pairs[first:], state, primitives, row, frame)
                    scatter(median_depth, row_pixels(row, frame), 0, load_field(state, MEDIAN, row, frame))
                    for k in range(min(WIDTH, frame.width - row.x)):
                        if state[LARGEST * WIDTH + k] > ZERO:
                            pixel = row.y * frame.width + row.x + k
                            dominant_ids[pixel] = row.ids[np.int64(state[HEAVIEST * WIDTH + k])]

    return count_tiles


def with_depth(hit: Callable) -> Callable:
    """Return a response's ``hit`` whose place is the depth alone, which :func:`hit_depth` reads."""

    @scalar
    def hit_with_depth(records, n, x, y):
        unclamped, depth, _ = hit(records, n, x, y)
        return unclamped, depth, (depth,)

    return hit_with_depth


@scalar
def hit_depth(colors, n, k, place):
    """Return the depth of a hit in the place of a channel."""
    return place[0]


def _take(blend_one: Callable) -> Callable:
    @scalar
    def take(state, hits, rows, frame):
        """Blend one hit of a buffer in each pixel, and store its weight."""
        scatter(hits, rows, WEIGHT, blend_one(state, gather(hits, rows, ALPHA), gather(hits, rows, CHANNELS), frame))

    return take


@functools.cache
def removal_kernel(response: KernelResponse, n_channels: int) -> Callable:
    """Compile the kernel of the squared changes without each primitive, for a response and a number of channels.

    Each channel keeps its own light from behind the current hit, because the square of a sum over channels would be
    another quantity.
    """
    hit, shade, is_sorted = response.hit, response.shade, response.buffer_size > LIST_ORDER
    hit_row = response.hit_row

    @scalar
    def blend_one(state, unclamped, frame):
        T = load(state, 0)
        after, weight = blend(T, unclamped, frame)
        store(state, 0, after)
        return weight, odds(weight, unclamped, frame)

    @scalar
    def channel_change(state, k, light, hit_odds):
        """Return the squared change of channel k in each pixel without the current hit."""
        behind = load(state, BEHIND + k * WIDTH) - light
        store(state, BEHIND + k * WIDTH, behind)
        q = removal_change(light, hit_odds, behind)
        return q * q

    @scalar
    def remove_from_row(changes, state, primitives, row, frame):
        """Blend the members of a row's list, in its order."""
        for m in row.members:
            n = row.ids[m]
            unclamped, _, place = hit_row(hit, primitives, n, row)
            weight, hit_odds = blend_one(state, unclamped, frame)
            total = broadcast(state.dtype.type(0))
            for k in range(n_channels):
                total = total + channel_change(state, k, weight * shade(primitives.colors, n, k, place), hit_odds)
            changes[m] += reduce_sum(total)
            if not reduce_any(load(state, 0) > ZERO):
                break

    @scalar
    def take(state, hits, rows, frame):
        """Blend one hit of a buffer in each pixel, and store its squared change."""
        weight, hit_odds = blend_one(state, gather(hits, rows, ALPHA), frame)
        total = broadcast(state.dtype.type(0))
        for k in range(n_channels):
            total = total + channel_change(state, k, weight * gather(hits, rows, CHANNELS + k), hit_odds)
        scatter(hits, rows, V_ALPHA, total)

    walk = walk_sorted(response, n_channels, take)

    @kernel()
    def remove_from_tiles(primitives, lists, frame, n_threads, image, changes):
        taken = make_shared_counter()
        for _ in prange(n_threads):
            state = np.empty((1 + n_channels) * WIDTH, image.dtype)
            for tile in dynamic_range(taken, lists.offsets.size - 1):
                first, n_listed = lists.offsets[tile], lists.offsets[tile + 1] - lists.offsets[tile]
                buffer = hit_buffer(n_listed if is_sorted else 0, n_channels, state.dtype)
                members, counts = list_rows(primitives.boxes, tile, lists, frame)
                for i in range(counts.size):
                    row = row_of_tile(i, tile, members, counts, lists, frame)
                    if row.x >= frame.width or row.y >= frame.height:
                        continue
                    store(state, 0, full_transmittance(row, frame, state.dtype.type))
                    for k in range(n_channels):
                        store(state, BEHIND + k * WIDTH, gather(image, row_pixels(row, frame), k))
                    if is_sorted:
                        for h in range(walk(state, buffer, primitives, row, lists.buffer_size, frame)):
                            changes[first + buffer.members[h]] += reduce_sum(gather(buffer.hits, hit_rows(h), V_ALPHA))
                    else:
                        remove_from_row(changes[first:], state, primitives, row, frame)

    return remove_from_tiles
