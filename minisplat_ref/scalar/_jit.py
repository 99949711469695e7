"""The only place where jit flags, caching and threading are decided.

``scalar`` marks a formula of one Gaussian or one pixel: it stays a plain Python function and is inlined into the
kernels that call it. ``kernel`` compiles a parallel loop. Six facts shape this file:

* Numba's on-disk cache does not notice that a function *called* by a kernel has changed. The cache therefore lives in a
  folder named by a hash of all sources that kernels are made of: an edit anywhere makes a new folder. So does another
  version of what compiles them: Numba's own index notices another processor and another Numba, but not another LLVM,
  another NumPy, which computes the constants that are compiled in, or other options of the compiler.
* Numba tells functions of one name apart by a counter of the process, and writes it into the cached code. Kernels that
  different processes compiled for different numbers of channels can so hold different functions under one name, and a
  process that loads both runs one of them twice. What a function closes over is therefore part of its name here.
* Two processes that save to Numba's cache at the same moment take the same file name, and later processes load the
  wrong kernel. Saving is therefore one process at a time.
* Numba's ``workqueue`` threading layer aborts the process when two Python threads enter parallel regions, so all
  kernels share one lock.
* ``fastmath=True`` would let the compiler assume that no NaN exists and ``isnan`` return False. Kernels may only
  contract ``a * b + c`` to one rounding.
* What stands in the cache has been optimised twice, and a compiler that may change the order of a sum gives other last
  digits the second time. Where eight numbers are computed at once, :mod:`minisplat_ref.scalar.lanes` says so and fixes
  the order. Known and open: kernels can still differ in the last digit between just compiled and loaded from the
  cache.
"""

import functools
import hashlib
import os
import platform
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba import prange
from numba.extending import register_jitable

__all__ = [
    "cache_folder",
    "cache_root",
    "kernel",
    "n_threads",
    "prange",
    "scalar",
    "source_hash",
]

if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    # Numba would take TBB first where it is installed; it takes longer to start and end a parallel loop.
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]

if "OMP_WAIT_POLICY" not in os.environ:
    # OpenMP's threads wait for the next parallel loop for a fraction of a millisecond before they sleep, not for many:
    # as fast on free cores, and on busy ones a thread that waits does not keep the one that it waits for from running.
    os.environ.setdefault("GOMP_SPINCOUNT", "5000")

_KERNEL_LOCK = threading.RLock()
_PACKAGE = Path(__file__).parent.parent
_PARALLEL = {  # loops over prange, in the order in which they stand, and nothing that Numba finds by itself
    "prange": True,
    **dict.fromkeys(("comprehension", "fusion", "inplace_binop", "numpy", "reduction", "setitem", "stencil"), False),
}
_COMPILER_OPTIONS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DEBUGINFO_DEFAULT")


@functools.cache
def source_hash() -> str:
    """Hash of every source file that is compiled into a kernel, and of what compiles it."""
    versions = (platform.python_version(), np.__version__, numba.__version__, llvmlite.__version__)
    options = (str(getattr(numba.config, name)) for name in _COMPILER_OPTIONS)
    digest = hashlib.sha256("|".join((*versions, *options)).encode())
    sources = [_PACKAGE / "constants.py", _PACKAGE / "types.py"]
    for folder in ("scalar", "cpu", "oracle/bench"):
        sources += sorted((_PACKAGE / folder).glob("*.py"))
    for source in sources:
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def cache_root() -> Path:
    """Return the folder in which every version of the kernels has one of its own."""
    if base := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(base)
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "minisplat_ref"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "minisplat_ref"


@functools.cache
def cache_folder() -> str | None:
    """Return the folder for compiled kernels; None where it cannot be written, and every process compiles its own."""
    folder = cache_root() / source_hash()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return str(folder) if os.access(folder, os.W_OK) else None


@contextmanager
def _one_process_at_a_time(folder: str) -> Iterator[None]:
    """Hold a lock on the cache; the system gives it back when the file is closed, however the process ends."""
    Path(folder).mkdir(parents=True, exist_ok=True)  # somebody may have cleared the cache
    with open(Path(folder) / "lock", "a+b") as file:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)  # type: ignore[attr-defined]  # exists on Windows only
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _save_alone(compiled: Any, folder: str) -> None:
    """Make a compiled function save itself to the cache under the lock."""
    save = compiled._cache.save_overload

    def save_overload(signature: Any, result: Any) -> None:
        with _one_process_at_a_time(folder):
            save(signature, result)

    compiled._cache.save_overload = save_overload


def scalar(function: Callable) -> Callable:
    """Mark a formula of one Gaussian or one pixel that kernels call; in Python it is the function itself."""
    # Inlined always: a call would count the references of every array it is given, an atomic operation each. Nobody
    # calls it through a C pointer, and the wrapper for that would be a tenth of what is compiled.
    return register_jitable(forceinline=True, no_cfunc_wrapper=True)(_named_after_closure(function))


def _named_after_closure(function: Callable) -> Callable:
    """Make the name of a function unique to what it closes over; compiled symbols are named after it."""
    cells = (cell.cell_contents for cell in function.__closure__ or ())
    values = [str(getattr(value, "__qualname__", value)) for value in cells]
    if values:
        function.__qualname__ += "_" + hashlib.sha256("|".join(values).encode()).hexdigest()[:16]
    return function


def kernel(parallel: bool = True) -> Callable[[Callable], Callable]:
    """Compile a parallel loop over bundles of arrays.

    Parameters
    ----------
    parallel : bool
        False for the few loops whose steps depend on each other.

    Returns
    -------
    callable
        A decorator; the decorated kernel takes the package-wide lock around each call.
    """

    def decorate(function: Callable) -> Callable:
        folder = cache_folder()
        previous = numba.config.CACHE_DIR  # type: ignore[attr-defined]  # numba sets its options at import
        numba.config.CACHE_DIR = folder or previous  # type: ignore[attr-defined]  # read at decoration only
        try:
            compiled = numba.njit(
                parallel=_PARALLEL if parallel else False,
                cache=folder is not None,
                error_model="numpy",
                fastmath={"contract"},
                no_cfunc_wrapper=True,
            )(_named_after_closure(function))
        finally:
            numba.config.CACHE_DIR = previous  # type: ignore[attr-defined]
        if folder is not None and not numba.config.DISABLE_JIT:  # type: ignore[attr-defined]  # then it is plain Python
            _save_alone(compiled, folder)

        @functools.wraps(function)
        def locked(*args: Any) -> Any:
            with _KERNEL_LOCK:
                return compiled(*args)

        return locked

    return decorate


def n_threads() -> int:
    """Return the number of threads that kernels use."""
    return int(numba.get_num_threads())
