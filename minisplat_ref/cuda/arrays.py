"""Arrays and bundles of arrays on their way to the device and back.

The results of a stage are where its data were: on the device for arrays of the device, on the host for NumPy arrays.
Everything that is copied passes through :func:`to_device` and :func:`to_host`.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from minisplat_ref.cuda.target import cuda, gpu_kernel, launch_rows
from minisplat_ref.jit.literals import ZERO
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


def is_on_device(value: Any) -> bool:
    """Return whether an array is on the device."""
    return hasattr(value, "copy_to_host")


def beside(like: Any, value: Any) -> Any:
    """Return results on the device, an array or a bundle, where the data ``like`` are: there, or on the host."""
    return value if is_on_device(like) else to_host(value)


def empty(shape: Any, dtype: Any) -> Any:
    """Return an uninitialised array on the device."""
    return cuda.device_array(shape, dtype)


@gpu_kernel
def clear_rows(table):
    """Set a row of ``table`` [N, W] to zero."""
    n = cuda.grid(1)
    if n < table.shape[0]:
        for k in range(table.shape[1]):
            table[n, k] = ZERO


def write_zeros(table: Any) -> None:
    """Set a table [N, W] of the device to zero."""
    launch_rows(clear_rows, table.shape[0], table)


def zeros(shape: tuple[int, int], dtype: Any) -> Floats:
    """Return a table of zeros on the device."""
    table = empty(shape, dtype)
    write_zeros(table)
    return table
