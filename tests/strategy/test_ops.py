"""Row operations on populations."""

from typing import NamedTuple

import numpy as np
from numpy.testing import assert_array_equal

from minisplat_ref.strategy.ops import NO_PARENT, concat, contiguous, inherit, inherit_fields, keep, n_rows, take
from minisplat_ref.types import Gaussians


class Pair(NamedTuple):
    """A population that the library has never heard of."""

    a: np.ndarray  # [N]
    b: np.ndarray  # [N, 2]


def make_pair(n, dtype=np.float32):
    return Pair(np.arange(n, dtype=dtype), np.arange(2 * n, dtype=dtype).reshape(n, 2))


def test_take_by_ids_and_by_mask():
    pair = make_pair(4)
    by_ids, by_mask = take(pair, np.array([3, 0, 3])), take(pair, np.array([True, False, False, True]))
    assert_array_equal(by_ids.a, [3, 0, 3])
    assert_array_equal(by_mask.b, [[0, 1], [6, 7]])
    assert type(by_ids) is Pair and by_ids.a.dtype == np.float32
    by_ids.a[:] = 9
    assert_array_equal(pair.a, [0, 1, 2, 3])  # a copy


def test_concat():
    joined = concat(make_pair(2), make_pair(0), make_pair(1))
    assert type(joined) is Pair and n_rows(joined) == 3
    assert_array_equal(joined.b, [[0, 1], [2, 3], [0, 1]])


def test_inherit_takes_parents_and_zeroes_what_is_new():
    field = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    parent_ids = np.array([2, 0, 0, NO_PARENT])
    no_reset, is_new = np.zeros(4, bool), np.array([False, False, True, True])
    assert_array_equal(inherit(field, parent_ids, no_reset), [[5, 6], [1, 2], [1, 2], [0, 0]])
    assert_array_equal(inherit(field, parent_ids, is_new), [[5, 6], [1, 2], [0, 0], [0, 0]])
    assert inherit(np.ones(3, np.int32), parent_ids, no_reset).dtype == np.int32
    assert_array_equal(inherit_fields(make_pair(3), parent_ids, is_new).a, [2, 0, 0, 0])


def test_no_parents_at_all():
    """A population that is replaced by points of another origin (depth reinitialisation)."""
    fields = inherit_fields(make_pair(3), np.full(5, NO_PARENT), np.ones(5, bool))
    assert_array_equal(fields.b, np.zeros((5, 2)))


def test_keep():
    gaussians = Gaussians(*(np.arange(3.0),) * 6)
    edit = keep(gaussians, np.array([True, False, True]))
    assert_array_equal(edit.gaussians.quats, [0, 2])
    assert_array_equal(edit.parent_ids, [0, 2])
    assert not edit.is_new.any()


def test_contiguous():
    pair = Pair(np.arange(8.0)[::2], np.arange(8.0).reshape(2, 4).T)
    assert all(field.flags.c_contiguous for field in contiguous(pair))
    assert_array_equal(contiguous(pair).b, pair.b)
