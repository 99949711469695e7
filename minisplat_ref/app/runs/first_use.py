"""The first training after an installation: its kernels are compiled beforehand, several at a time."""

import sys
import warnings
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing

import numba

from minisplat_ref.errors import InputWarning, one_line
from minisplat_ref.extensions.warm_up import warm_up
from minisplat_ref.jit.compile import cache_folder, cache_root
from minisplat_ref.jit.kernel_cache import kernel_folders
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.rendering.warm_up import FIRST_ITERATION


def warn_if_not_kept(backend: str) -> None:
    """Warn where compiled kernels cannot be kept on disk, if the backend of this name has any."""
    if backend == REFERENCE.name or numba.config.DISABLE_JIT or cache_folder() is not None:  # type: ignore[attr-defined]
        return
    message = (
        f"{cache_root()} cannot be written: compiled kernels are not kept, and every start recompiles them before it"
        " begins; set NUMBA_CACHE_DIR to a folder that can be written"
    )
    warnings.warn(one_line(message), InputWarning, stacklevel=2)


def compile_kernels(backend: str) -> None:
    """Compile the kernels of an iteration if none are on disk yet; otherwise missing ones are compiled on use.

    Parameters
    ----------
    backend : str
        Name of the one that will be used; only the default's kernels are compiled ahead.
    """
    warn_if_not_kept(backend)
    keeps_kernels = cache_folder() is not None and not numba.config.DISABLE_JIT  # type: ignore[attr-defined]
    if backend != CPU.name or not keeps_kernels or any(f.is_current and f.n_kernels for f in kernel_folders()):
        return
    print("minisplat-ref: compiling for this processor, once", end="", file=sys.stderr, flush=True)
    try:
        with closing(warm_up(FIRST_ITERATION)) as stages:  # closed at once when Ctrl-C comes, which ends the processes
            for _ in stages:
                print(".", end="", file=sys.stderr, flush=True)
    except BrokenProcessPool:  # no memory for several processes: the training compiles one kernel after the other
        pass
    finally:
        print(file=sys.stderr)
