"""Arrays and bundles of arrays on their way to the device and back."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from minisplat_ref.cuda.target import cuda
from minisplat_ref.types import Floats


def as_bundle(like: Any, values: Iterable[Any]) -> Any:
    """Return values as a bundle of the same type as another."""
    return type(like)._make(values)


def to_device(value: Any) -> Any:
    """Copy an array, or every array of a bundle, to the device; other values stay as they are."""
    if isinstance(value, np.ndarray):
        return cuda.to_device(np.ascontiguousarray(value))
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return as_bundle(value, map(to_device, value))
    return value


def to_host(value: Any) -> Any:
    """Copy an array of the device, or every one of a bundle, to the host: the inverse of :func:`to_device`."""
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return as_bundle(value, map(to_host, value))
    return value.copy_to_host() if hasattr(value, "copy_to_host") else value


def empty(shape: Any, dtype: Any) -> Any:
    """Return an uninitialised array on the device."""
    return cuda.device_array(shape, dtype)


def zeros(shape: Any, dtype: Any) -> Floats:
    """Return zeros on the device."""
    return cuda.to_device(np.zeros(shape, dtype))
