"""A stable radix sort of keys with their values: of Gaussians by depth, and of their pairs by tile.

A pass sorts by one digit of eight bits, in one launch, and keeps the order of equal ones; digits come from the last to
the first ("Onesweep", Adinets and Merrill 2022). How often each digit occurs is counted where the keys are made. A
block has consecutive keys and each of its warps some rounds of 32, which its threads read side by side. Warps count
their digits in shared memory; for each digit, the warps' counts are added up, and the blocks' by looking back
(:mod:`minisplat_ref.cuda.scanning`); and each round is written from where the keys before it end. Atomic operations
only count, so the order is that of any stable sort.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.cuda.scanning import scan_block, sum_before, take_block
from minisplat_ref.cuda.target import (
    WARP,
    cuda,
    device_function,
    gpu_kernel,
    is_simulated,
    launch,
    rank_in_warp,
    sync_warp,
)

DIGIT_BITS = 8
N_DIGITS = 1 << DIGIT_BITS
THREADS, ROUNDS = (2 * WARP, 2) if is_simulated else (256, 16)  # of a block; the simulator has two warps
N_WARPS = THREADS // WARP
N_WARP_SUMS = N_WARPS + 1  # of the warps of a block, and of all of them
BLOCK_KEYS = THREADS * ROUNDS
DIGITS_PER_THREAD = N_DIGITS // THREADS
N_EXCHANGED = THREADS if is_simulated else 1


class Digit(NamedTuple):
    """A pass: its digit, and the places of its numbers in the counters."""

    shift: int
    """Bits behind the digit."""
    length: int
    """Place of the number of keys."""
    totals: int
    """First place of the number of keys with each digit."""
    ticket: int
    """Place of the number of blocks that have begun."""
    states: int
    """First place of what blocks publish: ``N_DIGITS`` numbers of each."""


def n_key_blocks(n_keys: int) -> int:
    """Return the number of blocks that sort so many keys."""
    return -(-n_keys // BLOCK_KEYS)


def plan_digits(take: Callable[[int], int], length: int, n_keys: int, n_bits: int) -> tuple[Digit, ...]:
    """Return the passes of a sort, the first digit of all last.

    Parameters
    ----------
    take : callable
        Reserves so many counters and returns the place of the first.
    length : int
        Place of the number of keys.
    n_keys : int
        At most so many.
    n_bits : int
        Every key, unsigned, is below 2 to the power of it.
    """
    shifts, n_states = range(0, n_bits, DIGIT_BITS), N_DIGITS * n_key_blocks(n_keys)
    totals = take(N_DIGITS * len(shifts))
    return tuple(Digit(shift, length, totals + N_DIGITS * i, take(1), take(n_states)) for i, shift in enumerate(shifts))


@device_function
def extract_digit(key, shift):
    """Return a digit of a key."""
    return int((key >> shift) & (N_DIGITS - 1))


@device_function
def clear_counts(counts):
    """Set the counts of a block's digits [n, N_DIGITS] to zero; all of its threads call it."""
    for i in range(cuda.threadIdx.x, counts.shape[0] * N_DIGITS, cuda.blockDim.x):
        counts[i // N_DIGITS, i % N_DIGITS] = 0
    cuda.syncthreads()


@device_function
def count_digits(key, n_digits, counts):
    """Count the first ``n_digits`` digits of a key in ``counts`` [at least n_digits, N_DIGITS]."""
    for i in range(n_digits):
        cuda.atomic.add(counts, (i, extract_digit(key, DIGIT_BITS * i)), 1)


@device_function
def add_counts(counts, n_digits, counters, totals):
    """Add a block's counts to the totals of all blocks; all of its threads call it."""
    cuda.syncthreads()
    for i in range(cuda.threadIdx.x, n_digits * N_DIGITS, cuda.blockDim.x):
        count = counts[i // N_DIGITS, i % N_DIGITS]
        if count > 0:
            cuda.atomic.add(counters, totals + i, count)


@gpu_kernel
def sort_digit(
    keys,  # [capacity]
    values,  # [capacity]
    digit,  # Digit
    counters,
    sorted_keys,  # [capacity]
    sorted_values,  # [capacity]
):
    """Write the keys of one block and their values to their places."""
    places = cuda.shared.array((N_WARPS, N_DIGITS), np.int32)
    sums = cuda.shared.array(THREADS, np.int64)
    warp_sums = cuda.shared.array(N_WARP_SUMS, np.int64)
    exchange = cuda.shared.array(N_EXCHANGED, np.int32)
    thread, n_keys = cuda.threadIdx.x, counters[digit.length]
    warp, lane = thread // WARP, thread % WARP
    block = take_block(counters, digit.ticket)
    if block * BLOCK_KEYS >= n_keys:
        return
    clear_counts(places)
    first = block * BLOCK_KEYS + warp * ROUNDS * WARP + lane
    for turn in range(ROUNDS):
        i = first + turn * WARP
        if i < n_keys:
            cuda.atomic.add(places, (warp, extract_digit(keys[i], digit.shift)), 1)

    # The keys with smaller digits come before, then those of the blocks and of the warps before.
    own_digits, own = thread * DIGITS_PER_THREAD, np.int64(0)
    for d in range(own_digits, own_digits + DIGITS_PER_THREAD):
        own += counters[digit.totals + d]
    start = scan_block(own, sums, warp_sums)
    for d in range(own_digits, own_digits + DIGITS_PER_THREAD):
        total = np.int64(0)
        for w in range(N_WARPS):
            total += places[w, d]
        place = start + sum_before(counters, digit.states + d, N_DIGITS, block, total)
        for w in range(N_WARPS):
            count = places[w, d]
            places[w, d] = place
            place += count
        start += counters[digit.totals + d]
    cuda.syncthreads()

    for turn in range(ROUNDS):
        i = first + turn * WARP
        is_key = i < n_keys
        own_digit = extract_digit(keys[i], digit.shift) if is_key else N_DIGITS
        rank, n_equal = rank_in_warp(own_digit, exchange)
        if is_key:
            place = places[warp, own_digit] + rank
            sorted_keys[place], sorted_values[place] = keys[i], values[i]
        sync_warp()
        if is_key and rank == 0:
            places[warp, own_digit] += n_equal
        sync_warp()


def sort_by_digits(pair: tuple[Any, Any], spare: tuple[Any, Any], digits: tuple[Digit, ...], counters: Any) -> Any:
    """Sort keys and, with them, their values; equal keys keep their order.

    Parameters
    ----------
    pair, spare : tuple of device arrays of shape (capacity,)
        Keys, int32 or int64, sorted as if they were unsigned, and values, int32. Both pairs are overwritten.
    digits : tuple of Digit
        From :func:`plan_digits`; the totals have been counted.
    counters : device array of int64

    Returns
    -------
    the pair of the two that has the sorted keys and values
    """
    for digit in digits:
        launch(sort_digit, n_key_blocks(len(pair[0])), THREADS, *pair, digit, counters, *spare)
        pair, spare = spare, pair
    return pair
