"""The rest of a training that has not decided its length: ranges by hand; times are the test's own."""

from types import SimpleNamespace

import numpy as np
import pytest

from minisplat_ref.app.runs.outlook import Outlook, Plan, foresee_decision, foresee_rest, make_plan
from minisplat_ref.methods import get_recipe
from minisplat_ref.training.pace import FINER, Cooling, Decision, Measurement, Pace
from minisplat_ref.training.recipe_settings import configure

COOLING = Cooling(part=0.5, last=0.1, last_per_extent=0.1, hold_out_every=8, prune_passes=2)
PLAN = Plan(COOLING, earliest=800, min_gain=0.3, latest=20_000, n_views=10)


def measured(gain, *steps):
    """A pace whose views gain this much with each doubling of the work, of 1,000 pairs an iteration."""
    measurements = [Measurement(s, (20 + gain * np.log2(s),) * 2, 10, 1000 * s) for s in steps]
    return Pace(tuple(measurements), n_pairs=1000 * steps[-1])


def test_the_next_decision_by_hand():
    assert foresee_decision(PLAN, Pace(), 100) == (800, None)
    assert foresee_decision(PLAN, Pace(), 1000) == (1000, None)
    assert foresee_decision(PLAN._replace(latest=700), Pace(), 100) == (700, None)


def test_a_gain_halves_with_each_doubling_of_the_work():
    """0.6 dB at iteration 1,400 are 0.3 at 2,800, the least that goes on; 1.2 dB are so at 5,600."""
    for gain, last in ((0.6, 2800), (1.2, 5600), (0.1, 1400)):
        assert foresee_decision(PLAN, measured(gain, 800, 1000, 1200, 1400), 1400) == pytest.approx((1400, last))
    # Before the first decision the gain rises steeply, and three measurements are too few.
    assert foresee_decision(PLAN, measured(9.0, 400, 500, 600, 700), 700) == (800, None)
    assert foresee_decision(PLAN, measured(9.0, 900, 1000, 1100), 1100) == (1100, None)
    assert foresee_decision(PLAN._replace(min_gain=0.0), measured(9.0, 800, 900, 1000, 1100), 1100) == (1100, None)


def test_few_views_do_not_decide():
    """Ten of at least sixteen: at iteration 800, or at once, whatever they gain."""
    plan = PLAN._replace(cooling=COOLING._replace(hold_out_from=16))
    assert foresee_decision(plan, Pace(), 100) == (800, 800)
    assert foresee_decision(plan, measured(9.0, 800, 1000, 1200, 1400), 1400) == (1400, 1400)
    assert foresee_rest(plan, Pace(), 400, 0, 0.1) == pytest.approx((82, 82))


def test_larger_views_are_decided_on_again():
    pace = Pace(decisions=(Decision(900, FINER, "", 0.1, 0.1),))
    assert foresee_decision(PLAN, pace, 950) == (1300, None)  # 400 iterations after the first decision


def test_the_rest_by_hand():
    """At 0.1 s an iteration: 400 of them, the cool-down of half as many as all, and two passes over ten views."""
    assert foresee_rest(PLAN, Pace(), 400, 0, 0.1) == (pytest.approx(40 + 42), None)
    # With halved views, 400 iterations more; all from then on take twice as long.
    assert foresee_rest(PLAN, Pace(), 400, 1, 0.1).least == pytest.approx(40 + 80 + 124)
    # Halved twice: four times in the end. 40 + 80 + 160 + (0.5 1600 + 20) 0.4.
    assert foresee_rest(PLAN, Pace(), 400, 2, 0.1).least == pytest.approx(280 + 328)


def test_the_longest_rest_by_hand():
    """With 0.6 dB at iteration 1,400 this size ends at 2,800; the next takes 600 more, three times as long each."""
    pace = measured(0.6, 800, 1000, 1200, 1400)
    assert foresee_rest(PLAN, pace, 1400, 0, 0.1) == pytest.approx((72, 140 + 142))
    assert foresee_rest(PLAN, pace, 1400, 1, 0.1) == pytest.approx((80 + 184, 140 + 180 + 516))
    assert foresee_rest(PLAN._replace(latest=3000), pace, 1400, 1, 0.1).most == pytest.approx(140 + 60 + 456)


def report(step, n_halvings=0, last_step=None):
    return SimpleNamespace(step=step, n_halvings=n_halvings, last_step=last_step)


def watch(outlook, first, last, seconds, **named):
    for step in range(first, last + 1):
        outlook.observe(report(step, **named), seconds * step)


def test_the_outlook_falls_and_ends_with_the_decision():
    state = SimpleNamespace(pace=Pace())
    outlook = Outlook(PLAN, state)
    outlook.observe(report(1), 60.0)  # of compilation
    assert outlook.describe(report(1)) == ""
    watch(outlook, 2, 400, 0.1)
    assert outlook.describe(report(400)) == "at least 01:22 to go"
    watch(outlook, 401, 900, 0.1)
    assert outlook.describe(report(900)) == "at least 00:47 to go"  # (450 + 20) / 10
    assert outlook.describe(report(900, last_step=1350)) == ""


def test_the_speed_of_smaller_views_is_forgotten():
    outlook = Outlook(PLAN, SimpleNamespace(pace=Pace(decisions=(Decision(1000, FINER, "", 0.1, 0.1),))))
    watch(outlook, 900, 1000, 0.01, n_halvings=1)
    watch(outlook, 1001, 1100, 0.125)
    assert outlook.describe(report(1100)) == "at least 02:07 to go"  # (300 + 720) / 8


def test_no_more_than_the_minutes_that_are_given():
    outlook = Outlook(PLAN, SimpleNamespace(pace=Pace()), limit=130.0)
    watch(outlook, 300, 400, 0.1)
    assert outlook.describe(report(400)) == "01:22 to 01:30 to go"
    watch(outlook, 401, 1400, 0.1)
    assert outlook.describe(report(1400)) == "about 00:00 to go"


def test_the_plan_is_that_of_the_recipe():
    recipe = get_recipe("adaptive")
    plan = make_plan(configure(recipe, min_step=500, min_gain=0.2), 30_000, 12)
    assert (plan.earliest, plan.min_gain, plan.n_views) == (500, 0.2, 12)
    assert plan.latest == recipe.cooling.latest_start(30_000) == 18_750
    assert make_plan(recipe, 800, 12).earliest == 500  # 800 / 1.6
    assert make_plan(get_recipe("3dgs-accel", 100), 100, 12) is None
