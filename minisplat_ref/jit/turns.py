"""Work that threads take part by part: whoever is free takes the next.

Parts are never equal work and threads never equally fast: another program may hold a core, and the cores of a laptop
differ. So nothing may depend on which thread takes which part. Loops over Gaussians keep to fixed shares instead: they
do little with each number, and what a core had in its cache it has again in the next loop.

In a kernel::

    taken = no_turns()
    for _ in prange(n_threads):
        for part in turns(taken, n_parts):
            ...
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes_arithmetic import compiled


@scalar
def no_turns():
    """Return a counter of the turns that have been taken, for all threads of one loop."""
    taken = np.empty(1, np.int64)
    taken[0] = 0
    return taken


def next_turn(taken: Any) -> int:
    """Return how many turns had been taken before this one; no two threads get the same number."""
    taken[0] += 1
    return int(taken[0]) - 1


@compiled(next_turn)
def _next_turn(typing: Any, taken: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        counter = context.make_array(taken)(context, builder, args[0]).data
        return builder.atomic_rmw("add", counter, ir.IntType(64)(1), "monotonic")

    return types.int64(taken), generate


@scalar
def turns(taken: Any, n_parts: int) -> Iterator[int]:
    """Yield the numbers below ``n_parts`` that no other thread has got."""
    part = next_turn(taken)
    while part < n_parts:
        yield part
        part = next_turn(taken)
