"""Adam: first steps by hand, against a scalar loop, and which rows it touches."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.training.adam import AdamRule, adam_step, zero_moments
from tolerances import ADAM_FLOAT32, CLOSED_FORM


class Pair(NamedTuple):
    """Not Gaussians: Adam must not care."""

    a: np.ndarray  # [N]
    b: np.ndarray  # [N, 2, 3]


DENSE = AdamRule(is_visible_only=False, has_bias_correction=True)
SPARSE = AdamRule(is_visible_only=True, has_bias_correction=False)
RATES = {"a": 0.1, "b": 0.01}


def random_pair(rng, n, dtype=np.float64):
    return Pair(rng.normal(size=n).astype(dtype), rng.normal(size=(n, 2, 3)).astype(dtype))


def random_gradient(rng, n):
    """Values between 0.5 and 2 of either sign, so that eps is negligible beside them."""
    return Pair(*(np.sign(field) * rng.uniform(0.5, 2.0, field.shape) for field in random_pair(rng, n)))


def copy(pair):
    return Pair(*(field.copy() for field in pair))


def scalar_adam(value, gradients, rate, rule):
    """One number, straight from the paper."""
    m = v = 0.0
    for t, g in enumerate(gradients, start=1):
        m = rule.beta1 * m + (1 - rule.beta1) * g
        v = rule.beta2 * v + (1 - rule.beta2) * g**2
        m_hat = m / (1 - rule.beta1**t) if rule.has_bias_correction else m
        v_hat = v / (1 - rule.beta2**t) if rule.has_bias_correction else v
        value -= rate * m_hat / (math.sqrt(v_hat) + rule.eps)
    return value


# Closed form ----------------------------------------------------------------------------------------------------------


def test_first_step_is_the_rate_against_the_sign(rng):
    """t = 1: m_hat = g and v_hat = g^2, so the step is rate * sign(g), however small g is."""
    before, gradient = random_pair(rng, 5), random_gradient(rng, 5)
    gradient.a[:] *= 1e-6
    after = copy(before)
    adam_step(after, gradient, zero_moments(after), RATES, DENSE, np.arange(5))
    for p0, p1, g, rate in zip(before, after, gradient, RATES.values(), strict=True):
        assert_allclose(p1 - p0, -rate * np.sign(g), rtol=2 * DENSE.eps / 1e-6)


def test_first_step_without_correction_is_the_root_of_ten_larger(rng):
    """m = 0.1 g and v = 0.001 g^2: the step is 0.1 / sqrt(0.001) = sqrt(10) times the rate."""
    before, gradient = random_pair(rng, 5), random_gradient(rng, 5)
    after = copy(before)
    state = adam_step(after, gradient, zero_moments(after), RATES, SPARSE, np.arange(5))
    for p0, p1, g, rate in zip(before, after, gradient, RATES.values(), strict=True):
        assert_allclose(p1 - p0, -rate * math.sqrt(10) * np.sign(g), rtol=CLOSED_FORM * 10)
    assert_allclose(state.first.b, 0.1 * gradient.b)
    assert_allclose(state.second.b, 0.001 * gradient.b**2)
    assert state.step == 1


# Parity ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", [DENSE, SPARSE, SPARSE._replace(has_bias_correction=True)])
def test_many_steps_follow_the_scalar_loop(backend, rng, rule):
    n = 4
    before = random_pair(rng, n)
    gradients = [random_pair(rng, n) for _ in range(12)]
    after, state = copy(before), zero_moments(before)
    for gradient in gradients:
        state = adam_step(after, gradient, state, RATES, rule, np.arange(n), backend)
    for name, rate in RATES.items():
        values = getattr(before, name).ravel()
        series = np.array([getattr(gradient, name).ravel() for gradient in gradients])
        expected = [scalar_adam(value, series[:, i], rate, rule) for i, value in enumerate(values)]
        assert_allclose(getattr(after, name).ravel(), expected, rtol=0, atol=CLOSED_FORM * 10)


def test_float32_stays_float32(backend, rng):
    single, gradient = random_pair(rng, 300, np.float32), random_pair(rng, 300, np.float32)
    double, gradient64 = (Pair(*(field.astype(np.float64) for field in pair)) for pair in (single, gradient))
    state, state64 = zero_moments(single), zero_moments(double)
    for _ in range(3):
        state = adam_step(single, gradient, state, RATES, DENSE, np.arange(300), backend)
        state64 = adam_step(double, gradient64, state64, RATES, DENSE, np.arange(300), backend)
    assert all(field.dtype == np.float32 for field in (*single, *state.first, *state.second))
    for field, field64 in zip(single, double, strict=True):
        assert_allclose(field, field64, rtol=0, atol=ADAM_FLOAT32)


# Rows -----------------------------------------------------------------------------------------------------------------


def test_visible_only_leaves_the_other_rows_alone(backend, rng):
    """Rows that are not visible may hold any gradient; the visible ones move as if they were alone."""
    n, visible_ids = 9, np.array([0, 3, 4, 8])
    hidden = np.setdiff1d(np.arange(n), visible_ids)
    start, gradient = random_pair(rng, n), random_pair(rng, n)
    state = zero_moments(start)
    adam_step(start, gradient, state, RATES, SPARSE, np.arange(n), backend)  # moments that are not zero
    after = copy(start)
    moments_before = [field.copy() for moment in (state.first, state.second) for field in moment]
    alone = Pair(*(field[visible_ids] for field in start))
    alone_state = zero_moments(alone)._replace(
        first=Pair(*(field[visible_ids] for field in state.first)),
        second=Pair(*(field[visible_ids] for field in state.second)),
    )
    gradient.a[hidden] = np.nan
    adam_step(after, gradient, state, RATES, SPARSE, visible_ids, backend)
    adam_step(alone, Pair(*(f[visible_ids] for f in gradient)), alone_state, RATES, SPARSE, np.arange(4), backend)
    for p0, p1, p_alone in zip(start, after, alone, strict=True):
        assert_array_equal(p1[hidden], p0[hidden])
        assert_array_equal(p1[visible_ids], p_alone)
        assert np.all(p1[visible_ids] != p0[visible_ids])
    moments_after = [field for moment in (state.first, state.second) for field in moment]
    for old, new in zip(moments_before, moments_after, strict=True):
        assert_array_equal(new[hidden], old[hidden])


@pytest.mark.parametrize("rule", [DENSE, SPARSE])
def test_only_the_first_numbers_of_a_row_are_updated(backend, rng, rule):
    """As in a full update; the others may hold any gradient, and keep their values and moments."""
    n, ids = 40, np.arange(0, 40, 3)
    start, gradient = random_pair(rng, n), random_pair(rng, n)
    full, part = copy(start), copy(start)
    state, state_of_part = zero_moments(start), zero_moments(start)
    widths = rng.integers(0, 7, size=n)
    is_updated = (np.arange(6) < widths[:, None]).reshape(n, 2, 3)
    for _ in range(2):
        state = adam_step(full, gradient, state, RATES, rule, ids, backend)
        hidden = gradient._replace(b=np.where(is_updated, gradient.b, np.nan))
        state_of_part = adam_step(part, hidden, state_of_part, RATES, rule, ids, backend, widths={"b": widths})
    assert_array_equal(part.a, full.a)
    assert (full.b != start.b)[~is_updated].any()
    for own, expected, untouched in (
        (part.b, full.b, start.b),
        (state_of_part.first.b, state.first.b, 0),
        (state_of_part.second.b, state.second.b, 0),
    ):
        assert_array_equal(own, np.where(is_updated, expected, untouched))


def test_rows_one_by_one_are_all_rows(rng):
    """Runs of rows, eight numbers at a time, rows alone and the whole array at once: the same bytes."""
    n = 301
    start, gradient = random_pair(rng, n), random_pair(rng, n)
    whole, evens_then_odds = copy(start), copy(start)
    state, state2 = zero_moments(start), zero_moments(start)
    for _ in range(2):
        state = adam_step(whole, gradient, state, RATES, SPARSE._replace(is_visible_only=False), np.arange(0))
        adam_step(evens_then_odds, gradient, state2, RATES, SPARSE, np.arange(0, n, 2))
        adam_step(evens_then_odds, gradient, state2, RATES, SPARSE, np.arange(1, n, 2))
    for a, b in zip((*whole, *state.second), (*evens_then_odds, *state2.second), strict=True):
        assert_array_equal(a, b)


def test_dense_coasts_on_momentum(rng):
    """Dense Adam moves a row whose gradient is zero: what visible-only avoids."""
    p, g = random_pair(rng, 3), random_pair(rng, 3)
    state = adam_step(p, g, zero_moments(p), RATES, DENSE, np.arange(3))
    before = copy(p)
    adam_step(p, Pair(0 * g.a, 0 * g.b), state, RATES, DENSE, np.arange(0))
    assert np.all(p.a != before.a)


def test_zero_gradient_and_zero_rows(rng):
    p = random_pair(rng, 3)
    before = copy(p)
    state = adam_step(p, Pair(0 * p.a, 0 * p.b), zero_moments(p), RATES, DENSE, np.arange(3))
    assert_array_equal(p.b, before.b)  # 0 / (0 + eps)
    state = adam_step(p, p, state, RATES, SPARSE, np.arange(0))
    assert_array_equal(p.b, before.b)
    empty = random_pair(rng, 0)
    assert adam_step(empty, empty, zero_moments(empty), RATES, DENSE, np.arange(0)).step == 1


def test_a_field_that_joins_later_begins_with_the_bias_correction_of_its_own_first_step():
    """Its first step is the rate, in the direction of the gradient: m / (1 - beta1) = g and v / (1 - beta2) = g^2."""
    parameters = {"old": np.array([[1.0]]), "new": np.array([[5.0]])}
    gradient = {"old": np.array([[3.0]]), "new": np.array([[-7.0]])}
    state = zero_moments(parameters)._replace(step=400, joined={"new": 400})
    state.first["old"][:], state.second["old"][:] = 3.0, 9.0  # as after many steps of this gradient
    rates, rows = {"old": 0.1, "new": 0.2}, np.arange(1)
    state = adam_step(parameters, gradient, state, rates, DENSE, rows)
    assert_allclose(parameters["new"], 5.2)
    assert 0.9 < parameters["old"].item() < 0.95  # 400 steps are few for beta2: sqrt(1 - 0.999^401) = 0.57
    assert state.step == 401 and state.joined == {"new": 400}
