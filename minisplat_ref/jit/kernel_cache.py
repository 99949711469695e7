"""The folders of compiled kernels: list them, describe them, and remove them.

Every version of the kernels has its own folder, named by a hash (:mod:`minisplat_ref.jit.compile`). So nothing
stale can be loaded, but the folders of old versions stay behind: only the user knows which of them another installation
still uses. Other content in the same place, such as the cache of other packages that use Numba where
``NUMBA_CACHE_DIR`` is set, is neither listed nor touched.
"""

import re
import shutil
from pathlib import Path
from typing import NamedTuple

from minisplat_ref.errors import InputError
from minisplat_ref.jit.compile import cache_root, source_hash

_HASH = re.compile("[0-9a-f]{16}")  # Numba's own folders have longer names
_KERNEL_FILES = ("lock", "*.lock", "*.nbi", "*.nbc", "*.tmp.*")  # locks, index, code, code half written in a crash


class KernelFolder(NamedTuple):
    """Compiled kernels of one version of their sources."""

    path: Path
    n_kernels: int
    """Compiled functions, one for each combination of types."""
    n_bytes: int
    is_current: bool
    """Whether this installation uses it."""


def kernel_folders() -> list[KernelFolder]:
    """Return the folders of all versions, the one in use first, then the newest first."""
    root = cache_root()
    paths = [path for path in root.iterdir() if _is_ours(path)] if root.is_dir() else []
    folders = [(path.stat().st_mtime, _folder(path)) for path in paths]
    return [folder for _, folder in sorted(folders, key=lambda pair: (pair[1].is_current, pair[0]), reverse=True)]


def remove(folder: KernelFolder) -> None:
    """Delete a folder of kernels. Running processes keep what they have loaded; later ones compile again.

    Raises
    ------
    InputError
        The system refuses.
    """
    try:
        shutil.rmtree(folder.path)
    except OSError as error:
        raise InputError(f"{folder.path} cannot be removed: {error.strerror}") from error


def _is_ours(path: Path) -> bool:
    """Return whether it is named like a folder of kernels and contains nothing else."""
    if path.is_symlink() or not path.is_dir() or not _HASH.fullmatch(path.name):
        return False
    return all(file.is_dir() or any(map(file.match, _KERNEL_FILES)) for file in path.rglob("*"))


def _folder(path: Path) -> KernelFolder:
    files = [file for file in path.rglob("*") if file.is_file()]
    n_kernels = sum(file.suffix == ".nbc" for file in files)
    return KernelFolder(path, n_kernels, sum(file.stat().st_size for file in files), path.name == source_hash())
