"""Visibility culling of Mini-Splatting2: the numbers that follow from the table of who is visible where."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.strategy.visibility import culled_fraction, find_seen_by_few, gradient_factors
from tolerances import CLOSED_FORM

IS_VISIBLE = np.array([[1, 1, 1, 1], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]], bool)
FRUSTUM_COUNT = np.array([4, 3, 1, 0], np.int32)

# Closed form ----------------------------------------------------------------------------------------------------------


def test_gradient_factors_by_hand():
    assert_allclose(gradient_factors(IS_VISIBLE, FRUSTUM_COUNT), [4 / 4.1, 2 / 3.1, 1 / 1.1, 0], rtol=CLOSED_FORM)


def test_mean_gradient_is_that_without_culling(rng):
    """Where a Gaussian is culled its gradient is zero: the mean over fewer views times the factor is the old mean.

    The factor counts 0.1 of a view too many, which the comparison takes out.
    """
    norms = rng.uniform(size=(50, 12))  # [N, V]
    is_in_frustum = rng.uniform(size=(50, 12)) < 0.8
    is_visible = is_in_frustum & (rng.uniform(size=(50, 12)) < 0.5)
    is_visible[:, 0] = is_in_frustum[:, 0] = True
    frustum_count = is_in_frustum.sum(axis=1)
    culled_mean = (norms * is_visible).sum(axis=1) / is_visible.sum(axis=1)
    full_mean = (norms * is_visible).sum(axis=1) / frustum_count
    corrected = culled_mean * gradient_factors(is_visible, frustum_count) * (frustum_count + 0.1) / frustum_count
    assert_allclose(corrected, full_mean, rtol=CLOSED_FORM)


def test_seen_by_few():
    assert_array_equal(find_seen_by_few(IS_VISIBLE, 2), [False, False, True, True])
    assert_array_equal(find_seen_by_few(IS_VISIBLE, 1), [False, False, False, True])
    assert_array_equal(find_seen_by_few(IS_VISIBLE, 0), [False] * 4)


def test_culled_fraction():
    """7 of 8 pairs are left."""
    assert culled_fraction(IS_VISIBLE, FRUSTUM_COUNT) == pytest.approx(1 / 8, rel=CLOSED_FORM)
    assert culled_fraction(np.ones((3, 5), bool), np.full(3, 5)) == 0.0
    assert culled_fraction(np.zeros((3, 5), bool), np.full(3, 5)) == 1.0


# Hard cases -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n_views", "least"), [(1, 1), (2, 1), (3, 2), (4, 2), (200, 2)])
def test_few_views_do_not_empty_the_scene(n_views, least):
    """Row i is visible in i views: those below `least` go."""
    is_visible = np.arange(n_views) < np.arange(n_views + 1)[:, None]
    assert_array_equal(find_seen_by_few(is_visible, 2), np.arange(n_views + 1) < least)


def test_nobody_and_no_view():
    nobody = np.zeros((0, 4), bool)
    assert len(gradient_factors(nobody, np.zeros(0, int))) == len(find_seen_by_few(nobody, 2)) == 0
    assert culled_fraction(nobody, np.zeros(0, int)) == 0.0
    assert culled_fraction(np.zeros((4, 3), bool), np.zeros(4, int)) == 0.0
    assert_array_equal(find_seen_by_few(np.zeros((3, 0), bool), 2), [False] * 3)
