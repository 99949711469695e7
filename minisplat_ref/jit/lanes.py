"""Eight numbers as one value: eight pixels of a row, or eight Gaussians.

A formula written for one number works for eight: ``+ - * /``, comparisons and the functions below take lanes as they
take single numbers. Compiled, eight float32 lanes are one AVX register: a loop over rows of pixels is explicit vector
code and does not depend on the compiler's proof that it may be. There are no tests before the loop, no remainder after
it, and every sum has the order that is written. In plain Python lanes are an array of eight.

A single number combined with lanes is broadcast. It may be narrower than they are but not wider: a float64 that is
combined with float32 lanes by mistake does not compile. Where lanes need different results, ``select`` chooses. Lanes
are values: ``x += y`` would change every name of the same array in Python, and does not compile.
"""

from typing import Any

import numpy as np

WIDTH = 8


def maximum(a: Any, b: Any) -> Any:
    """Return the larger of two, lane by lane; ``a`` where one is NaN."""
    return np.where(b > a, b, a)[()]


def minimum(a: Any, b: Any) -> Any:
    """Return the smaller of two, lane by lane; ``a`` where one is NaN."""
    return np.where(b < a, b, a)[()]


def floor(a: Any) -> Any:
    """Return the largest integer not above."""
    return np.floor(a)


def ceil(a: Any) -> Any:
    """Return the smallest integer not below."""
    return np.ceil(a)


def rint(a: Any) -> Any:
    """Return the nearest integer, as a float."""
    return np.rint(a)


def sqrt(a: Any) -> Any:
    """Return the square root."""
    return np.sqrt(a)


def libm_exp(a: Any) -> Any:
    """Return libm's exp of every lane."""
    return np.exp(a)


def libm_log(a: Any) -> Any:
    """Return libm's natural logarithm of every lane."""
    return np.log(a)


def ldexp(a: Any, n: Any) -> Any:
    """Return ``a 2^n`` of lanes, for integers n that keep it a normal number: n is added to the exponent."""
    return np.ldexp(a, np.asarray(n, np.int32))


def select(condition: Any, a: Any, b: Any) -> Any:
    """Return ``a`` in the lanes where the condition holds and ``b`` in the others."""
    return np.where(condition, a, b)[()]


def broadcast(number: Any) -> Any:
    """Return lanes that all hold a number."""
    return np.full(WIDTH, number)


def iota(zero: Any) -> Any:
    """Return lanes 0, 1, ... 7 of the dtype of a number."""
    return np.arange(WIDTH).astype(zero.dtype)


def load(array: Any, i: Any) -> Any:
    """Return the eight numbers of a 1D array from ``i`` on."""
    return array[i : i + WIDTH].copy()


def store(array: Any, i: Any, lanes: Any) -> None:
    """Write lanes, or a tuple of lanes one after the other, to a 1D array from ``i`` on."""
    numbers = np.ravel(lanes)
    array[i : i + max(numbers.size, WIDTH)] = numbers


def accumulate(array: Any, i: Any, lanes: Any) -> None:
    """Add lanes, or a tuple of lanes one after the other, to the numbers of a 1D array from ``i`` on."""
    for k, one in enumerate(lanes if isinstance(lanes, tuple) else (lanes,)):
        array[i + k * WIDTH : i + (k + 1) * WIDTH] += one


def gather(table: Any, rows: Any, column: Any) -> Any:
    """Return one number from each of eight rows of a table [N, ...]; further dimensions are flattened."""
    return table.reshape(len(table), -1)[list(rows), column]


def scatter(table: Any, rows: Any, column: Any, lanes: Any) -> None:
    """Write one number to each of eight rows of a table, rounded to its dtype: the inverse of ``gather``.

    A tuple of eight lanes is eight columns, of which the first is ``column``.
    """
    columns = range(column, column + WIDTH) if isinstance(lanes, tuple) else [column]
    table.reshape(len(table), -1)[np.ix_(rows, columns)] = np.reshape(lanes, (len(columns), WIDTH)).T


def transpose(rows: Any) -> Any:
    """Transpose a tuple of eight lanes: return the first number of each, then the second of each, and so on."""
    return tuple(np.array(rows).T)


def cast(lanes: Any, zero: Any) -> Any:
    """Return lanes in the dtype of a number."""
    return lanes.astype(zero.dtype)


def reduce_sum(lanes: Any) -> Any:
    """Return the sum of the lanes: of halves, then of quarters, then of the last two."""
    while len(lanes) > 1:
        lanes = lanes[: len(lanes) // 2] + lanes[len(lanes) // 2 :]
    return lanes[0]


def reduce_sums(rows: Any) -> Any:
    """Return the sums of a tuple of eight lanes as lanes: eight ``reduce_sum`` with half as many instructions."""
    return np.array([reduce_sum(lanes) for lanes in rows])


def reduce_max(lanes: Any) -> Any:
    """Return the largest lane."""
    while len(lanes) > 1:
        lanes = maximum(lanes[: len(lanes) // 2], lanes[len(lanes) // 2 :])
    return lanes[0]


def reduce_any(condition: Any) -> bool:
    """Return whether a condition holds in any lane."""
    return bool(np.any(condition))


def prefetch(table: Any, row: Any) -> None:
    """Prefetch a row of a table [N, D], so that it is loaded while something else is computed."""


def lowest_bit(bits: Any) -> int:
    """Return the index of the lowest set bit of an integer that is not zero."""
    return (int(bits) & -int(bits)).bit_length() - 1


def range_mask(bounds: Any) -> Any:
    """Return an integer of 64 bits; in its quarter ``k`` the bits [``bounds[k]``, ``bounds[4 + k]``) are set.

    Bounds are integers up to 16, in lanes. A start is not negative; an end that is not above its start sets no bits.
    """
    bits = 0
    for k in range(4):
        first, end = int(bounds[k]), int(bounds[4 + k])
        bits |= ((1 << max(first, end)) - (1 << first)) << 16 * k
    return np.uint64(bits)
