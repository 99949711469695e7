"""The optimiser step on the chosen rows of one array: bound by memory, so each number is read and written once."""

from minisplat_ref.scalar._jit import kernel, prange, scalar
from minisplat_ref.scalar.adam import adam_value
from minisplat_ref.types import Floats, Ints

N_CHUNKS = 64


@scalar
def _update_row(values, gradient, first, second, rate, keep1, keep2, eps):
    for i in range(values.size):
        values[i], first[i], second[i] = adam_value(
            values[i], gradient[i], first[i], second[i], rate, keep1, keep2, eps
        )


@kernel()
def _adam_update(values, gradient, first, second, rows, rate, keep1, keep2, eps):
    for chunk in prange(N_CHUNKS):
        for i in range(rows.size * chunk // N_CHUNKS, rows.size * (chunk + 1) // N_CHUNKS):
            n = rows[i]
            _update_row(values[n], gradient[n], first[n], second[n], rate, keep1, keep2, eps)


def adam_update(
    values: Floats,
    gradient: Floats,
    first: Floats,
    second: Floats,
    rows: Ints,
    rate: float,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """Update values and moments in place; see ``reference.adam.adam_update``."""
    constants = (values.dtype.type(number) for number in (rate, 1 - beta1, 1 - beta2, eps))
    _adam_update(values, gradient, first, second, rows, *constants)
