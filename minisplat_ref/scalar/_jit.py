"""The only place where jit flags, caching and threading are decided.

``scalar`` marks a formula of one Gaussian or one pixel: it stays a plain Python function and is inlined into the
kernels that call it. ``kernel`` compiles a parallel loop. Three facts shape this file:

* Numba's on-disk cache does not notice that a function *called* by a kernel has changed. The cache therefore lives in a
  folder named by a hash of all sources that kernels are made of: an edit anywhere makes a new folder.
* Numba's ``workqueue`` threading layer aborts the process when two Python threads enter parallel regions, so all
  kernels share one lock.
* ``fastmath=True`` would let the compiler assume that no NaN exists and ``isnan`` return False. ``REASSOCIATE`` only
  lets it reorder sums and use fused multiply-adds, without which no reduction vectorises. The order it picks is fixed
  at compile time, so results stay the same bytes on every run and at any number of threads.
"""

import functools
import hashlib
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import prange
from numba.extending import register_jitable

__all__ = ["REASSOCIATE", "kernel", "n_threads", "prange", "scalar", "source_hash"]

REASSOCIATE = {"reassoc", "contract", "arcp", "nsz"}

_KERNEL_LOCK = threading.RLock()
_PACKAGE = Path(__file__).parent.parent


@functools.cache
def source_hash() -> str:
    """Hash of every source file that is compiled into a kernel."""
    digest = hashlib.sha256()
    sources = [_PACKAGE / "constants.py", _PACKAGE / "types.py"]
    for folder in ("scalar", "cpu"):
        sources += sorted((_PACKAGE / folder).glob("*.py"))
    for source in sources:
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _cache_root() -> Path:
    if base := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(base)
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "minisplat_ref"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "minisplat_ref"


@functools.cache
def _cache_folder() -> str | None:
    """Folder for compiled kernels, or None where it cannot be written (kernels then compile in every process)."""
    folder = _cache_root() / source_hash()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return str(folder) if os.access(folder, os.W_OK) else None


def scalar(function: Callable) -> Callable:
    """Mark a formula of one Gaussian or one pixel that kernels call; in Python it is the function itself."""
    return register_jitable(function)


def kernel(fastmath: set[str] | bool = False, parallel: bool = True) -> Callable[[Callable], Callable]:
    """Compile a parallel loop over bundles of arrays.

    Parameters
    ----------
    fastmath : set of str or bool
        ``REASSOCIATE`` for kernels whose inner loop is a reduction, otherwise False.
    parallel : bool
        False for the few loops whose steps depend on each other.

    Returns
    -------
    callable
        A decorator; the decorated kernel takes the package-wide lock around each call.
    """

    def decorate(function: Callable) -> Callable:
        folder = _cache_folder()
        previous = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = folder or previous  # read by numba at decoration only
        try:
            compiled = numba.njit(parallel=parallel, cache=folder is not None, error_model="numpy", fastmath=fastmath)(
                function
            )
        finally:
            numba.config.CACHE_DIR = previous

        @functools.wraps(function)
        def locked(*args: Any) -> Any:
            with _KERNEL_LOCK:
                return compiled(*args)

        return locked

    return decorate


def n_threads() -> int:
    """Return the number of threads that kernels use."""
    return int(numba.get_num_threads())
