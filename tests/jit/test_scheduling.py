"""Parts of work that threads take: each exactly once, however many threads there are."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from minisplat_ref.jit.compile import kernel, n_threads, prange
from minisplat_ref.jit.scheduling import dynamic_range, fetch_and_add, make_shared_counter


@kernel()
def count_parts(n, counts):
    taken = make_shared_counter()
    for _ in prange(n):
        for part in dynamic_range(taken, counts.size):
            counts[part] += 1


@pytest.mark.parametrize("n_parts", [0, 1, 3, 3_000_000])  # the last takes longer than a thread takes to wake
def test_every_part_is_taken_once(n_parts):
    counts = np.zeros(n_parts, np.int64)
    count_parts(4 * n_threads(), counts)
    assert_array_equal(counts, 1)


def test_python_takes_the_same_parts():
    taken = make_shared_counter()
    assert fetch_and_add(taken, 1) == 0
    assert list(dynamic_range(taken, 4)) == [1, 2, 3]
    assert list(dynamic_range(taken, 4)) == []
