"""The evidence of photographs, by sums and pixels that were worked out by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.methods.adaptive.evidence import Evidence, Half, pairs, split_halves, weigh
from minisplat_ref.rendering import Request
from minisplat_ref.types import View
from scenes import make_camera


def half(projected, energy):
    """Of a field with b . b = 1, so that ``projected`` is the x that fits best."""
    return Half(np.array([[1.0]]), np.array([float(projected)]), float(energy))


# Halves ---------------------------------------------------------------------------------------------------------------


def test_the_middle_column_is_in_the_right_half():
    """Of five columns, in which r is 1 to 5 and b is 1: two are left, and three are right, in three colours each."""
    residual = np.broadcast_to(np.arange(1.0, 6)[:, None], (1, 5, 3))
    left, right = split_halves(residual, np.ones((1, 1, 5, 3)), np.ones((1, 5), bool))
    assert (left.normal[0, 0], left.projected[0], left.energy) == (6.0, 9.0, 15.0)
    assert (right.normal[0, 0], right.projected[0], right.energy) == (9.0, 36.0, 150.0)


def test_each_half_is_judged_by_the_other():
    """Fitted are x = 1 and 0 (-1 and 0 in the second photograph, so that 0 explains all best), of energy 2 and 1.

    With 0 the error is 2 + 1, with the other's x it is 2 on the left and 1 + 1 on the right: 10 lg (3 / 4) = -1.25 dB.
    With its own it would be 1 + 1, or 1.76 dB.
    """
    found = weigh([(half(1, 2), half(0, 1)), (half(-1, 2), half(0, 1))])
    assert_allclose(found.gain, -1.2494, rtol=2e-3)
    assert_allclose(found.standard_error, 0, atol=1e-12)


def test_the_comparison_starts_from_what_all_have_in_common():
    """x is 2 and 4, so 3 explains all best and leaves 1 + 1 beside the noise of 0.5 + 0.5; their own x leave the noise.

    10 lg (3 / 1) = 4.77 dB; from 0 on it would be 10 lg (9 / 1) and 10 lg (33 / 1). Fitted are -1 and 1.
    """
    found = weigh([(half(2, 4.5), half(2, 4.5)), (half(4, 16.5), half(4, 16.5))])
    assert_allclose(found.gain, 4.7712, rtol=2e-2)
    assert_allclose(found.fitted[:, 0], [-1, 1], rtol=2e-3)
    assert_allclose(found.spread, 1, rtol=2e-3)


def test_the_standard_error_is_that_of_a_mean():
    """Gains of 10 lg (1.1 / 0.1) = 10.41 dB and 10 lg (1.01 / 0.01) = 20.04 dB: 15.23 +- 9.63 / sqrt(2) / sqrt(2)."""
    found = weigh([(half(1, 1.1), half(1, 1.1)), (half(-1, 1.01), half(-1, 1.01))])
    assert_allclose(found.gain, 15.2287, rtol=1e-3)
    assert_allclose(found.standard_error, 4.8149, rtol=1e-3)


def test_where_nothing_is_left_to_explain_there_is_no_gain():
    found = weigh([(half(0, 0), half(0, 0))] * 2)
    assert (found.gain, found.standard_error) == (0, 0)


def test_spread_is_the_root_of_the_mean_square():
    """Of 1, 2, 2 and 4 it is the root of 25 / 4."""
    assert Evidence(0.0, 0.0, np.array([[1.0, -2], [2, -4]])).spread == 2.5


@pytest.mark.parametrize(
    ("gain", "min_gain", "n_errors", "is_above"),
    [(0.5, 0.5, 1, False), (0.51, 0.5, 1, True), (0.5, 0.0, 2, False), (0.51, 0.0, 2, True), (0.3, 0.0, None, True)],
)
def test_a_gain_above_the_least_one_and_its_errors(gain, min_gain, n_errors, is_above):
    """The standard error is 0.25 dB; one suffices where no number is given."""
    found = Evidence(gain, 0.25, np.zeros((2, 1)))
    assert found.is_above(min_gain, *(() if n_errors is None else (n_errors,))) == is_above


# Pixels ---------------------------------------------------------------------------------------------------------------


def setting(rendered, photograph, mask=None):
    """An iteration whose scene has one photograph, and renders this."""
    rendered, photograph = np.array(rendered, float), np.array(photograph, np.uint8)
    view = View("", make_camera(photograph.shape[1], photograph.shape[0]), photograph, mask)
    renderer = SimpleNamespace(render=lambda *_: (SimpleNamespace(image=rendered), None))
    settings = SimpleNamespace(renderer=renderer, request=lambda: Request(np.zeros(3)))
    return SimpleNamespace(model=None), SimpleNamespace(
        scene=SimpleNamespace(train_views=[view]), render_settings=settings
    )


def test_renderings_are_compared_as_they_are_shown():
    """1.7 is shown as 1, and -0.2 as 0; 51 is a fifth."""
    ((_, photograph, rendered, is_counted),) = pairs(*setting([[[1.7, -0.2, 0.6]]], [[[51, 255, 0]]]), [0])
    assert_array_equal(rendered, [[[1.0, 0.0, 0.6]]])
    assert_allclose(photograph, [[[0.2, 1.0, 0.0]]], rtol=1e-6)
    assert is_counted.all()
