"""Arrays of the device that outlive a pass, so that later passes of the same size allocate nothing.

An allocation on a GPU takes as long as a launch, and giving it back makes the host wait for all kernels.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from minisplat_ref.cuda.arrays import empty

GROWTH = 1.25  # factor by which an array that is too small grows beyond what is asked for


class Workspace:
    """Arrays by name. Each keeps its memory, and grows when more is asked for."""

    def __init__(self) -> None:
        self._memory: dict[str, Any] = {}
        self._arrays: dict[str, Any] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: DTypeLike, growth: float = GROWTH) -> Any:
        """Return an uninitialised array of the device.

        It shares its memory with the last array of that name, which is no longer to be used. One that has to grow
        becomes ``growth`` times as large as what is asked for: 1 where the shape has room to spare already.
        """
        dtype, array = np.dtype(dtype), self._arrays.get(name)
        if array is not None and array.shape == shape and array.dtype == dtype:
            return array
        size = math.prod(shape)
        if size == 0:
            array = empty(shape, dtype)
        else:
            memory = self._memory.get(name)
            if memory is None or memory.dtype != dtype:
                memory = self._memory[name] = empty(size, dtype)
            elif len(memory) < size:
                self._memory[name] = self._arrays[name] = memory = array = None  # frees it first
                memory = self._memory[name] = empty(int(growth * size), dtype)
            array = memory[:size].reshape(*shape)
        self._arrays[name] = array
        return array
