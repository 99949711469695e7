"""The optimiser step on one array: a thread for each number."""

import functools
from typing import Any

import numpy as np

from minisplat_ref.cuda.arrays import empty, is_on_device, to_device, to_host
from minisplat_ref.cuda.target import cuda, gpu_kernel, launch_rows
from minisplat_ref.scalar.adam import Step, adam_value
from minisplat_ref.types import AdamStep, Floats, Ints


@gpu_kernel
def update_numbers(
    tables,  # values, gradient and both moments, [N, W] each
    rows,  # [V], or [0] for all rows
    widths,  # [N] numbers of each row to update, or [0] for all
    step,
):
    """Update one number of one row."""
    values, gradient, first, second = tables
    width = values.shape[1]
    n_rows = rows.shape[0] if rows.shape[0] > 0 else values.shape[0]
    i = cuda.grid(1)
    if i >= n_rows * width:
        return
    listed = i // width
    k = i - listed * width
    n = rows[listed] if rows.shape[0] > 0 else listed
    if widths.shape[0] > 0 and k >= widths[n]:
        return
    values[n, k], first[n, k], second[n, k] = adam_value(values[n, k], gradient[n, k], first[n, k], second[n, k], step)


def adam_update(
    values: Floats,
    gradient: Floats,
    first: Floats,
    second: Floats,
    rows: Ints | None,
    step: AdamStep,
    widths: Ints | None = None,
) -> None:
    """Update values and moments in place; see ``reference.adam.adam_update``."""
    if rows is not None and len(rows) == 0:
        return
    real = values.dtype.type
    numbers = Step._make(real(number) for number in (step.rate, 1 - step.beta1, 1 - step.beta2, step.eps))
    tables = tuple(to_device(table) for table in (values, gradient, first, second))
    n_rows = len(values) if rows is None else len(rows)
    launch_rows(update_numbers, n_rows * values.shape[1], tables, list_on_device(rows), list_on_device(widths), numbers)
    for table, updated in ((values, tables[0]), (first, tables[2]), (second, tables[3])):
        if not is_on_device(table):
            table[...] = to_host(updated)


def list_on_device(numbers: Ints | None) -> Any:
    """Return a list of int32 on the device, an empty one for None."""
    if numbers is None:
        return _no_numbers()
    return numbers if is_on_device(numbers) else to_device(np.asarray(numbers, np.int32))


@functools.cache
def _no_numbers() -> Any:
    return empty(0, np.int32)
