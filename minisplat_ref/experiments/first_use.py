"""The first training after an installation: its kernels are compiled beforehand, several at a time."""

import sys
from concurrent.futures.process import BrokenProcessPool

import numba

from minisplat_ref.backends import CPU
from minisplat_ref.jit.compile import cache_folder
from minisplat_ref.jit.kernel_cache import kernel_folders
from minisplat_ref.warm_up import FIRST_ITERATION, warm_up


def compile_kernels(backend: str) -> None:
    """Compile what an iteration needs if nothing is on disk yet; otherwise what lacks is compiled when it is used.

    Parameters
    ----------
    backend : str
        Name of the one that will be used; only the default's kernels are compiled ahead.
    """
    keeps_kernels = cache_folder() is not None and not numba.config.DISABLE_JIT  # type: ignore[attr-defined]
    if backend != CPU.name or not keeps_kernels or any(f.is_current and f.n_kernels for f in kernel_folders()):
        return
    print("minisplat-ref: compiling for this processor, once", end="", file=sys.stderr, flush=True)
    try:
        for _ in warm_up(FIRST_ITERATION):
            print(".", end="", file=sys.stderr, flush=True)
    except BrokenProcessPool:  # no memory for several processes: the training compiles one kernel after the other
        pass
    print(file=sys.stderr)
