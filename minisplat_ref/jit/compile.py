"""Compilation of kernels: the only place that sets jit flags, caching and threading.

``scalar`` marks a formula of one Gaussian or one pixel: it stays a plain Python function and is inlined into the
kernels that call it. ``kernel`` compiles a parallel loop. Six facts shape this file:

* Numba's on-disk cache does not notice that a function *called* by a kernel has changed. The cache therefore lives in a
  folder named by a hash of all sources that kernels are made of: an edit anywhere makes a new folder. So do other
  versions of the compiler's parts: Numba's own index notices another processor and another Numba, but not another LLVM,
  another NumPy, which computes the constants that are compiled in, or other compiler options. A kernel that contains an
  extension's functions lives in a folder inside that one, named by a hash of the extension's sources: editing an
  extension does not recompile the core.
* Numba distinguishes functions of the same name by a per-process counter, and writes it into the cached code. So
  kernels that different processes compiled for different numbers of channels can contain different functions under one
  name, and a process that loads both runs one of them twice. Therefore a function's name here includes what it closes
  over: functions by module and name, bundles of them field by field, numbers by type and value, nothing by its address.
  Numba's index of a kernel goes by that name, too, in place of a pickle of what it closes over, which is not the same
  in all processes: of 383 kernels that the test suite compiled, 65 had been compiled before.
* Two processes that save to Numba's cache at the same moment take the same file name, and later processes load the
  wrong kernel. Saving is therefore one process at a time. So is compiling one kernel, which takes seconds: processes
  that need the same wait for the first and load what it saved.
* Numba's ``workqueue`` threading layer aborts the process when two Python threads enter parallel regions, so all
  kernels share one lock.
* ``fastmath=True`` would let the compiler assume that there are no NaN, and ``isnan`` return False. Kernels may only
  contract ``a * b + c`` to one rounding.
* Code in the cache has been optimised twice, and a compiler that may reorder a sum gives other last digits the second
  time. Where eight numbers are computed at once, :mod:`minisplat_ref.jit.lanes` does so explicitly and fixes the order.
  The compiler may still choose which products to contract; freshly compiled and cached code have nevertheless given the
  same bytes wherever that was tried, and ``tests/jit/test_kernels.py`` tries it on the processor that it runs on.
"""

import functools
import gc
import hashlib
import math
import os
import platform
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import IO, Any

import llvmlite
import numba
import numpy as np
from numba import prange
from numba.core.event import Event, Listener, register
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
    # Numba prefers TBB where it is installed, but TBB takes longer to start and end a parallel loop.
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]

if "OMP_WAIT_POLICY" not in os.environ:
    # OpenMP's threads spin for a fraction of a millisecond before they sleep, instead of many: as fast on free cores,
    # and on busy ones a spinning thread does not keep the one that it waits for from running.
    os.environ.setdefault("GOMP_SPINCOUNT", "5000")

_KERNEL_LOCK = threading.RLock()
PATIENCE = 60.0
"""Seconds that a process waits for another one to compile a kernel; that one may have been suspended."""
_COMPILING = ExitStack()  # contains the lock of the kernel that is being compiled; guarded by the lock of all kernels
_PACKAGE = Path(__file__).parent.parent
_PARALLEL = {  # only loops over prange, in their order, and nothing that Numba parallelises on its own
    "prange": True,
    **dict.fromkeys(("comprehension", "fusion", "inplace_binop", "numpy", "reduction", "setitem", "stencil"), False),
}
_KERNEL_FOLDERS = ("jit", "scalar", "cpu", "bench")
_COMPILER_OPTIONS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DEBUGINFO_DEFAULT")


class _WithoutCollection(Listener):
    """Keeps the garbage collector from running while Numba compiles, which makes many small objects and drops few.

    Numba reports the start and the end under its own lock, so that no two threads interleave here; the functions that
    a function calls are compiled inside it.
    """

    def __init__(self) -> None:
        self._was_enabled: list[bool] = []  # one for each function being compiled

    def on_start(self, event: Event) -> None:
        """Stop the collector."""
        self._was_enabled.append(gc.isenabled())
        gc.disable()

    def on_end(self, event: Event) -> None:
        """Start it again if it ran before; also called when a compilation fails."""
        if self._was_enabled.pop():
            gc.enable()


register("numba:compile", _WithoutCollection())


@functools.cache
def source_hash() -> str:
    """Return a hash of all source files of the core that kernels are compiled from, and of the compiler's versions."""
    versions = (platform.python_version(), np.__version__, numba.__version__, llvmlite.__version__)
    options = (str(getattr(numba.config, name)) for name in _COMPILER_OPTIONS)
    folders = (_PACKAGE / name for name in _KERNEL_FOLDERS)
    sources = [_PACKAGE / "constants.py", _PACKAGE / "types.py", *(path for f in folders for path in f.rglob("*.py"))]
    return _hash_of("|".join((*versions, *options)), sources, _PACKAGE)


def _hash_of(text: str, sources: Iterable[Path], root: Path) -> str:
    """Return a hash of a text and of files: their names below ``root`` and their contents."""
    digest = hashlib.sha256(text.encode())
    for source in sorted(sources):
        digest.update(source.relative_to(root).as_posix().encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def cache_root() -> Path:
    """Return the folder that contains one folder for every version of the kernels."""
    if base := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(base)
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "minisplat_ref"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "minisplat_ref"


def cache_folder(function: Callable | None = None) -> str | None:
    """Return the folder for compiled kernels.

    Parameters
    ----------
    function : callable, optional
        The kernel, if it may contain functions from outside the core.

    Returns
    -------
    str or None
        None where nothing can be cached: the folder cannot be written, or a function was typed interactively and has no
        source file. Every process then compiles its own kernels.
    """
    folder = cache_root() / source_hash()
    try:
        for module in sorted(_modules_of(function)) if function is not None else ():
            folder /= _folder_of_module(module)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return str(folder) if os.access(folder, os.W_OK) else None


def _modules_of(value: Any) -> set[str]:
    """Return the modules outside the core that define the functions that a value is, contains or closes over.

    Of an extension only its package is returned, ``minisplat_ref.extensions.NAME``, and of the mechanisms only theirs.
    """
    if isinstance(value, tuple):
        return set[str]().union(*map(_modules_of, value))
    if isinstance(value, functools.partial):
        return _modules_of((value.func, *value.args, *value.keywords.values()))
    if not isinstance(value, FunctionType):
        return set()
    modules = _modules_of(tuple(cell.cell_contents for cell in value.__closure__ or ()))
    module = value.__module__ or ""
    package, *names = module.split(".")
    if names[:1] == ["extensions"] and package == _PACKAGE.name:
        return modules | {".".join((package, *names[:2]))}
    if names[:1] == ["mechanisms"] and package == _PACKAGE.name:
        return modules | {f"{package}.mechanisms"}
    return modules if package in (_PACKAGE.name, "numba", "numpy") else modules | {module}


def _folder_of_module(module: str) -> str:
    """Return the name of the folder for kernels with functions of a module outside the core: a hash of its sources.

    It covers all files of a package. Mechanisms may call each other and extensions may call any mechanism, so it covers
    all of ``mechanisms/``, too.

    Raises
    ------
    FileNotFoundError
        The module has no source file.
    """
    file = Path(getattr(sys.modules.get(module), "__file__", None) or "")
    if not file.is_file():
        raise FileNotFoundError(f"module {module} has no source file")
    sources = [file]
    if file.name == "__init__.py":
        sources, file = [*file.parent.rglob("*.py")], file.parent
    mechanisms = _hash_of("", (_PACKAGE / "mechanisms").rglob("*.py"), _PACKAGE)
    return f"{module.rpartition('.')[2]}-{_hash_of(module + mechanisms, sources, file.parent)}"


@contextmanager
def _one_process_at_a_time(folder: str, name: str = "lock", patience: float = math.inf) -> Iterator[None]:
    """Hold a lock on the cache, or on one kernel; the system releases it when the file is closed, however that happens.

    After ``patience`` seconds the process goes on without: another one may hold the lock and be suspended.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)  # the cache may have been cleared
    with open(Path(folder) / name, "a+b") as file:
        end = time.monotonic() + patience
        while not _lock(file) and time.monotonic() < end:
            time.sleep(0.01)
        yield


def _lock(file: IO[bytes]) -> bool:
    """Lock a file if no other process has locked it; return whether it is locked now."""
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]  # exists on Windows only
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True


def _share_work(compiled: Any, folder: str) -> None:
    """Let one process compile a kernel, for which others wait, and save it under the lock of the cache.

    A kernel that cannot be saved, as on a full disk, is used all the same; the next process compiles it again.
    """
    load, save = compiled._cache.load_overload, compiled._cache.save_overload

    def load_overload(signature: Any, context: Any) -> Any:
        found = load(signature, context)
        if found is None:
            name = f"{compiled._cache._impl.filename_base}.lock"
            with suppress(OSError):  # without a lock, two processes may do the same work
                _COMPILING.enter_context(_one_process_at_a_time(folder, name, PATIENCE))
            found = load(signature, context)  # another process may just have saved it
        return found

    def save_overload(signature: Any, result: Any) -> None:
        with _COMPILING, suppress(OSError), _one_process_at_a_time(folder):
            save(signature, result)

    compiled._cache.load_overload = load_overload
    compiled._cache.save_overload = save_overload


def _index_by_name(compiled: Any, name: str) -> None:
    """Have the cache find a kernel by its signature, its own bytecode and a name that includes what it closes over."""
    own = hashlib.sha256(compiled.py_func.__code__.co_code).hexdigest()
    compiled._cache._index_key = lambda signature, codegen: (signature, codegen.magic_tuple(), (own, name))


def scalar(function: Callable) -> Callable:
    """Mark a formula of one Gaussian or one pixel that kernels call; in Python the function stays itself."""
    # Always inlined: a call would count references to every array argument, an atomic operation each. Nothing calls it
    # through a C pointer, and the wrapper for that would be a tenth of the compiled code.
    return register_jitable(forceinline=True, no_cfunc_wrapper=True)(_add_closure_to_name(function))


def _add_closure_to_name(function: Callable) -> Callable:
    """Add what a function closes over to its name, after which compiled symbols are named."""
    names = [_name_of(cell.cell_contents) for cell in function.__closure__ or ()]
    if names:
        function.__qualname__ += "_" + hashlib.sha256("|".join(names).encode()).hexdigest()[:16]
    return function


def _name_of(value: Any) -> str:
    """Describe a value that a function closes over: the same in every process, and different for different values.

    Raises
    ------
    TypeError
        Only its address distinguishes the value from others of its type.
    """
    if isinstance(value, FunctionType):
        inside = (cell.cell_contents for cell in value.__closure__ or ())
        line = value.__code__.co_firstlineno  # lambdas of one function share a name
        return f"{value.__module__}.{value.__qualname__}:{line}({','.join(map(_name_of, inside))})"
    if isinstance(value, tuple):
        return f"{type(value).__name__}({','.join(map(_name_of, value))})"
    if isinstance(value, functools.partial):
        return f"partial{_name_of((value.func, *value.args, *value.keywords, *value.keywords.values()))}"
    if isinstance(value, type | BuiltinFunctionType | np.ufunc):
        return f"{getattr(value, '__module__', '')}.{value.__name__}"
    if isinstance(value, ModuleType):
        return value.__name__
    if value is None or isinstance(value, bool | int | float | complex | str | np.generic | np.dtype):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, np.ndarray):
        return f"array {value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    raise TypeError(
        f"a compiled function closes over a {type(value).__name__}, whose name would be an address: close over"
        " functions, numbers, arrays, or tuples of them"
    )


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
        folder = cache_folder(function)
        previous = numba.config.CACHE_DIR  # type: ignore[attr-defined]  # numba sets its options at import
        numba.config.CACHE_DIR = folder or previous  # type: ignore[attr-defined]  # read at decoration only
        try:
            compiled = numba.njit(
                parallel=_PARALLEL if parallel else False,
                cache=folder is not None,
                error_model="numpy",
                fastmath={"contract"},
                no_cfunc_wrapper=True,
            )(_add_closure_to_name(function))
        finally:
            numba.config.CACHE_DIR = previous  # type: ignore[attr-defined]
        if folder is not None and not numba.config.DISABLE_JIT:  # type: ignore[attr-defined]  # then it is plain Python
            _index_by_name(compiled, function.__qualname__)
            _share_work(compiled, folder)

        @functools.wraps(function)
        def locked(*args: Any) -> Any:
            with _KERNEL_LOCK, _COMPILING:
                return compiled(*args)

        return locked

    return decorate


def n_threads() -> int:
    """Return the number of threads that kernels use."""
    return int(numba.get_num_threads())
