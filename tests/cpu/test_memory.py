"""Memory of large arrays is used again, but never while somebody holds it."""

import numpy as np
import pytest

from minisplat_ref.cpu import memory
from minisplat_ref.cpu.memory import LARGE, large_empty

SINGLE = np.dtype(np.float32)
N = LARGE // 4 + 1000


@pytest.fixture(autouse=True)
def nothing_cached(monkeypatch):
    monkeypatch.setattr(memory, "_cached", [])


def address(array):
    return array.__array_interface__["data"][0]


def test_memory_is_used_again():
    first = large_empty((N, 2), SINGLE)
    place = address(first)
    assert first.shape == (N, 2) and first.dtype == SINGLE and first.flags.c_contiguous and first.flags.writeable
    del first
    second = large_empty((2 * N - 7,), SINGLE)  # a little smaller
    assert address(second) == place and second.shape == (2 * N - 7,)


def test_not_while_a_view_is_held():
    first = large_empty((N,), SINGLE)
    view = first.reshape(-1, 1)[3:, 0]
    view[:] = 5
    del first
    second = large_empty((N,), SINGLE)
    second[:] = 7
    assert (view == 5).all() and not np.shares_memory(view, second)


def test_other_sizes_get_their_own():
    first = large_empty((4 * N,), SINGLE)
    del first
    [block] = memory._cached
    much_smaller = large_empty((N,), SINGLE)
    assert memory._cached == []  # what does not fit is given back
    assert not np.shares_memory(block, much_smaller)


def test_small_arrays_are_not_cached():
    small = large_empty((10,), SINGLE)
    del small
    assert memory._cached == []
