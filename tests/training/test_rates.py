"""Learning rates and spherical-harmonic degree."""

import pytest

from minisplat_ref.training.rates import LogLinear, Rates, Rewind, active_sh_degree


# Closed form: 1.6e-4 * 0.01^(i / 30000), to the digits of the published table of the 3DGS schedule.
@pytest.mark.parametrize(
    ("step", "rate"), [(0, 1.6e-4), (2_000, 1.177e-4), (15_000, 1.6e-5), (20_000, 7.43e-6), (30_000, 1.6e-6)]
)
def test_log_linear(step, rate):
    assert LogLinear(1.6e-4, 1.6e-6, 30_000).at(step) == pytest.approx(rate, rel=1e-3)


def test_log_linear_stays_at_its_end():
    assert LogLinear(1.0, 0.25, 10).at(5) == pytest.approx(0.5)
    assert LogLinear(1.0, 0.25, 10).at(11) == LogLinear(1.0, 0.25, 10).at(10) == pytest.approx(0.25)


# Closed form: lr(i) before 15,000, lr(i - 15,000 + 5000) from then on.
@pytest.mark.parametrize(("step", "rate"), [(14_999, 1.6e-5), (15_000, 7.43e-5), (30_000, 7.43e-6)])
def test_rewind(step, rate):
    assert LogLinear(1.6e-4, 1.6e-6, 30_000, Rewind(at=15_000, to=5_000)).at(step) == pytest.approx(rate, rel=1e-3)


def test_rates_per_extent_scale_with_the_scene():
    rates = Rates(
        {"means": LogLinear(1.0, 0.25, 10), "quats": 2.0, "velocities": 3.0}, frozenset({"means", "velocities"})
    )
    assert rates.at(5, 10.0) == pytest.approx({"means": 5.0, "quats": 2.0, "velocities": 30.0})
    joined = rates.join(Rates({"quats": 7.0, "exposures": 8.0}, frozenset({"exposures"})))
    assert joined.of["quats"] == 2.0 and joined.at(0, 10.0)["exposures"] == 80.0


def test_sh_degree_rises_at_each_milestone():
    milestones = (10, 20, 30)
    degrees = {step: active_sh_degree(step, milestones) for step in (1, 9, 10, 19, 20, 29, 30, 99)}
    assert degrees == {1: 0, 9: 0, 10: 1, 19: 1, 20: 2, 29: 2, 30: 3, 99: 3}
    assert active_sh_degree(99, ()) == 0
