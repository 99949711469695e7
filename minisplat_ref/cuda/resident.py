"""What a training needs whose parameters stay on the device, besides the stages.

Both passes over a view and its comparison with a photograph; and whether a number is not finite.
"""

from typing import Any

import numpy as np

from minisplat_ref.cuda import target
from minisplat_ref.cuda.arrays import to_device, to_host, zeros
from minisplat_ref.cuda.loss import prepare_photograph, read_loss
from minisplat_ref.cuda.passes import Options, Passes
from minisplat_ref.cuda.target import cuda, gpu_kernel, launch_rows
from minisplat_ref.jit.literals import ZERO

__all__ = [
    "Options",
    "Passes",
    "describe_device",
    "free_bytes",
    "has_wrong",
    "is_simulated",
    "prepare_photograph",
    "read_loss",
    "synchronize",
    "to_device",
    "to_host",
    "zeros",
]

is_simulated = target.is_simulated
free_bytes, describe_device = target.free_bytes, target.describe_device


def synchronize() -> None:
    """Wait until all kernels have run."""
    cuda.synchronize()


@gpu_kernel
def find_wrong(table, found):
    """Set ``found[0]`` to 1 if a number of one row is not finite: whichever thread writes, it writes the same."""
    n = cuda.grid(1)
    if n < table.shape[0]:
        for k in range(table.shape[1]):
            if not table[n, k] - table[n, k] == ZERO:
                found[0, 0] = 1


def has_wrong(*bundles: Any) -> bool:
    """Return whether a number of the bundles of arrays [N, ...] is not finite."""
    found = zeros((1, 1), np.int32)
    for table in (table for bundle in bundles for table in bundle):
        n = len(table)
        launch_rows(find_wrong, n, table.reshape(n, table.size // n if n else 0), found)
    return bool(to_host(found)[0, 0])
