"""The prune of ``adaptive``: when slices are due, what goes in one, and what it may cost, by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.methods.adaptive import prune
from minisplat_ref.methods.adaptive.prune import (
    foresee_costs,
    is_prune_done,
    predict_unpruned,
    prune_in_slices,
    slice_due,
)
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.removal import RemovalCosts
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.pace import Measurement, Pace
from minisplat_ref.training.recipe_settings import settings_of
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Scene, view_from
from scenes import balls, make_camera

N = 200
SETTINGS = {"min_views": 2, "min_slope": 1.0, "max_pruned": 0.2, "max_psnr_cost": 0.1, "max_ssim_cost": 0.005}
UNPRUNED = 1001, 1033, 1065, 1097, 1129  # measured before the first slice: 650 * 0.64 / 13 = 32
FIRST, SECOND, THIRD, FOURTH = 1161, 1193, 1225, 1257  # iterations of slices


def test_its_numbers():
    settings = settings_of(ADAPTIVE)
    assert {name: settings[name] for name in SETTINGS} == SETTINGS


@pytest.fixture
def setting(monkeypatch):
    """A state of 200 Gaussians with x = 0 to 199 and a function that prunes it, at given measurements and costs."""
    model = balls(np.column_stack([np.arange(float(N)), np.zeros((N, 2))]), np.full(N, 0.1), np.full(N, 0.5))
    views = tuple(view_from(make_camera())._replace(name=str(i), view_id=i) for i in range(6))
    scene = Scene("hand", views, (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)
    pace = Pace(cooling_from=1000, last_step=1650, is_pruning=True)
    state = TrainState(
        model, zero_moments(model), step=1000, view_order=[1], rng=np.random.default_rng(0), stats={}, shared={},
        shared_adam=zero_moments({}), pace=pace,
    )  # fmt: skip
    settings = RenderSettings()
    here = Iteration(scene, views[0], None, np.zeros(0, int), None, settings, cooling=ADAPTIVE.cooling)

    def run(step=SECOND, changes=(), psnr=20.0, ssim=0.5, is_visible=None, weights=None, **changed):
        """Prune at a step: ``changes`` are those of the first Gaussians, all others change 5; E is 200."""
        n = len(state.gaussians.means)
        costs = np.concatenate([changes, np.full(n - len(changes), 5.0)])
        seen = np.ones((n, 6), bool) if is_visible is None else is_visible
        stats = SimpleNamespace(blend_weight_sum=np.ones(n) if weights is None else weights, is_visible=seen)
        measurement = Measurement(step, (psnr, psnr), n, 0, (ssim, ssim))
        monkeypatch.setattr(prune, "collect_removal_costs", lambda *_: RemovalCosts(costs, 200.0))
        monkeypatch.setattr(prune, "measure_importance", lambda *_: stats)
        monkeypatch.setattr(prune, "evaluate_measured", lambda *_, **__: measurement)
        prune_in_slices(state, here._replace(step=step), **SETTINGS | changed)
        return [int(x) for x in state.gaussians.means[:, 0]]

    return state, run


# When -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("length", "every"), [(650, 32), (670, 32), (671, 33), (406, 20), (426, 20), (427, 21)])
def test_the_gap_is_rounded_down_and_twenty_at_least(length, every):
    """0.64 of 650, 670, 671, 406, 426 and 427 in thirteen are 32, 32.98, 33.03, 19.99, 20.97 and 21.02."""
    pace = Pace(cooling_from=1000, last_step=1000 + length)
    assert [step for step in range(1001, 1000 + length) if slice_due(pace, step) is not None][1] == 1001 + every


@pytest.mark.parametrize(("length", "n"), [(250, 4), (249, 3), (125, 0), (650, 8)])
def test_a_slice_may_come_at_the_end_of_its_part_and_not_after_it(length, n):
    """Moments come 0, 20, 40, ... iterations after the first, five unpruned; 0.64 of 250 is 160, of 249 it is 159.4."""
    pace = Pace(cooling_from=1000, last_step=1000 + length)
    due = [slice_due(pace, step) for step in range(1001, 1650)]
    assert [number for number in due if number is not None and number >= 0] == list(range(n))
    assert [number for number in due if number is not None and number < 0] == [-5, -4, -3, -2, -1]


@pytest.mark.parametrize("length", [124, 125])
def test_the_prune_is_done_where_nothing_may_come(length):
    """0.64 of 125 is 80, of 124 it is 79.4."""
    pace = Pace(cooling_from=1000, last_step=1000 + length)
    assert [is_prune_done(pace, 1001 + since) for since in (79, 80, 81)] == [False, length == 124, True]
    assert not is_prune_done(Pace(), 1081)


# What -----------------------------------------------------------------------------------------------------------------


def test_a_slope_of_one_stays(setting):
    """The slope is 200 S / 200: three below 1 go, at 1 one stays. 10 lg (1 + 2.25 / 200) is 0.049 dB."""
    state, run = setting
    assert run(changes=[1.0, 0.99, 0.5, 0.76]) == [0, *range(4, N)]
    (decision,) = state.pace.decisions
    assert (decision.step, decision.what) == (SECOND, "prune")
    assert decision.why == "without 3 of 200 Gaussians the training views lose only 0.05 dB"


def test_what_is_lost_is_told_in_decibels(setting):
    """Forty times 0.25 are a twentieth of 200: 10 lg 1.05 is 0.21 dB. A fifth goes at most: not the last two."""
    state, run = setting
    assert run(changes=[0.25] * 42) == list(range(40, N))
    assert state.pace.decisions[0].why == "without 40 of 200 Gaussians the training views lose only 0.21 dB"


@pytest.mark.parametrize("n", [1, 2])
def test_a_slice_of_less_than_a_hundredth_is_left_out(setting, n):
    """Of 200, one is less, two are not."""
    state, run = setting
    assert len(run(changes=[0.5] * n)) == (N if n == 1 else N - 2)
    assert len(state.pace.decisions) == n - 1 and state.pace.is_pruning


def test_what_fewer_than_two_views_see_goes_before_the_first_slice_alone(setting):
    """No, one and two views see the first three, six the fourth, which has no weight at all."""
    state, run = setting
    is_visible, weights = np.ones((N, 6), bool), np.ones(N)
    is_visible[0], is_visible[1, 1:], is_visible[2, 2:] = False, False, False
    weights[3] = 0
    assert run(SECOND, is_visible=is_visible, weights=weights) == list(range(N))
    assert run(FIRST, is_visible=is_visible, weights=weights) == [2, *range(4, N)]
    (decision,) = state.pace.decisions
    assert (decision.step, decision.what) == (FIRST, "prune")
    assert decision.why == "3 of 200 Gaussians are visible in fewer than 2 views"


@pytest.mark.parametrize("step", [1000, 1002, 1192, 1194, 1417])
def test_between_slices_nothing_goes(setting, step):
    state, run = setting
    assert len(run(step, changes=[0.5] * 10)) == N
    assert state.pace.while_cooling == () and state.pace.is_pruning


def test_before_the_first_slice_held_out_views_are_measured_and_nothing_goes(setting):
    state, run = setting
    for step in UNPRUNED:
        assert len(run(step, changes=[0.5] * 10)) == N
    assert [m.step for m in state.pace.while_cooling] == list(UNPRUNED) and state.pace.is_pruning
    assert len(run(FIRST, changes=[0.5] * 10)) == 190


def test_nothing_goes_where_no_prune_is_on(setting):
    state, run = setting
    state.pace = state.pace._replace(is_pruning=False)
    assert len(run(changes=[0.5] * 10)) == N


# What it may cost -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("psnr", "ssim", "limits", "goes_on"),
    [
        (19.5, 0.5, (1.01, 0.01), True),
        (19.5, 0.5, (0.99, 9.0), False),
        (21.0, 0.5, (0.01, 0.01), True),
        (20.0, 0.25, (0.01, 0.51), True),
        (20.0, 0.25, (9.0, 0.49), False),
    ],
)
def test_a_slice_is_made_if_it_may_cost_just_what_is_allowed(setting, psnr, ssim, limits, goes_on):
    """From 20 dB to 19.5 it cost 0.5, and the next is assumed to cost as much; from 0.5 to 0.25 of SSIM, 0.5 in all."""
    state, run = setting
    limited = {"max_psnr_cost": limits[0], "max_ssim_cost": limits[1]}
    for step in UNPRUNED:
        run(step)
    assert len(run(FIRST, changes=[0.5] * 10, **limited)) == 190
    assert len(run(SECOND, changes=[0.5] * 10, psnr=psnr, ssim=ssim, **limited)) == (180 if goes_on else 190)
    assert state.pace.is_pruning == goes_on and len(state.pace.while_cooling) == 7
    assert (state.view_order == []) != goes_on
    assert [d.what for d in state.pace.decisions] == ["prune", "prune" if goes_on else "prune ended"]


def test_a_slice_that_is_left_out_is_measured_too(setting):
    """From 20.5 dB to 20.3 it cost 0.2, and so may the next, 0.4 in all; at 20.3 again, 0.2 in all."""
    state, run = setting
    for step in (*UNPRUNED, FIRST, SECOND):
        run(step, psnr=20.5)
    run(THIRD, psnr=20.3, max_psnr_cost=0.41)
    assert state.pace.is_pruning
    run(FOURTH, psnr=20.3, max_psnr_cost=0.19)
    assert not state.pace.is_pruning and "0.20 ± 0.00 dB and 0.0000 ± 0.0000 of SSIM" in state.pace.decisions[-1].why


RATES = [1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.05]  # at five measurements before the prune, the first slice and the second


def of_errors(errors, dissimilarities):
    """Measurements of two views that agree."""
    psnrs = -10 * np.log10(errors)
    return [
        Measurement(k, (p, p), 10, 0, (1 - d, 1 - d))
        for k, (p, d) in enumerate(zip(psnrs, dissimilarities, strict=True))
    ]


def test_falling_rates_do_not_hide_what_a_slice_costs():
    """The error is 0.01 + 0.1 r; after the first slice, 0.1 dB more. The PSNR rises by 1.15 dB, and 0.2 will be lost.

    1 - SSIM is 0.2 + 0.1 r, and then 0.002 more, of which 0.004 come.
    """
    errors, dissimilarities = 0.01 + 0.1 * np.array(RATES), 0.2 + 0.1 * np.array(RATES)
    assert_allclose(foresee_costs(of_errors(errors, dissimilarities), RATES), np.zeros((2, 2)), atol=1e-9)
    errors[6] *= 10**0.01
    dissimilarities[6] += 0.002
    measured = of_errors(errors, dissimilarities)
    assert measured[6].psnr - measured[5].psnr == pytest.approx(1.15, abs=0.01)
    assert_allclose(foresee_costs(measured, RATES), [(0.2, 0), (0.004, 0)], atol=1e-9)
    assert foresee_costs(measured[:6], RATES[:6]) == ((0, 0), (0, 0))


def test_held_out_views_may_lose_by_falling_rates():
    """What is trained on is learned by heart: the error is 0.02 - 0.01 r, with or without a prune."""
    errors = 0.02 - 0.01 * np.array(RATES)
    assert_allclose(foresee_costs(of_errors(errors, np.full(7, 0.3)), RATES), np.zeros((2, 2)), atol=1e-9)


def test_no_error_below_zero_is_predicted():
    """The line of r - 0.05 would reach 0; the best one through the origin has the slope 2.055 / 2.21.

    The sixth measurement counts, directly before the first slice, and the seventh does not, after it.
    """
    errors = np.array([*RATES[:6], 7.0]) - 0.05
    predicted = predict_unpruned(errors[:, None], RATES)
    assert_allclose(predicted[:, 0], np.array(RATES) * 2.055 / 2.21, rtol=1e-6)


def test_a_line_that_begins_below_zero():
    """Nearly all of the error comes at the sixth moment. What the line has at the first is of no account."""
    errors = np.array([1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 0.05, 0.05])
    line = np.polyval(np.polyfit(RATES[:6], errors[:6], 1), RATES)
    assert line[0] < 0 < line[5]
    (cost, error), _ = foresee_costs(of_errors(errors, np.full(7, 0.3)), RATES)
    assert_allclose((cost, error), (10 * np.log10(0.05 / line[6]), 0), rtol=1e-6)
    assert cost < 10 * np.log10(0.05 / line[5])


def test_views_that_disagree_make_the_cost_uncertain():
    """One view loses 0.2 dB, the other gains 0.1; with as much to come 0.4 and -0.2: 0.1 dB, and 0.3 is its error.

    The deviations from the mean are 0.3 each: the root of 2 x 0.3^2 / (2 - 1) / 2.
    """
    psnrs = [(20.0, 22.0)] * 6 + [(19.8, 22.1)]
    cost, _ = foresee_costs([Measurement(k, pair, 10, 0, (0.5, 0.5)) for k, pair in enumerate(psnrs)], RATES)
    assert_allclose(cost, (0.1, 0.3), atol=1e-9)
