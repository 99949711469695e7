"""Checkpoints: named arrays and one JSON description in a .npz file that is either whole or absent.

The file contains the SHA-256 of its contents. Zip's own checksums detect a damaged array, but neither a missing one nor
one that belongs to another checkpoint.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.json_file import parse_json
from minisplat_ref.io.npz import read_npz

FORMAT = "minisplat_ref checkpoint 2"  # changes when an older file can no longer be continued
WAY_OUT = "delete it and train again"
_HEADER = "header"


class DamagedCheckpoint(InputError):
    """The file is missing, cannot be read, or was changed; an older one may still be intact."""


def save_checkpoint(
    path: str | Path,
    arrays: Mapping[str, NDArray[Any]],
    metadata: Mapping[str, Any],
    *,
    previous: str | Path | None = None,
) -> None:
    """Write a checkpoint; during the writing, or after a crash, ``path`` is the old one or the new one.

    Parameters
    ----------
    path : path
        File to write or replace.
    arrays : mapping of str to ndarray
        Stored bit by bit.
    metadata : mapping
        Anything that JSON can hold; integers of any size and floats come back exactly.
    previous : path, optional
        Path to which the replaced file moves once the new one has been written.

    Raises
    ------
    InputError
        The file cannot be written; the old one stays unchanged.
    """
    content = {"format": FORMAT, "metadata": dict(metadata), "sha256": _digest(arrays, metadata)}
    header = np.frombuffer(json.dumps(content).encode(), np.uint8)
    with replacing(path) as temporary:
        with open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, **{_HEADER: header}, **arrays)
        if previous is not None and Path(path).exists():
            _keep(Path(path), Path(previous))


def _keep(path: Path, name: Path) -> None:
    """Give a file a second name, under which it remains when the first is replaced."""
    with replacing(name) as temporary:
        try:
            os.link(path, temporary)
        except OSError:  # a file system without links
            shutil.copyfile(path, temporary)


def _digest(arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the description and of the names, types, shapes and bytes of all arrays."""
    digest = hashlib.sha256(json.dumps(dict(metadata)).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def load_checkpoint(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read a file of :func:`save_checkpoint`.

    Returns
    -------
    arrays : dict of str to ndarray
    metadata : dict

    Raises
    ------
    DamagedCheckpoint
        The file is missing, damaged or no checkpoint.
    InputError
        It is a checkpoint of another version.
    """
    arrays, header = _read(path)
    metadata = header["metadata"]
    if "sha256" in header and header["sha256"] != _digest(arrays, metadata):  # older files do not have it
        raise DamagedCheckpoint(f"{path} is damaged, its content does not have the hash that it names; {WAY_OUT}")
    return arrays, metadata


def load_metadata(path: str | Path) -> dict[str, Any]:
    """Read the description alone, without checking for damage.

    Raises
    ------
    DamagedCheckpoint, InputError
        As for :func:`load_checkpoint`.
    """
    return _read(path, (_HEADER,))[1]["metadata"]


def _read(path: str | Path, names: Collection[str] | None = None) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read the arrays, or those of some names, and the header."""
    if not Path(path).exists():
        raise DamagedCheckpoint(f"{path} does not exist: give a checkpoint that a training has written")
    try:
        arrays = read_npz(path, WAY_OUT, names)
        if _HEADER not in arrays:
            raise InputError(f"{path} is an .npz of arrays, but not a checkpoint; {WAY_OUT}")
        header = parse_json(arrays.pop(_HEADER).tobytes(), path, WAY_OUT)
        if not isinstance(header, dict) or not isinstance(header.get("metadata"), dict):
            raise InputError(f"{path} is not a checkpoint, its header holds no metadata; {WAY_OUT}")
    except InputError as error:
        raise DamagedCheckpoint(str(error)) from error
    if header.get("format") != FORMAT:
        raise InputError(f"{path} is {header.get('format')!r}, this version reads {FORMAT!r}: train again")
    return arrays, header
