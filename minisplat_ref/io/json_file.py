"""Read JSON from outside: whatever a file contains, the result is a value or an InputError of one line."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.types import Floats


def read_json(path: Path, way_out: str) -> Any:
    """Parse a JSON file.

    Parameters
    ----------
    path : Path
    way_out : str
        What to do about a bad file, for the end of the message.

    Raises
    ------
    InputError
        If it cannot be read or is not valid JSON.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {way_out}") from None
    return parse_json(content, path, way_out)


def parse_json(content: bytes, source: str | Path, way_out: str) -> Any:
    """Parse JSON in UTF-8; if it is invalid, the InputError names ``source``."""
    try:
        return json.loads(content.decode("utf-8-sig"))  # some editors begin files with a byte order mark
    except ValueError as error:  # also for undecodable bytes, and integers of thousands of digits
        raise InputError(f"{source}: not valid JSON ({error}); {way_out}") from None
    except RecursionError:
        raise InputError(f"{source}: lists or objects are nested too deeply to be read; {way_out}") from None


def as_number(value: Any) -> float:
    """Return a value from a file as a number, NaN if it is none or too large; text that spells a number counts."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def as_array(value: Any, *shapes: tuple[int, ...]) -> Floats | None:
    """Return lists of numbers as a float64 array of one of the shapes, else None; it may contain NaN."""
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if array.shape in shapes else None
