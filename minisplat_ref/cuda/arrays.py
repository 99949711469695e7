"""Arrays and bundles of arrays on their way to the device and back."""

from typing import Any

import numpy as np

from minisplat_ref.cuda.target import cuda
from minisplat_ref.types import Floats


def to_device(value: Any) -> Any:
    """Copy an array, or every array of a bundle, to the device; other values stay as they are."""
    if isinstance(value, np.ndarray):
        return cuda.to_device(np.ascontiguousarray(value))
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)._make(map(to_device, value))
    return value


def to_host(value: Any) -> Any:
    """Copy an array of the device, or every one of a bundle, to the host: the inverse of :func:`to_device`."""
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)._make(map(to_host, value))
    return value.copy_to_host() if hasattr(value, "copy_to_host") else value


def empty_like(value: Any) -> Any:
    """Return uninitialised arrays on the device, of the shapes and dtypes of an array or of a bundle."""
    if isinstance(value, tuple):
        return type(value)._make(map(empty_like, value))
    return empty(value.shape, value.dtype)


def empty(shape: Any, dtype: Any) -> Any:
    """Return an uninitialised array on the device."""
    return cuda.device_array(shape, dtype)


def zeros(shape: Any, dtype: Any) -> Floats:
    """Return zeros on the device."""
    return cuda.to_device(np.zeros(shape, dtype))
