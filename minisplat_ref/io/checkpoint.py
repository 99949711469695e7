"""Checkpoints: named arrays and one JSON description in a .npz file that is either whole or absent."""

import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing

FORMAT = "minisplat_ref checkpoint 2"  # changes when an older file can no longer be continued
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
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(arrays.pop(_HEADER).tobytes())
        if header["format"] != FORMAT:
            raise InputError(f"{path} is {header['format']!r}, this version reads {FORMAT!r}: train anew")
        return arrays, header["metadata"]
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist: give a checkpoint that a training has written") from error
    except InputError:
        raise
    except (OSError, ValueError, TypeError, KeyError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is not a checkpoint or is damaged ({error}): delete it and train anew") from error
