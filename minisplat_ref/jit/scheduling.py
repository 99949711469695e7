"""Dynamic scheduling of a parallel loop: each thread that is free takes the next part of the work.

Parts are never equal work and threads never equally fast: another program may occupy a core, and the cores of a laptop
differ. Results must not depend on which thread takes which part. Loops over Gaussians use static scheduling instead:
they do little with each number, and a core finds its share in its cache again in the next loop.

In a kernel::

    taken = shared_counter()
    for _ in prange(n_threads):
        for part in dynamic_range(taken, n_parts):
            ...
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numba import types

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes_arithmetic import register_lowering


@scalar
def make_shared_counter():
    """Return a counter of the parts that have been taken, shared by all threads of one loop."""
    taken = np.empty(1, np.int64)
    taken[0] = 0
    return taken


def fetch_and_add(counter: Any, n: int) -> int:
    """Add n to the counter atomically and return its old value; no two threads get the same n numbers."""
    counter[0] += n
    return int(counter[0]) - n


@register_lowering(fetch_and_add)
def _fetch_and_add(typing: Any, counter: Any, n: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(counter)(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, args[1], "monotonic")

    return types.int64(counter, types.int64), generate


@scalar
def dynamic_range(taken: Any, n_parts: int) -> Iterator[int]:
    """Yield the numbers below ``n_parts`` that no other thread has taken."""
    part = fetch_and_add(taken, 1)
    while part < n_parts:
        yield part
        part = fetch_and_add(taken, 1)
