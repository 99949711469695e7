"""A file or folder is there complete or not at all: written beside its place, then renamed onto it."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from minisplat_ref.errors import InputError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside ``path``; rename it onto ``path`` when the block ends, remove it when it fails.

    Parameters
    ----------
    path : str or Path
        The file to make or replace. Its folder must exist.

    Yields
    ------
    Path
        The temporary file to write, in the same folder because a rename across disks is a copy.

    Raises
    ------
    InputError
        If the folder does not exist.
    """
    path = Path(path)
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: the folder {path.absolute().parent} does not exist; create it first")
    temporary = _part_of(path)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def making_folder(path: str | Path) -> Iterator[Path]:
    """Give a new temporary folder beside ``path``; rename it to ``path`` when the block ends, remove it when it fails.

    Raises
    ------
    InputError
        If ``path`` exists and is not an empty folder, or cannot be made. Parents are made.
    """
    path = Path(path)
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(f"{path}: already there and not empty; choose another name or remove it first")
    temporary = _part_of(path)
    try:
        temporary.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be made ({error.strerror}); choose another place") from None
    try:
        yield temporary
        if path.exists():  # empty, see above; elsewhere than on POSIX a folder cannot be renamed onto another
            path.rmdir()
        os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _part_of(path: Path) -> Path:
    """Name for what is being written, unique to this process."""
    return path.absolute().with_name(f".{path.absolute().name}.{os.getpid()}.part")
