"""Sums of all numbers before each, in the launch that needs them: where each thread begins to write.

Within a block, threads add the sums of the threads before them in their warp, and of the warps before. Blocks continue
each other: a block publishes its sum, looks back at the blocks before it until one knows the sum of everything before
itself too, and publishes its own (Merrill and Garland 2016, "Single-pass Parallel Prefix Scan with Decoupled
Look-back"). A block waits only for blocks that began before it, since it takes its number when it begins; so it cannot
wait for ever. All sums are of integers: the order in which blocks meet leaves no trace.

A published number has its state in its last two bits, so that one atomic operation reads or writes both.
"""

import numpy as np

from minisplat_ref.cuda.target import WARP, cuda, device_function

STATE_BITS = 2
STATE_MASK = (1 << STATE_BITS) - 1
NOTHING, OWN_SUM, ALL_SUMS = range(3)  # states: of the block alone, or of all blocks up to it


@device_function
def take_block(counters, ticket):
    """Return the number of the thread's block in the order in which blocks begin; all of its threads call it."""
    taken = cuda.shared.array(1, np.int64)
    if cuda.threadIdx.x == 0:
        taken[0] = cuda.atomic.add(counters, ticket, 1)
    cuda.syncthreads()
    return taken[0]


@device_function
def sum_before(counters, first, stride, block, total):
    """Publish the sum of a block, and return that of all blocks before it.

    Parameters
    ----------
    counters : array of int64
        Zeros where no block has published.
    first, stride : int
        Block ``b`` publishes in ``counters[first + stride * b]``.
    block : int
        From :func:`take_block`.
    total : int
        Sum of the block.
    """
    own, before = first + stride * block, np.int64(0)
    if block > 0:
        cuda.atomic.exch(counters, own, (np.int64(total) << STATE_BITS) | OWN_SUM)
        place, state = own, np.int64(OWN_SUM)
        while (state & STATE_MASK) != ALL_SUMS:
            place -= stride
            state = cuda.atomic.add(counters, place, 0)
            while (state & STATE_MASK) == NOTHING:  # the block has not got there yet
                state = cuda.atomic.add(counters, place, 0)
            before += state >> STATE_BITS
    cuda.atomic.exch(counters, own, ((before + total) << STATE_BITS) | ALL_SUMS)
    return before


@device_function
def scan_block(own, sums, warp_sums):
    """Return the sum of ``own`` over the threads of the block before; all of its threads call it.

    Parameters
    ----------
    own : int
        Number of the thread.
    sums, warp_sums : arrays of shape (threads,) and (warps + 1,) of int64
        Shared memory; afterwards the last number of ``warp_sums`` is the sum over the block, until the next barrier.
    """
    thread = cuda.threadIdx.x
    warp, n_warps = thread // WARP, cuda.blockDim.x // WARP
    sums[thread] = own
    cuda.syncthreads()
    before = np.int64(0)
    for i in range(warp * WARP, thread):
        before += sums[i]
    if thread % WARP == WARP - 1:
        warp_sums[warp] = before + own
    cuda.syncthreads()
    for i in range(warp):
        before += warp_sums[i]
    if thread == n_warps * WARP - 1:
        warp_sums[n_warps] = before + own
    cuda.syncthreads()
    return before


@device_function
def start_of_thread(own, counters, states, block, sums, warp_sums):
    """Return the sum of ``own`` over all threads before, of the block and of the blocks before it.

    All threads of the block call it; ``states`` is the place of the first block's sum in ``counters``.
    """
    earlier = cuda.shared.array(1, np.int64)
    within = scan_block(own, sums, warp_sums)
    if cuda.threadIdx.x == 0:
        earlier[0] = sum_before(counters, states, 1, block, warp_sums[cuda.blockDim.x // WARP])
    cuda.syncthreads()
    return earlier[0] + within
