"""Lanes compute, lane by lane, what single numbers do, compiled as in plain Python."""

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.cpu.compositing.exponential import exp_exact, exp_fast, exp_wide
from minisplat_ref.jit.lanes import (
    WIDTH,
    accumulate,
    broadcast,
    cast,
    floor,
    gather,
    iota,
    ldexp,
    load,
    lowest_bit,
    maximum,
    minimum,
    prefetch,
    range_mask,
    reduce_any,
    reduce_max,
    reduce_sum,
    reduce_sums,
    rint,
    scatter,
    select,
    sqrt,
    store,
)
from minisplat_ref.jit.literals import ONE

DTYPES = [np.float32, np.float64]


def compiled(function):
    return numba.njit(error_model="numpy")(function)


def two_ways(function, *args):
    """Result of a function that writes to its last argument, compiled and in Python."""
    *inputs, out = args
    results = []
    for run in (compiled(function), function):
        result = out.copy()
        run(*inputs, result)
        results.append(result)
    return results


OPERATIONS = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / b,
    "negative": lambda a, b: -a,
    "absolute": lambda a, b: abs(a),
    "maximum": lambda a, b: maximum(a, b),
    "minimum": lambda a, b: minimum(a, b),
    "floor": lambda a, b: floor(a),
    "nearest": lambda a, b: rint(a),
    "root": lambda a, b: sqrt(abs(a)),
    "select": lambda a, b: select((a < b) & (a > -b), a, b),
    "select at equality": lambda a, b: select(a >= a, select(b <= b, a, b), b),
    "whole number": lambda a, b: 2 * a - b / 4,
    "number among lanes": lambda a, b: select(a < b, a, 1),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS)
def test_operation(operation, dtype, rng):
    operation = numba.extending.register_jitable(operation)

    def run(a, b, out):
        for i in range(0, a.size, WIDTH):
            store(out, i, operation(load(a, i), load(b, i)))

    a, b = (rng.normal(scale=3, size=4 * WIDTH).astype(dtype) for _ in range(2))
    fast, plain = two_ways(run, a, b, np.zeros_like(a))
    single = np.array([operation(x, y) for x, y in zip(a, b, strict=True)], dtype)
    assert fast.any() and len(set(fast)) > WIDTH
    assert_array_equal(fast, plain)
    assert_array_equal(fast, single)


@pytest.mark.parametrize("dtype", DTYPES)
def test_single_number_is_taken_eight_times(dtype, rng):
    def run(a, number, out):
        store(out, 0, number - load(a, 0))
        store(out, WIDTH, broadcast(a[0]))
        store(out, 2 * WIDTH, iota(a[0]))
        store(out, 3 * WIDTH, number)

    a, number = rng.normal(size=WIDTH).astype(dtype), np.float32(0.75)
    fast, plain = two_ways(run, a, number, np.zeros(4 * WIDTH, dtype))
    assert_array_equal(fast, plain)
    assert_array_equal(fast, np.concatenate([number - a, a[:1].repeat(8), np.arange(8), [number] * 8]))


def test_wider_number_does_not_meet_narrower_lanes():
    product = compiled(lambda a, number: reduce_sum(load(a, 0) * number))
    with pytest.raises(numba.TypingError):
        product(np.ones(WIDTH, np.float32), 0.5)
    assert product(np.ones(WIDTH), np.float32(0.5)) == 4


def test_lanes_are_not_changed_in_place():
    """In Python ``+=`` would change every name of the same array."""

    @compiled
    def add(a):
        total = load(a, 0)
        total += load(a, 0)
        return reduce_sum(total)

    with pytest.raises(numba.TypingError):
        add(np.ones(WIDTH))


@pytest.mark.parametrize("dtype", DTYPES)
def test_reductions_have_one_order(dtype, rng):
    def run(a, out):
        first = load(a, 0), load(a, WIDTH), load(a, 2 * WIDTH), load(a, 3 * WIDTH)
        last = load(a, 4 * WIDTH), load(a, 5 * WIDTH), load(a, 6 * WIDTH), load(a, 7 * WIDTH)
        store(out, 0, reduce_sums((*first, *last)))
        for i in range(8):
            out[WIDTH + i] = reduce_sum(load(a, i * WIDTH))
            out[2 * WIDTH + i] = reduce_max(load(a, i * WIDTH))

    a = rng.normal(size=8 * WIDTH).astype(dtype)
    fast, plain = two_ways(run, a, np.zeros(3 * WIDTH, dtype))
    assert_array_equal(fast, plain)
    assert_array_equal(fast[:8], fast[8:16])
    assert_array_equal(fast[16:], a.reshape(8, WIDTH).max(axis=1))
    halves = a.reshape(8, 2, 4)
    quarters = (halves[:, 0] + halves[:, 1]).reshape(8, 2, 2)
    assert_array_equal(fast[:8], (quarters[:, 0] + quarters[:, 1]).sum(axis=1))


@pytest.mark.parametrize("lane", range(WIDTH))
def test_any_sees_every_lane(lane):
    a = np.zeros(WIDTH, np.float32)
    found = compiled(lambda a: reduce_any(load(a, 0) > np.float32(0.5)))
    assert not found(a) and not reduce_any(a > 0.5)
    a[lane] = 1
    assert found(a) and reduce_any(a > 0.5)


@pytest.mark.parametrize(("dtype", "lowest"), [(np.float32, -60), (np.float64, -1000)])
def test_power_of_two_is_added_to_the_exponent(dtype, lowest, rng):
    def run(a, n, out):
        store(out, 0, ldexp(load(a, 0), load(n, 0)))

    a, n = rng.uniform(0.7, 1.4, WIDTH).astype(dtype), rng.integers(lowest, 1, WIDTH).astype(dtype)
    n[0] = lowest
    fast, plain = two_ways(run, a, n, np.zeros_like(a))
    assert_array_equal(fast, plain)
    assert_array_equal(fast, a * np.exp2(n))


@pytest.mark.parametrize("bits", [1, 2, 0b1010000, 1 << 63, (1 << 64) - 1])
def test_lowest_bit(bits):
    expected = next(k for k in range(64) if bits >> k & 1)
    assert lowest_bit(np.uint64(bits)) == expected
    assert compiled(lambda bits: lowest_bit(bits))(np.uint64(bits)) == expected


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("firsts", "ends", "quarters"),
    [
        ((0, 3, 15, 0), (1, 5, 16, 16), ("0001", "0018", "8000", "ffff")),
        ((16, 7, 9, 2), (16, 7, 4, -16), ("0000", "0000", "0000", "0000")),  # no end is behind its start
        ((0, 0, 16, 4), (16, 0, 0, 15), ("ffff", "0000", "0000", "7ff0")),
    ],
)
def test_bits_between_bounds(firsts, ends, quarters, dtype):
    bounds, expected = np.array([*firsts, *ends], dtype), int("".join(reversed(quarters)), 16)
    assert range_mask(bounds) == expected
    assert compiled(lambda bounds: range_mask(load(bounds, 0)))(bounds) == expected


def test_prefetch_changes_nothing():
    table = np.arange(40.0).reshape(5, 8)
    expected = table.copy()
    compiled(lambda table: prefetch(table, 4))(table)
    prefetch(table, 4)
    assert_array_equal(table, expected)


ROWS = (9, 0, 4, 4, 7, 2, 11, 5)


@pytest.mark.parametrize("table_dtype", [np.int32, *DTYPES])
@pytest.mark.parametrize("dtype", DTYPES)
def test_gather_takes_a_column_of_eight_rows(dtype, table_dtype, rng):
    def run(table, zero, out):
        store(out, 0, cast(gather(table, ROWS, 2), zero))

    table = (10 * rng.normal(size=(12, 3))).astype(table_dtype)
    fast, plain = two_ways(run, table, dtype(0), np.zeros(WIDTH, dtype))
    assert_array_equal(fast, plain)
    assert_array_equal(fast, table[ROWS, 2].astype(dtype))
    for other in (np.asfortranarray(table), np.repeat(table, 2, axis=1)[:, ::2]):
        assert_array_equal(two_ways(run, other, dtype(0), np.zeros(WIDTH, dtype))[0], fast)


@pytest.mark.parametrize("dtype", DTYPES)
def test_scatter_writes_a_column_or_eight_of_them(dtype, rng):
    def run(a, table):
        scatter(table, ROWS, 1, load(a, 0))
        first = load(a, 0), load(a, WIDTH), load(a, 2 * WIDTH), load(a, 3 * WIDTH)
        last = load(a, 4 * WIDTH), load(a, 5 * WIDTH), load(a, 6 * WIDTH), load(a, 7 * WIDTH)
        scatter(table, ROWS, 2, (*first, *last))

    a = rng.normal(size=8 * WIDTH)
    a[[3, 11, 19, 27, 35, 43, 51, 59]] = a[[2, 10, 18, 26, 34, 42, 50, 58]]  # one row is there twice
    fast, plain = two_ways(run, a, np.zeros((12, 11), dtype))
    assert_array_equal(fast, plain)
    expected = np.zeros((12, 11), dtype)
    expected[ROWS, 1], expected[ROWS, 2:10] = a[:WIDTH], a.reshape(8, WIDTH).T
    assert_array_equal(fast, expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_accumulate_adds_one_or_several_lanes(dtype, rng):
    def run(a, out):
        accumulate(out, 2, load(a, 0))
        accumulate(out, WIDTH, (load(a, WIDTH), ONE, load(a, 0)))
        accumulate(out, 0, ())

    a, start = rng.normal(size=2 * WIDTH).astype(dtype), rng.normal(size=5 * WIDTH).astype(dtype)
    fast, plain = two_ways(run, a, start)
    assert_array_equal(fast, plain)
    expected = start.copy()
    expected[2 : WIDTH + 2] += a[:WIDTH]
    expected[WIDTH : 4 * WIDTH] += np.concatenate([a[WIDTH:], np.ones(WIDTH, dtype), a[:WIDTH]])
    assert_array_equal(fast, expected)


def test_exponentials():
    def run(exp):
        exp = numba.extending.register_jitable(exp)

        @compiled
        def all_of(x, out):
            for i in range(0, x.size, WIDTH):
                store(out, i, exp(load(x, i)))

        return all_of

    x = -np.linspace(0, 6, 8000, dtype=np.float32)
    expected = np.exp(x.astype(np.float64))
    for exp, bound in ((exp_fast, 6e-7), (exp_exact, 1e-7)):  # of the docstring; half a unit in the last place is 6e-8
        out = np.zeros_like(x)
        run(exp)(x, out)
        assert np.abs(out / expected - 1).max() < bound
        assert np.abs(exp(x) / expected - 1).max() < 2 * bound  # in Python: NumPy's own exp is off by two units
    far = np.full(WIDTH, -1e30, np.float32)
    out = far.copy()
    run(exp_fast)(far, out)
    assert_allclose(out, 2.0**-60, rtol=6e-7)
    x = np.concatenate([-np.linspace(0, 6, 8000), -np.linspace(6, 690, 8000)])
    out, expected = np.zeros_like(x), np.exp(x.astype(np.longdouble))
    run(exp_wide)(x, out)
    assert np.abs(out / expected - 1).max() < 4e-16  # of the docstring
    assert np.abs(exp_wide(x) / expected - 1).max() < 1e-15  # in Python, where no products are contracted
    far = np.array([-700.0, -1e300, -np.inf, 0.0, -0.0, -1e-300, -800.0, -750.0])
    out = far.copy()
    run(exp_wide)(far, out)
    assert_allclose(out[[0, 3, 4, 5]], [np.exp(-700.0) if np.exp(-700.0) > 2.0**-1000 else out[0], 1, 1, 1], rtol=4e-16)
    assert (out[[1, 2, 6, 7]] <= 2.0**-1000).all()
