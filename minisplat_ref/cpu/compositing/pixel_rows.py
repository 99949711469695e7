"""Rows of eight pixels, which are processed together, and the bundles that the plain kernels read and write."""

from typing import NamedTuple

import numpy as np

from minisplat_ref.cpu.gaussian_rows import eight_rows
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import WIDTH, broadcast, gather, iota, load, select
from minisplat_ref.jit.literals import HALF, ONE, ZERO
from minisplat_ref.types import Floats, Ints

NO_RAYS = np.zeros((0, 0))  # float64


class KernelPrimitives(NamedTuple):
    """The primitives, as the kernels read them."""

    records: Floats  # [N, F] of the response
    colors: Floats  # [N, S] coefficients of D channels
    boxes: Ints  # [N, 4] pixels x0, y0, x1, y1, half-open
    rays: Floats = NO_RAYS  # [3 H, W + 7] directions of pixels, for responses that read them


class Lists(NamedTuple):
    """The primitives of every tile, and the size of a pixel's sorting buffer."""

    offsets: Ints  # [n_tiles + 1] tile t owns ids[offsets[t] : offsets[t + 1]]
    ids: Ints  # [M] nearest first
    slots: Ints  # [M] index of each pair when the pairs are grouped by primitive
    tile_width: int  # pixels
    tile_height: int  # pixels
    buffer_size: int  # hits


class Pixels(NamedTuple):
    """An image and its accumulated opacity, or the derivative of the loss with respect to them."""

    image: Floats  # [H * W, D]
    alpha: Floats  # [H * W, 1]


class Row(NamedTuple):
    """Eight pixels of a line, and the primitives that may hit them."""

    x: int  # column of the first
    y: int  # line
    ids: Ints  # [M] list of the tile, nearest first
    members: Ints  # [n] indices into ``ids`` of the primitives whose box contains one of the pixels


@scalar
def start_tile(tile, lists, frame):
    """Return column and line of a tile's first pixel, and its number of rows of eight per line."""
    n_tiles_x = (frame.width + lists.tile_width - 1) // lists.tile_width
    x0, y0 = tile % n_tiles_x * lists.tile_width, tile // n_tiles_x * lists.tile_height
    return x0, y0, (lists.tile_width + WIDTH - 1) // WIDTH


@scalar
def list_rows(boxes, tile, lists, frame):
    """Distribute a tile's list ``ids`` to its rows of eight pixels.

    Returns
    -------
    members : ndarray of shape (n_rows, M)
        Indices into ``ids`` [M] of the primitives whose box contains a pixel of the row, in the list's order.
    counts : ndarray of shape (n_rows,)
        How many of them there are.
    """
    ids = lists.ids[lists.offsets[tile] : lists.offsets[tile + 1]]
    x0, y0, n_per_line = start_tile(tile, lists, frame)
    x_end, y_end = min(x0 + lists.tile_width, frame.width), min(y0 + lists.tile_height, frame.height)
    members = np.empty((lists.tile_height * n_per_line, ids.size), np.int32)
    counts = np.zeros(lists.tile_height * n_per_line, np.int64)
    for m in range(ids.size):
        n = ids[m]
        first, end = (max(boxes[n, 0], x0) - x0) // WIDTH, (min(boxes[n, 2], x_end) - x0 + WIDTH - 1) // WIDTH
        for y in range(max(boxes[n, 1], y0), min(boxes[n, 3], y_end)):
            for row in range((y - y0) * n_per_line + first, (y - y0) * n_per_line + end):
                members[row, counts[row]] = m
                counts[row] += 1
    return members, counts


@scalar
def row_of_tile(i, tile, members, counts, lists, frame):
    """Return row i of a tile, which may lie outside of the image; the others are what :func:`list_rows` returned.

    A generator of rows would read better, but Numba never frees the arrays that a generator holds.
    """
    x0, y0, n_per_line = start_tile(tile, lists, frame)
    ids = lists.ids[lists.offsets[tile] : lists.offsets[tile + 1]]
    return Row(x0 + i % n_per_line * WIDTH, y0 + i // n_per_line, ids, members[i, : counts[i]])


@scalar
def row_pixels(row, frame):
    """Return the flat indices of a row's pixels in the image; those beyond its edge repeat the last."""
    first = row.y * frame.width + row.x
    return eight_rows(first, first + min(WIDTH, frame.width - row.x))


@scalar
def load_field(state, k, row, frame):
    """Return field k of ``state`` [n_fields * 8]; pixels beyond the image's edge repeat the last."""
    return gather(state, eight_rows(k * WIDTH, k * WIDTH + min(WIDTH, frame.width - row.x)), 0)


@scalar
def full_transmittance(row, frame, as_data):
    """Return one, and minus one for pixels beyond the image's edge, which marks them finished."""
    return select(iota(as_data(0)) < as_data(frame.width - row.x), broadcast(as_data(1)), -ONE)


@scalar
def hit_row(hit, primitives, n, row):
    """Return the response's ``hit``, with alpha 0 in pixels outside the box."""
    as_data = primitives.records.dtype.type
    xs = iota(as_data(0)) + (as_data(row.x) + HALF)  # pixel centres
    unclamped, depth, place = hit(primitives.records, n, xs, as_data(row.y) + HALF)
    is_in_box = (xs > primitives.boxes[n, 0]) & (xs < primitives.boxes[n, 2])
    return select(is_in_box, unclamped, ZERO), depth, place


@scalar
def hit_ray_row(hit, primitives, n, row):
    """Do :func:`hit_row` for a response that takes the pixels' rays, three components, in place of x."""
    as_data = primitives.records.dtype.type
    xs = iota(as_data(0)) + (as_data(row.x) + HALF)
    line = 3 * row.y
    x, y = load(primitives.rays[line], row.x), load(primitives.rays[line + 1], row.x)
    ray = x, y, load(primitives.rays[line + 2], row.x)
    unclamped, depth, place = hit(primitives.records, n, ray, as_data(row.y) + HALF)
    is_in_box = (xs > primitives.boxes[n, 0]) & (xs < primitives.boxes[n, 2])
    return select(is_in_box, unclamped, ZERO), depth, place
