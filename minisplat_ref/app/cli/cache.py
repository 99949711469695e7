"""``cache``: compiles all kernels ahead, lists them on disk, removes them."""

import argparse
import sys
import time
from typing import TYPE_CHECKING

from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import Commands, HelpFormatter, integer

if TYPE_CHECKING:
    from minisplat_ref.jit.kernel_cache import KernelFolder

DESCRIPTION = """\
The kernels are compiled for this processor at their first use and kept on disk.
A change of the program, Numba, NumPy or Python makes a new folder, so that what
is kept is never out of date; folders of other versions stay until cleared.
NUMBA_CACHE_DIR sets another place for them.
"""
EPILOG = """\
examples:
  minisplat-ref cache warm
  minisplat-ref cache clear --stale"""


def add_parser(commands: Commands) -> None:
    """Add the command and its actions."""
    parser = commands.add_parser(
        "cache",
        help="compile the kernels ahead, or remove them",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    warm = actions.add_parser("warm", help="compile what training, rendering and evaluation need")
    warm.add_argument("--float64", action="store_true", help="in double precision too: for rasterization() and oracle")
    warm.add_argument("--processes", type=integer(1), metavar="N", help="at a time (default one per processor)")
    warm.set_defaults(run=_warm)
    info = actions.add_parser("info", help="say what is on disk")
    info.set_defaults(run=_info)
    clear = actions.add_parser("clear", help="remove the kernels of all versions")
    clear.add_argument("--stale", action="store_true", help="only those that this version does not use")
    clear.set_defaults(run=_clear)


def _warm(args: argparse.Namespace) -> int:
    """Compile, stage by stage."""
    import numpy as np

    from minisplat_ref.extensions import folders
    from minisplat_ref.extensions.warm_up import warm_up
    from minisplat_ref.jit.compile import cache_folder
    from minisplat_ref.jit.kernel_cache import kernel_folders
    from minisplat_ref.jit.warm_up import Dtype
    from minisplat_ref.rendering.warm_up import STAGES

    if cache_folder() is None:
        raise InputError("the folder for kernels cannot be written: set NUMBA_CACHE_DIR to one that can")
    start = time.perf_counter()
    dtypes: list[Dtype] = [np.float32, np.float64] if args.float64 else [np.float32]
    extensions: tuple[str, ...] = ()
    try:
        extensions = tuple(folders())
    except InputError as error:  # the core's kernels do not depend on the user's folders
        print(f"minisplat-ref: warning: {error}", file=sys.stderr)
    done = 0
    for dtype in dtypes:
        for compiled in warm_up(dtype=dtype, n_processes=args.processes, extensions=extensions):
            done += 1
            count = f"{done:>2} of {len(dtypes) * (len(STAGES) + len(extensions))}"
            print(f"{count}  {compiled.seconds:5.1f} s  {compiled.name} ({dtype.__name__})", file=sys.stderr)
            if compiled.problem:
                print(f"minisplat-ref: warning: {compiled.problem}", file=sys.stderr)
    current, *others = kernel_folders()
    print(f"{_line(current)}\nready after {time.perf_counter() - start:.1f} s")
    if others:
        print(f"{len(others)} folders of other versions hold {_size(others)}; to remove them: cache clear --stale")
    return 0


def _info(args: argparse.Namespace) -> int:
    """Print a line per folder."""
    from minisplat_ref.jit.compile import cache_folder, cache_root, source_hash
    from minisplat_ref.jit.kernel_cache import kernel_folders

    print(f"place    {cache_root()}{'' if cache_folder() else ' (cannot be written: nothing is kept)'}")
    print(f"version  {source_hash()}")
    for folder in kernel_folders():
        print(f"{'in use ' if folder.is_current else 'other  '}  {_line(folder)}")
    return 0


def _clear(args: argparse.Namespace) -> int:
    """Remove the folders and list them."""
    from minisplat_ref.jit.kernel_cache import kernel_folders, remove

    folders = [folder for folder in kernel_folders() if not (args.stale and folder.is_current)]
    for folder in folders:
        remove(folder)
        print(f"removed {_line(folder)}")
    print(f"{len(folders)} folders, {_size(folders)}")
    return 0


def _line(folder: "KernelFolder") -> str:
    return f"{folder.path}: {folder.n_kernels} kernels, {_size([folder])}"


def _size(folders: "list[KernelFolder]") -> str:
    return f"{sum(folder.n_bytes for folder in folders) / 1e6:.1f} MB"
