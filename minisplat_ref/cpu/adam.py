"""The optimiser step on one array: bound by memory, so each number is read and written once.

The array is taken as flat: rows that follow one another are one run of numbers, whatever their width, and eight numbers
are updated at a time. Without this a row of three numbers costs as much as one of ten.
"""

from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, load, store
from minisplat_ref.scalar.adam import adam_value
from minisplat_ref.types import Floats, Ints

N_CHUNKS = 64


@scalar
def _update_run(values, gradient, first, second, start, end, rate, keep1, keep2, eps):
    i = start
    while i + WIDTH <= end:
        value, mean, square = adam_value(
            load(values, i), load(gradient, i), load(first, i), load(second, i), rate, keep1, keep2, eps
        )
        store(values, i, value)
        store(first, i, mean)
        store(second, i, square)
        i += WIDTH
    while i < end:
        values[i], first[i], second[i] = adam_value(
            values[i], gradient[i], first[i], second[i], rate, keep1, keep2, eps
        )
        i += 1


@kernel()
def _update_all(values, gradient, first, second, rate, keep1, keep2, eps):
    for chunk in prange(N_CHUNKS):
        start, end = values.size * chunk // N_CHUNKS, values.size * (chunk + 1) // N_CHUNKS
        _update_run(values, gradient, first, second, start, end, rate, keep1, keep2, eps)


@kernel()
def _update_rows(values, gradient, first, second, rows, width, rate, keep1, keep2, eps):
    for chunk in prange(N_CHUNKS):
        i, end = rows.size * chunk // N_CHUNKS, rows.size * (chunk + 1) // N_CHUNKS
        while i < end:
            row, after = rows[i], rows[i] + 1
            i += 1
            while i < end and rows[i] == after:
                after += 1
                i += 1
            _update_run(values, gradient, first, second, row * width, after * width, rate, keep1, keep2, eps)


def adam_update(
    values: Floats,
    gradient: Floats,
    first: Floats,
    second: Floats,
    rows: Ints | None,
    rate: float,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """Update values and moments in place; see ``reference.adam.adam_update``."""
    constants = (values.dtype.type(number) for number in (rate, 1 - beta1, 1 - beta2, eps))
    flat = (array.reshape(-1) for array in (values, gradient, first, second))
    if rows is None:
        _update_all(*flat, *constants)
    else:
        _update_rows(*flat, rows, values.shape[1], *constants)
