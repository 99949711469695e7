"""The only module that imports CUDA: compilation of kernels, the device, and what both the simulator and a GPU can do.

Another compiler for the same kernels would be chosen here. Nothing imports this module before a GPU is asked for. With
``NUMBA_ENABLE_CUDASIM=1`` in the environment, Numba's simulator runs the kernels as Python threads, one block after the
other. It has no shuffles within a warp: :func:`reduce_warps` has a second version for it, which adds in the same order.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError, one_line
from minisplat_ref.jit import lanes

try:
    import numba.cuda
    import numba_cuda  # Numba's own module of that name is older
except ImportError as error:
    raise InputError("backend cuda needs the package numba-cuda; pip install 'minisplat_ref[cuda]'") from error

cuda: Any = numba.cuda

__all__ = [
    "ROW_THREADS",
    "WARP",
    "GpuKernel",
    "check_device",
    "check_room",
    "cuda",
    "describe_device",
    "device_function",
    "float_bits",
    "free_bytes",
    "gpu_kernel",
    "is_simulated",
    "launch",
    "launch_rows",
    "n_row_blocks",
    "rank_in_warp",
    "reduce_warps",
    "sync_warp",
]

MIN_CAPABILITY = (7, 5)  # the oldest that the compiler of CUDA 13 knows
WARP = 32  # threads that run together
FULL_WARP = 0xFFFFFFFF
is_simulated = bool(cuda.config.ENABLE_CUDASIM)
ROW_THREADS = WARP if is_simulated else 128  # of a block, where each thread has one Gaussian or pair


def check_device() -> None:
    """Check that kernels can run.

    Raises
    ------
    InputError
        There is no NVIDIA GPU, no driver for it, or one of them is too old.
    """
    if is_simulated:
        return
    try:
        found = cuda.is_available() and len(cuda.gpus) > 0
    except Exception:  # whatever a broken driver raises
        found = False
    if not found:
        raise InputError("backend cuda found no NVIDIA GPU with a working driver; nvidia-smi should list one. Use cpu")
    device = cuda.get_current_device()
    if device.compute_capability < MIN_CAPABILITY:
        found, least = (".".join(map(str, pair)) for pair in (device.compute_capability, MIN_CAPABILITY))
        raise InputError(
            f"the GPU {_text(device.name)} has compute capability {found}, and kernels are compiled for {least} or"
            " later: use a newer GPU, or --backend cpu"
        )
    try:
        launch(GpuKernel(_do_nothing), 1, 1, np.float32(0))
        cuda.synchronize()
    except (AttributeError, ImportError) as error:  # before the driver is asked
        versions = f"numba-cuda {numba_cuda.__version__} does not work with NumPy {np.__version__}"
        raise InputError(
            f"{versions} ({one_line(str(error))[:200]}): pip install 'minisplat_ref[cuda]' takes releases that do, or"
            " use --backend cpu"
        ) from error
    except Exception as error:  # a driver that does not know the compiler's PTX fails here, in one of several ways
        why = one_line(str(error))[:200]
        raise InputError(
            f"the GPU {_text(device.name)} cannot run a kernel ({why}): update its driver, install"
            " numba-cuda[cu12] for an older one, or use --backend cpu"
        ) from error


def _do_nothing(number):
    """Do nothing, to see whether kernels run."""


def _text(name: str | bytes) -> str:
    return name.decode() if isinstance(name, bytes) else name


def describe_device() -> dict[str, Any]:
    """Return the card's name, compute capability and bytes of memory, and the driver's version."""
    if is_simulated:
        return {"name": "Numba's simulator, no GPU"}
    device, memory = cuda.get_current_device(), cuda.current_context().get_memory_info()
    return {
        "name": _text(device.name),
        "compute_capability": list(device.compute_capability),
        "driver": list(cuda.cudadrv.driver.driver.get_version()),
        "memory": int(memory.total),
    }


def free_bytes() -> float:
    """Return how much memory of the device is free; the simulator does not say, and so returns infinity."""
    return float(cuda.current_context().get_memory_info().free)


def check_room(n_bytes: float, what: str) -> None:
    """Refuse what does not fit into the memory of the device, before it is allocated.

    Raises
    ------
    InputError
        It does not.
    """
    free = free_bytes()
    if n_bytes > free:
        raise InputError(
            f"the GPU has no memory for {what}: {n_bytes / 1e9:.2f} GB are needed, {free / 1e9:.2f} GB are free; use"
            " smaller images (--downscale), fewer Gaussians (--budget), or --backend cpu"
        )


class GpuKernel:
    """A kernel, compiled for the types of its arguments when it is first launched."""

    def __init__(self, function: Callable) -> None:
        self.function = function

    @functools.cached_property
    def compiled(self) -> Any:
        """The dispatcher."""
        return cuda.jit(self.function)


def gpu_kernel(function: Callable) -> GpuKernel:
    """Mark a kernel: a function that every thread of a grid runs."""
    return GpuKernel(function)


def device_function(function: Callable) -> Any:
    """Mark a function that kernels call and that itself uses ``cuda``."""
    return cuda.jit(device=True)(function)


def launch(kernel: GpuKernel, n_blocks: int, n_threads: int, *args: Any) -> None:
    """Run a kernel on so many blocks of so many threads; an empty grid does nothing."""
    if n_blocks > 0:
        kernel.compiled[n_blocks, n_threads](*args)


def launch_rows(kernel: GpuKernel, n_rows: int, *args: Any) -> None:
    """Run a kernel with one thread for each row, in blocks of ``ROW_THREADS``."""
    launch(kernel, n_row_blocks(n_rows), ROW_THREADS, *args)


def n_row_blocks(n_rows: int) -> int:
    """Return the number of blocks that :func:`launch_rows` runs."""
    return -(-n_rows // ROW_THREADS)


if is_simulated:

    @device_function
    def reduce_warps(values, n_sums, n_values, is_needed, exchange, out):
        """Write the sums over each warp of the first ``n_sums`` of ``values``, and the maxima of the others.

        All threads of a block call it together.

        Parameters
        ----------
        values : array of shape (n_values,)
            Of the thread.
        n_sums, n_values : int
        is_needed : bool
            Where it is False in a whole warp, all its values are 0.
        exchange : array of shape (threads, n_values)
            Shared memory, which only the simulator uses.
        out : array of shape (warps, n_values)
            Shared memory; to be read after the block has met.
        """
        thread = cuda.threadIdx.x
        for k in range(n_values):
            exchange[thread, k] = values[k]
        cuda.syncthreads()
        if thread % WARP == 0:
            for k in range(n_values):
                of_lanes = np.array([exchange[thread + i, k] for i in range(WARP)])
                while len(of_lanes) > 1:
                    low, high = np.split(of_lanes, 2)
                    of_lanes = low + high if k < n_sums else np.maximum(low, high)
                out[thread // WARP, k] = of_lanes[0]
        cuda.syncthreads()

    @device_function
    def rank_in_warp(value, exchange):
        """Return how many threads of the warp before this one have an equal integer, and how many in all.

        All threads of a block call it together; ``exchange`` [threads] is shared memory, which only the simulator uses.
        """
        thread = cuda.threadIdx.x
        exchange[thread] = value
        cuda.syncthreads()
        first = thread - thread % WARP
        is_equal = [exchange[i] == value for i in range(first, first + WARP)]
        cuda.syncthreads()
        return sum(is_equal[: thread - first]), sum(is_equal)

    @device_function
    def sync_warp():
        """Wait for the other threads of the warp."""
        cuda.syncthreads()

    def float_bits(number):
        """Return the bits of a float as an integer of the same size."""
        return number.view(np.int32 if number.dtype == np.float32 else np.int64)

else:
    from numba.cuda import libdevice
    from numba.cuda.extending import overload  # type: ignore[attr-defined]
    from numba.cuda.types import float32  # type: ignore[attr-defined]

    @device_function
    def reduce_warps(values, n_sums, n_values, is_needed, exchange, out):
        """Write the sums over each warp of the first ``n_sums`` of ``values``, and the maxima of the others."""
        thread = cuda.threadIdx.x
        if cuda.any_sync(FULL_WARP, is_needed):
            for k in range(n_values):
                value = values[k]
                for step in (16, 8, 4, 2, 1):
                    other = cuda.shfl_down_sync(FULL_WARP, value, step)
                    value = value + other if k < n_sums else lanes.maximum(value, other)
                if thread % WARP == 0:
                    out[thread // WARP, k] = value
        elif thread % WARP == 0:
            for k in range(n_values):
                out[thread // WARP, k] = values[k]

    @device_function
    def rank_in_warp(value, exchange):
        """Return how many threads of the warp before this one have an equal integer, and how many in all."""
        equal = np.uint32(cuda.match_any_sync(FULL_WARP, value))
        return cuda.popc(equal & np.uint32((1 << cuda.laneid) - 1)), cuda.popc(equal)

    @device_function
    def sync_warp():
        """Wait for the other threads of the warp."""
        cuda.syncwarp()

    def float_bits(number):
        """Return the bits of a float as an integer of the same size."""
        raise NotImplementedError("only kernels call it")

    @overload(float_bits, target="cuda")
    def _float_bits(number):
        if number == float32:
            return lambda number: libdevice.float_as_int(number)
        return lambda number: libdevice.double_as_longlong(number)

    # The functions of lanes that have no version for a single number: math.floor would return an integer.
    @overload(lanes.floor, target="cuda")
    def _floor(a):
        if a == float32:
            return lambda a: libdevice.floorf(a)
        return lambda a: libdevice.floor(a)

    @overload(lanes.ceil, target="cuda")
    def _ceil(a):
        if a == float32:
            return lambda a: libdevice.ceilf(a)
        return lambda a: libdevice.ceil(a)

    @overload(lanes.libm_exp, target="cuda")
    def _libm_exp(a):
        return lambda a: math.exp(a)
