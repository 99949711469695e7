"""Read arrays from untrusted .npz files: nothing is allocated before the file is known to contain it.

An .npz is a zip of .npy files: a header in Python's notation, then the bytes of an array. This reads numbers and
booleans, stored or deflated; the header is matched, not evaluated, and no object is ever unpickled. Left out:
structured types, strings, times.
"""

import math
import os
import re
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError

RATIO_MAX = 16  # bytes of arrays per byte of file: floating-point numbers hardly compress, zeros a thousandfold
_PREFIX = 10  # bytes before the text of a header of format 1.0: magic, version, length of the text
_HEADER = re.compile(
    r"\{\s*'descr':\s*'(?P<dtype>[<>|=]?[a-zA-Z]\d{0,4})',\s*'fortran_order':\s*(?P<is_fortran>True|False),"
    r"\s*'shape':\s*\((?P<shape>[\d, ]*)\),?\s*\}\s*"
)
_NUMBERS = "biufc"  # kinds of dtypes: bool, integers, floating point, complex


def read_npz(path: str | Path, way_out: str, names: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read all arrays of an .npz file, or some.

    Parameters
    ----------
    path : str or Path
    way_out : str
        What to do about a bad file, for the end of the message.
    names : collection of str, optional
        The arrays that are read; all by default.

    Returns
    -------
    dict of str to ndarray
        By name, without the suffix ``.npy``.

    Raises
    ------
    InputError
        If the file is missing, damaged or no .npz, contains anything but numbers, or claims more than fits in it.
    """
    try:
        with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
            infos = archive.infolist()
            claimed, found = sum(info.file_size for info in infos), os.fstat(file.fileno()).st_size
            if claimed > RATIO_MAX * found:
                raise InputError(
                    f"{path}: its arrays would take {claimed:,} bytes, {claimed / found:.0f} times those of the file,"
                    f" which no .npz of measured numbers does; {way_out}"
                )
            arrays: dict[str, NDArray[Any]] = {}
            for info in infos:
                name = info.filename.removesuffix(".npy")
                if name in arrays:
                    raise InputError(f"{path}: holds {name} twice; {way_out}")
                if names is not None and name not in names:
                    continue
                arrays[name] = _read_array(archive, info, path, way_out)
            return arrays
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); {way_out}") from error
    except Exception as error:  # zipfile and the decoders raise a dozen types of errors for damaged bytes
        raise InputError(f"{path} is not an .npz of plain arrays, or is damaged ({error}); {way_out}") from error


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: str | Path, way_out: str) -> NDArray[Any]:
    """Read one array, whose header must agree with the bytes that there are."""
    with archive.open(info) as file:
        prefix = file.read(_PREFIX)
        header = _HEADER.fullmatch(file.read(int.from_bytes(prefix[8:], "little")).decode("latin-1"))
        if prefix[:8] != b"\x93NUMPY\x01\x00" or header is None or header["dtype"].endswith("O"):
            raise InputError(f"{path} is not an .npz of plain arrays, {info.filename} is none; {way_out}")
        dtype = np.dtype(header["dtype"])
        if dtype.kind not in _NUMBERS:
            raise InputError(
                f"{path}: {info.filename} has dtype {dtype}; only floating point and integers are read; {way_out}"
            )
        shape = tuple(int(size) for size in header["shape"].replace(" ", "").rstrip(",").split(",") if size)
        n_bytes = info.file_size - _PREFIX - len(header[0])
        if math.prod(shape) * dtype.itemsize != n_bytes:
            raise InputError(
                f"{path}: {info.filename} should be {dtype}{list(shape)}, but {n_bytes} bytes are there; {way_out}"
            )
        content = file.read()  # reading to the end compares the checksum
    if len(content) != n_bytes:
        raise InputError(f"{path}: {info.filename} is truncated; {way_out}")
    array = np.frombuffer(content, dtype).reshape(shape, order="F" if header["is_fortran"] == "True" else "C")
    return array.astype(dtype.newbyteorder("="), order="K")  # a copy, which can be written to
