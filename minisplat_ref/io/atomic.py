"""Write a file or folder completely or not at all: write a temporary one next to it, then rename it.

A process that is killed leaves its unfinished part behind, under a name that :func:`remove_parts` recognises.
"""

import contextlib
import os
import re
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
        If the folder does not exist, or the file cannot be written: the disk is full or read-only, or there is a limit
        to the size of files. A previous file at ``path`` stays unchanged.
    """
    path = Path(path)
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: the folder {path.absolute().parent} does not exist; create it first")
    temporary = _part_of(path)
    try:
        yield temporary
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())  # before the rename; a full disk may only be reported now
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is not None and Path(os.fsdecode(error.filename)) != temporary:
            raise
        raise unwritable(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def unwritable(path: str | Path, error: OSError) -> InputError:
    """Return the error of one line for a file that cannot be written."""
    return InputError(f"{path} cannot be written ({error.strerror or error}): make room there or choose another place")


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


@contextmanager
def replacing_folder(path: str | Path) -> Iterator[Path]:
    """Give a new temporary folder beside ``path``; when the block ends it replaces ``path`` and all that it held.

    Raises
    ------
    InputError
        If the folder cannot be made.
    """
    path = Path(path)
    temporary = _part_of(path)
    old = temporary.with_name(f"{temporary.name}.old.{os.getpid()}.part")
    try:
        temporary.mkdir(parents=True)
    except OSError as error:
        raise unwritable(path, error) from None
    try:
        yield temporary
        if path.exists():
            os.replace(path, old)
        os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def is_part(path: Path) -> bool:
    """Return whether a file or folder is the unfinished output of a killed process."""
    return re.fullmatch(r"\..+\.\d+\.part", path.name) is not None


def remove_parts(folder: Path) -> None:
    """Remove the unfinished output of killed processes in a folder. No other process may be writing there now."""
    for path in filter(is_part, folder.iterdir()):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _part_of(path: Path) -> Path:
    """Return a name for unfinished output, unique to this process."""
    return path.absolute().with_name(f".{path.absolute().name}.{os.getpid()}.part")
