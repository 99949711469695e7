"""Checkpoints: named arrays and one JSON description in a .npz file that is either whole or absent."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.json_file import parse_json
from minisplat_ref.io.npz import read_npz

FORMAT = "minisplat_ref checkpoint 2"  # changes when an older file can no longer be continued
WAY_OUT = "delete it and train anew"
_HEADER = "header"


def save_checkpoint(path: str | Path, arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, Any]) -> None:
    """Write a checkpoint; whoever opens ``path`` meanwhile, or after a crash, finds the old one or the new one.

    Parameters
    ----------
    path : path
        File to write or replace.
    arrays : mapping of str to ndarray
        Stored bit by bit.
    metadata : mapping
        Anything that JSON can hold; integers of any size and floats come back exactly.
    """
    header = json.dumps({"format": FORMAT, "metadata": dict(metadata)}).encode()
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, allow_pickle=False, **{_HEADER: np.frombuffer(header, np.uint8)}, **arrays)
        file.flush()
        os.fsync(file.fileno())  # the rename must not overtake the content


def load_checkpoint(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read what :func:`save_checkpoint` wrote.

    Returns
    -------
    arrays : dict of str to ndarray
    metadata : dict

    Raises
    ------
    InputError
        The file is missing, damaged, or not a checkpoint of this version.
    """
    if not Path(path).exists():
        raise InputError(f"{path} does not exist: give a checkpoint that a training has written")
    arrays = read_npz(path, WAY_OUT)
    if _HEADER not in arrays:
        raise InputError(f"{path} is an .npz of arrays, but not a checkpoint; {WAY_OUT}")
    header = parse_json(arrays.pop(_HEADER).tobytes(), path, WAY_OUT)
    if not isinstance(header, dict) or not isinstance(header.get("metadata"), dict):
        raise InputError(f"{path} is not a checkpoint, its header holds no metadata; {WAY_OUT}")
    if header.get("format") != FORMAT:
        raise InputError(f"{path} is {header.get('format')!r}, this version reads {FORMAT!r}: train anew")
    return arrays, header["metadata"]
