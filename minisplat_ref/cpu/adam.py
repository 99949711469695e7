"""The optimiser step on one array. It is memory-bound, so each number is read and written once.

The array is treated as flat: consecutive rows form one run of numbers, whatever their width, and eight numbers are
updated at a time. Otherwise a row of three numbers would cost as much as one of ten.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, load, store
from minisplat_ref.scalar.adam import Step, adam_value
from minisplat_ref.types import AdamStep, Floats, Ints

N_CHUNKS = 64


class Tables(NamedTuple):
    """The four arrays of a step, flat."""

    values: Floats
    """[N * W], likewise below."""
    gradient: Floats
    first: Floats
    second: Floats


@scalar
def _update_run(tables, start, end, step):
    values, gradient, first, second = tables
    i = start
    while i + WIDTH <= end:
        value, mean, square = adam_value(load(values, i), load(gradient, i), load(first, i), load(second, i), step)
        store(values, i, value)
        store(first, i, mean)
        store(second, i, square)
        i += WIDTH
    while i < end:
        values[i], first[i], second[i] = adam_value(values[i], gradient[i], first[i], second[i], step)
        i += 1


@kernel()
def _update_all(
    tables,  # Tables
    step,
):
    n = tables.values.size
    for chunk in prange(N_CHUNKS):
        _update_run(tables, n * chunk // N_CHUNKS, n * (chunk + 1) // N_CHUNKS, step)


@kernel()
def _update_rows(
    tables,  # Tables
    rows,  # [V] ascending
    width,  # numbers in a row, W
    step,
):
    for chunk in prange(N_CHUNKS):
        i, end = rows.size * chunk // N_CHUNKS, rows.size * (chunk + 1) // N_CHUNKS
        while i < end:
            row, after = rows[i], rows[i] + 1
            i += 1
            while i < end and rows[i] == after:
                after += 1
                i += 1
            _update_run(tables, row * width, after * width, step)


@kernel()
def _update_parts(
    tables,  # Tables
    rows,  # [V] ascending
    width,  # numbers in a row, W
    widths,  # [N] of them to update
    step,
):
    for chunk in prange(N_CHUNKS):
        for i in range(rows.size * chunk // N_CHUNKS, rows.size * (chunk + 1) // N_CHUNKS):
            start = rows[i] * width
            _update_run(tables, start, start + widths[rows[i]], step)


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
    numbers = (step.rate, 1 - step.beta1, 1 - step.beta2, step.eps)
    in_dtype = Step._make(values.dtype.type(number) for number in numbers)
    tables = Tables(values.reshape(-1), gradient.reshape(-1), first.reshape(-1), second.reshape(-1))
    if widths is not None:
        rows = np.arange(len(values)) if rows is None else rows
        _update_parts(tables, rows, values.shape[1], widths, in_dtype)
    elif rows is None:
        _update_all(tables, in_dtype)
    else:
        _update_rows(tables, rows, values.shape[1], in_dtype)
