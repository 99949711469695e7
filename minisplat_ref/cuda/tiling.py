"""Lists of the Gaussians that touch each tile, front to back, as 3DGS section 6 has them.

There a pair has one key, of tile and depth, and pairs are sorted once. Here Gaussians are sorted by depth first, and
their pairs, written in that order, by tile: the same lists, since the sort is stable, but 13 bits of a pair are sorted
instead of 45. The lists of the stage are the reference's, byte for byte; those of a training
(:mod:`minisplat_ref.cuda.passes`) leave out the tiles that an ellipse misses (:mod:`minisplat_ref.cuda.footprints`).

The number of pairs stays on the device. The host provides arrays for a capacity; where there are more pairs, the lists
are empty and nothing is written beyond the arrays. Whoever uses the lists reads the number some time, and makes the
lists again with a larger capacity if it has to.
"""

import functools
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.cuda.arrays import is_on_device, to_device, to_host
from minisplat_ref.cuda.footprints import WHOLE_BOX, has_tile, tiles_of_box
from minisplat_ref.cuda.scanning import start_of_thread, take_block
from minisplat_ref.cuda.sorting import (
    DIGIT_BITS,
    N_DIGITS,
    Digit,
    add_counts,
    clear_counts,
    count_digits,
    plan_digits,
    sort_by_digits,
)
from minisplat_ref.cuda.target import (
    ROW_THREADS,
    WARP,
    check_room,
    cuda,
    device_function,
    float_bits,
    gpu_kernel,
    is_simulated,
    launch,
    launch_rows,
    n_row_blocks,
)
from minisplat_ref.cuda.workspace import GROWTH, Workspace
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.types import Ints, Projection, TileBins, TileGrid

N_ROW_SUMS = ROW_THREADS // WARP + 1  # of the warps of a block, and of all of them
MAX_TILE_DIGITS, MAX_DEPTH_DIGITS = 32 // DIGIT_BITS, 64 // DIGIT_BITS
N_ROWS, N_PAIRS = range(2)  # places in the counters: the Gaussians, and the pairs that fit; after them come all others
CLEARING_BLOCKS = 1 if is_simulated else 1024
FIRST_CAPACITY = 4  # pairs of a Gaussian, before the first pass has counted them
LIST_BYTES = 6 * 4  # per pair: six arrays of int32 (see list_pairs)


class Chain(NamedTuple):
    """Blocks that continue each other's sums: the places of their numbers in the counters."""

    ticket: int
    """Number of blocks that have begun."""
    states: int
    """First place of what blocks publish."""
    totals: int
    """First place of the numbers of keys with each digit, which the blocks count for the sort after them."""
    n_digits: int
    """Digits of each of these keys."""


class Limits(NamedTuple):
    """What a survey has to know of the lists."""

    chain: Chain
    capacity: int
    """Pairs that there is room for."""
    sign: Any
    """The sign bit, as an integer of the size of a depth."""


class Plan(NamedTuple):
    """What is to be listed at most, and the places of all numbers in the counters."""

    n: int
    capacity: int
    """Pairs that there is room for."""
    n_counters: int
    survey: Limits
    depth_digits: tuple[Digit, ...]
    pairs: Chain
    tile_digits: tuple[Digit, ...]


class Survey(NamedTuple):
    """What is known of each Gaussian before the lists are made."""

    offsets: Ints
    """[N + 1] int64; Gaussian n owns the slots [offsets[n], offsets[n + 1])."""
    keys: Ints
    """[N] int32 or int64, whose order, unsigned, is that of the depths."""
    order: Ints
    """[N] int32: 0, 1, 2, ..."""
    tiles: Ints
    """[N] int64 set of the tiles under each box that are listed."""
    counters: Ints
    """int64, see :class:`Plan`."""


class TileLists(NamedTuple):
    """The tiles' lists as kernels read them; see :class:`~minisplat_ref.types.TileBins`."""

    offsets: Ints
    """[n_tiles + 1] tile t owns the pairs [offsets[t], offsets[t + 1])."""
    ids: Ints
    """[capacity] Gaussian of each pair."""
    slots: Ints
    """[capacity] slot of each pair."""


@functools.lru_cache(maxsize=64)
def plan_lists(n: int, capacity: int, n_tiles: int, depth_bits: int) -> Plan:
    """Return the plan for so many Gaussians, pairs and tiles."""
    place = 2  # after the two lengths

    def take(count: int) -> int:
        nonlocal place
        place += count
        return place - count

    depth_digits = plan_digits(take, N_ROWS, n, depth_bits)
    tile_digits = plan_digits(take, N_PAIRS, capacity, (n_tiles - 1).bit_length())
    survey, pairs = (
        Chain(take(1), take(n_row_blocks(n + 1)), digits[0].totals if digits else 0, len(digits))
        for digits in (depth_digits, tile_digits)
    )
    key = np.int32 if depth_bits == 32 else np.int64
    limits = Limits(survey, capacity, key(np.iinfo(key).min))
    return Plan(n, capacity, place, limits, depth_digits, pairs, tile_digits)


@gpu_kernel
def clear_counters(counters, n):
    """Set counters to zero, the first one to the number of Gaussians."""
    for i in range(cuda.grid(1), counters.shape[0], cuda.gridsize(1)):
        counters[i] = n if i == N_ROWS else 0


def start_survey(workspace: Workspace, plan: Plan) -> Survey:
    """Return the arrays of a survey, their counters cleared."""
    n, key_dtype = plan.n, plan.survey.sign.dtype
    survey = Survey(
        workspace.array("offsets", (n + 1,), np.int64),
        workspace.array("depth_keys", (n,), key_dtype),
        workspace.array("order", (n,), np.int32),
        workspace.array("tile_sets", (n,), np.int64),
        workspace.array("counters", (plan.n_counters,), np.int64),
    )
    launch(clear_counters, min(n_row_blocks(plan.n_counters), CLEARING_BLOCKS), ROW_THREADS, survey.counters, n)
    return survey


@device_function
def depth_key(depth, sign):
    """Return an integer whose order, unsigned, is that of the floats; both zeros are equal.

    Positive floats are ordered as their bits, negative ones the opposite way. With the sign flipped, the former come
    after the latter.
    """
    size = float_bits(abs(depth))
    return (-size if depth < ZERO else size) ^ sign


@device_function
def survey_row(n, tiles, count, depth, survey, limits):
    """Enter a thread's Gaussian into the survey; all threads of its block call it, also those without a Gaussian.

    Parameters
    ----------
    n : int
        The Gaussian. One past the last enters the sum of all counts.
    tiles, count : int
        Set of its tiles, and their number.
    depth : float
    survey : Survey
    limits : Limits
    """
    sums = cuda.shared.array(ROW_THREADS, np.int64)
    warp_sums = cuda.shared.array(N_ROW_SUMS, np.int64)
    counts = cuda.shared.array((MAX_DEPTH_DIGITS, N_DIGITS), np.int32)
    offsets, keys, order, tile_sets, counters = survey
    chain, n_rows = limits.chain, order.shape[0]
    clear_counts(counts)
    start = start_of_thread(count, counters, chain.states, n // ROW_THREADS, sums, warp_sums)
    if n < n_rows:
        offsets[n] = start
        order[n] = n
        tile_sets[n] = tiles
        keys[n] = depth_key(depth, limits.sign)
        count_digits(keys[n], chain.n_digits, counts)
    elif n == n_rows:
        offsets[n] = start
        counters[N_PAIRS] = start if start <= limits.capacity else 0
    add_counts(counts, chain.n_digits, counters, chain.totals)


@gpu_kernel
def survey_rows(boxes, depths, survey, limits):
    """Survey one Gaussian of a projection."""
    n = take_block(survey.counters, limits.chain.ticket) * ROW_THREADS + cuda.threadIdx.x
    count, depth = 0, depths.dtype.type(0)
    if n < depths.shape[0]:
        _, _, n_columns, n_rows = tiles_of_box((boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3]))
        count, depth = n_columns * n_rows, depths[n]
    survey_row(n, WHOLE_BOX, count, depth, survey, limits)


@gpu_kernel
def write_pairs(
    boxes,  # [N, 4]
    by_depth,  # [N]
    survey,  # Survey
    chain,
    n_tiles_x,
    ids,  # [capacity] of each slot
    tiles,  # [capacity] of each pair, ordered by depth
    slots,  # [capacity]
):
    """Write the pairs of the Gaussian that is the i-th by depth; its slots are at its offset."""
    sums = cuda.shared.array(ROW_THREADS, np.int64)
    warp_sums = cuda.shared.array(N_ROW_SUMS, np.int64)
    digits = cuda.shared.array((MAX_TILE_DIGITS, N_DIGITS), np.int32)
    offsets, counters = survey.offsets, survey.counters
    if counters[N_PAIRS] == 0:
        return
    block = take_block(counters, chain.ticket)
    clear_counts(digits)
    i = block * ROW_THREADS + cuda.threadIdx.x
    n, count = 0, np.int64(0)
    if i < by_depth.shape[0]:
        n = by_depth[i]
        count = offsets[n + 1] - offsets[n]
    start = start_of_thread(count, counters, chain.states, block, sums, warp_sums)
    if count > 0:
        column, row, n_columns, n_rows = tiles_of_box((boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3]))
        place, slot = start, offsets[n]
        for k in range(n_columns * n_rows):
            if has_tile(survey.tiles[n], k, n_columns, n_rows):
                tile = (row + k // n_columns) * n_tiles_x + column + k % n_columns
                ids[slot] = n
                tiles[place] = tile
                slots[place] = slot
                count_digits(tile, chain.n_digits, digits)
                place += 1
                slot += 1
    add_counts(digits, chain.n_digits, counters, chain.totals)


@gpu_kernel
def gather_pairs(slots, tiles, ids, counters, listed, offsets):
    """Write the Gaussian of the i-th pair of all lists, and the offsets of tiles that begin with it."""
    i, n_pairs = cuda.grid(1), counters[N_PAIRS]
    if i > n_pairs:
        return
    before = tiles[i - 1] if i > 0 else -1
    tile = offsets.shape[0] - 1
    if i < n_pairs:
        listed[i] = ids[slots[i]]
        tile = tiles[i]
    for t in range(before + 1, tile + 1):
        offsets[t] = i


def list_pairs(workspace: Workspace, plan: Plan, survey: Survey, boxes: Any, grid: TileGrid) -> TileLists:
    """Return the lists of all tiles after a survey."""
    n, n_tiles, capacity = plan.n, grid.n_tiles_x * grid.n_tiles_y, (plan.capacity,)

    def numbers(name: str) -> Any:
        return workspace.array(name, capacity, np.int32, growth=1)

    spare = workspace.array("other_keys", (n,), survey.keys.dtype), workspace.array("other_order", (n,), np.int32)
    _, by_depth = sort_by_digits((survey.keys, survey.order), spare, plan.depth_digits, survey.counters)
    ids, tiles, slots = numbers("ids"), numbers("tiles"), numbers("slots")
    launch_rows(write_pairs, n, boxes, by_depth, survey, plan.pairs, grid.n_tiles_x, ids, tiles, slots)
    spare = numbers("other_tiles"), numbers("other_slots")
    tiles, slots = sort_by_digits((tiles, slots), spare, plan.tile_digits, survey.counters)
    lists = TileLists(workspace.array("tile_offsets", (n_tiles + 1,), np.int64), numbers("listed"), slots)
    launch_rows(gather_pairs, plan.capacity + 1, slots, tiles, ids, survey.counters, lists.ids, lists.offsets)
    return lists


def count_pairs(survey: Survey) -> int:
    """Return the number of pairs, which may be more than there was room for; the host waits for it."""
    n = len(survey.offsets) - 1
    return int(to_host(survey.offsets[n:])[0])


def capacity_for(n_pairs: int, pair_bytes: int, n_before: int = 0) -> int:
    """Return the capacity to provide for so many pairs, somewhat more than they need.

    Parameters
    ----------
    n_pairs : int
    pair_bytes : int
        Of all arrays with a row for each pair.
    n_before : int
        Capacity of lists that are freed for the new ones.

    Raises
    ------
    InputError
        The device has no memory for them.
    """
    capacity = int(GROWTH * n_pairs) + ROW_THREADS
    check_room(capacity * pair_bytes - n_before * LIST_BYTES, f"{n_pairs:,} pairs (tile, Gaussian)")
    return capacity


def bin_gaussians(projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins:
    """List the Gaussians that touch each tile; see ``reference.tiling.bin_gaussians``."""
    n, n_tiles, dtype = len(projection.depths), grid.n_tiles_x * grid.n_tiles_y, projection.depths.dtype
    boxes, depths = to_device(projection.boxes), to_device(projection.depths)
    workspace, capacity = Workspace(), FIRST_CAPACITY * n
    while True:
        plan = plan_lists(n, capacity, n_tiles, 8 * dtype.itemsize)
        survey = start_survey(workspace, plan)
        launch_rows(survey_rows, n + 1, boxes, depths, survey, plan.survey)
        n_pairs = count_pairs(survey)
        if n_pairs <= plan.capacity:
            break
        capacity = capacity_for(n_pairs, LIST_BYTES)
    lists = list_pairs(workspace, plan, survey, boxes, grid)
    bins = TileBins(lists.ids[:n_pairs], lists.offsets, lists.slots[:n_pairs], survey.offsets, grid)
    return bins if is_on_device(projection.depths) else to_host(bins)
