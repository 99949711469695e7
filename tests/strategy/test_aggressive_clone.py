"""Aggressive clone of Mini-Splatting2: who is critical, and that copies together look like what they replace."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad

from minisplat_ref.errors import InputError
from minisplat_ref.rendering import render
from minisplat_ref.strategy.aggressive_clone import (
    SHARED_OPACITY_MIN,
    clone,
    critical_by_mass,
    critical_by_weight,
    shared_opacities,
    shared_scale_factors,
)
from minisplat_ref.strategy.clone_split import logit
from minisplat_ref.strategy.importance import ImportanceStats
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import ALPHA_INTEGRAL, CLOSED_FORM, PRINTED_DIGITS, ROUNDED_TO_FLOAT32

OPACITIES = np.array([0.005, 0.1, 0.5, 0.9, 0.99, 1 - 1e-9])


def opacities_of(gaussians):
    return 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))


def make_stats(weight_sum, dominant_count, weight_max):
    n = len(weight_sum)
    return ImportanceStats(
        blend_weight_sum=np.array(weight_sum, float),
        mean_weight_sum=np.zeros(n),
        blend_weight_max=np.array(weight_max, float),
        dominant_count=np.array(dominant_count, np.int64),
        frustum_count=np.ones(n, np.int32),
        is_visible=np.ones((n, 1), bool),
    )


# Closed form ----------------------------------------------------------------------------------------------------------


def test_two_copies_by_hand():
    """1 - sqrt(1 - o), and o / (2 o' - o'^2 / sqrt(2)), as printed with four and three digits."""
    opacities = np.array([0.1, 0.5, 0.9, 0.99, 1.0])
    assert_allclose(shared_opacities(opacities, 2), [0.0513, 0.2929, 0.6838, 0.9, 1], atol=PRINTED_DIGITS)
    assert_allclose(shared_scale_factors(opacities, 2), [0.992, 0.952, 0.868, 0.807, 0.7735], atol=10 * PRINTED_DIGITS)


@pytest.mark.parametrize("factor", [1, 2, 3, 5, 8])
def test_copies_composite_to_the_old_opacity(factor):
    assert_allclose(1 - (1 - shared_opacities(OPACITIES, factor)) ** factor, OPACITIES, rtol=CLOSED_FORM)


@pytest.mark.parametrize("factor", [1, 2, 3, 5, 8])
def test_copies_keep_the_integral_of_alpha(factor):
    """Along a line through the centre, old scale 1: sqrt(2 pi) o."""
    for opacity in [*OPACITIES, 1.0]:
        one = shared_opacities(np.array(opacity), factor)
        scale = shared_scale_factors(np.array([opacity]), factor)[0]
        # quad takes the half line to 12 widths; the profile is even.
        half, _ = quad(alpha_of_copies, 0, 12 * scale, args=(one, scale, factor), epsabs=0, epsrel=1e-12)
        assert 2 * half == pytest.approx(np.sqrt(2 * np.pi) * opacity, rel=ALPHA_INTEGRAL)


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_same_as_the_double_sum_of_3dgs_mcmc(factor):
    """sum_i sum_(k <= i) C(i, k) (-1)^k o'^(k+1) / sqrt(k+1): what copy i adds, i from 0."""
    one = 1 - (1 - OPACITIES) ** (1 / factor)
    terms = [
        math.comb(i - 1, k) * (-1) ** k * one ** (k + 1) / np.sqrt(k + 1)
        for i in range(1, factor + 1)
        for k in range(i)
    ]
    assert_allclose(shared_scale_factors(OPACITIES, factor), OPACITIES / np.sum(terms, axis=0), rtol=ALPHA_INTEGRAL)


def alpha_of_copies(x, opacity, scale, factor):
    return -np.expm1(factor * np.log1p(-opacity * np.exp(-(x**2) / (2 * scale**2))))


def test_one_copy_is_the_identity(rng):
    gaussians = make_gaussians(rng, 5)._replace(opacity_logits=np.array([-9.0, -2.0, 0.5, 8.0, 40.0]))
    edit = clone(gaussians, np.ones(5, bool), factor=1)
    for field, old in zip(edit.gaussians, gaussians, strict=True):
        assert_allclose(field, old, rtol=CLOSED_FORM)
    assert_array_equal(edit.parent_ids, np.arange(5))
    assert not edit.is_new.any()


def test_parents_are_edited_in_place_and_children_follow(rng):
    gaussians = make_gaussians(rng, 4)
    edit = clone(gaussians, np.array([False, True, False, True]), factor=3)
    assert_array_equal(edit.parent_ids, [0, 1, 2, 3, 1, 3, 1, 3])
    assert_array_equal(edit.is_new, [False] * 4 + [True] * 4)
    for field, old in zip(edit.gaussians, gaussians, strict=True):
        assert_array_equal(field[[0, 2]], old[[0, 2]])
        assert_array_equal(field[4:], field[[1, 3, 1, 3]])
    for name in ("means", "quats", "sh_dc", "sh_rest"):
        assert_array_equal(getattr(edit.gaussians, name), getattr(gaussians, name)[edit.parent_ids])
    critical = opacities_of(gaussians)[[1, 3]]
    assert_allclose(opacities_of(edit.gaussians)[[1, 3]], shared_opacities(critical, 3), rtol=CLOSED_FORM)
    ratios = np.exp(edit.gaussians.log_scales - gaussians.log_scales[edit.parent_ids])[[1, 3]]
    assert_allclose(ratios, np.repeat(shared_scale_factors(critical, 3)[:, None], 3, axis=1), rtol=CLOSED_FORM)


def test_the_old_population_is_not_written(rng):
    gaussians = make_gaussians(rng, 3)
    before = [field.copy() for field in gaussians]
    clone(gaussians, np.ones(3, bool))
    for field, old in zip(gaussians, before, strict=True):
        assert_array_equal(field, old)


def test_the_image_stays(rng):
    """One Gaussian, rendered: two shared copies change the alpha a fifth as much as two plain ones, or less."""
    gaussians, camera = make_gaussians(rng, 1, opacity_logit=1.0), make_camera(64, 48, fx=90.0, fy=90.0)
    gaussians = gaussians._replace(means=np.array([[0.0, 0.0, 3.0]]))
    alphas = [
        render(population, camera)[0].alpha
        for population in (
            gaussians,
            clone(gaussians, np.array([True])).gaussians,
            gaussians._make(np.repeat(field, 2, axis=0) for field in gaussians),
        )
    ]
    shared, plain = (np.abs(alpha - alphas[0]).sum() for alpha in alphas[1:])
    assert shared < plain / 5


def test_critical_by_mass():
    """0.85 of the weight 100 of those that dominate takes 50 + 30 + 10, rows 0, 2, 3; row 1 never dominates."""
    stats = make_stats([50, 500, 30, 10, 6, 4], [5, 0, 1, 2, 1, 1], np.ones(6))
    assert_array_equal(critical_by_mass(stats, 0.85), [True, False, True, True, False, False])


def test_critical_by_weight():
    stats = make_stats(np.ones(101), np.ones(101), np.linspace(0, 1, 101))
    assert_array_equal(np.flatnonzero(critical_by_weight(stats, 0.97)), [97, 98, 99, 100])
    assert_array_equal(np.flatnonzero(critical_by_weight(stats)), [99, 100])


def test_the_two_readings_differ(rng):
    """Log-normal importance: 0.99 of the mass is over half of the Gaussians, the 0.99 quantile one in a hundred."""
    weights = np.exp(1.5 * rng.normal(size=2_000))
    stats = make_stats(weights, np.ones(2_000), weights / weights.max())
    assert critical_by_mass(stats).mean() > 0.5
    assert critical_by_weight(stats).mean() == pytest.approx(0.01)


# Hard cases -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_opaque_and_faint_stay_finite(rng, dtype):
    """Logits at which float64 has o = 1, and ones at which it is below every bound."""
    logits = np.array([-800.0, -80.0, -10.0, 0.0, 20.0, 80.0, 800.0])
    gaussians = as_dtype(make_gaussians(rng, 7)._replace(opacity_logits=logits), dtype)
    for factor in (2, 5):
        edit = clone(gaussians, np.ones(7, bool), factor=factor)
        assert all(np.isfinite(field).all() for field in edit.gaussians)
        assert np.all(edit.gaussians.opacity_logits[:7] <= gaussians.opacity_logits)
        assert np.all(edit.gaussians.log_scales[:7] <= gaussians.log_scales)


def test_opaque_copies_are_distinct_from_opacity_one():
    """1 - o' = (1 - o)^(1/2), down to transparencies that 1 - o cannot hold: logit 80 becomes logit 40."""
    gaussians = make_gaussians(np.random.default_rng(0), 1)._replace(opacity_logits=np.array([80.0]))
    assert clone(gaussians, np.array([True])).gaussians.opacity_logits[0] == pytest.approx(40.0, rel=CLOSED_FORM)


def test_faint_copies_are_not_pruned():
    """0.008 would become two of 0.004; 0.004 stays what it is."""
    opacities = np.array([0.02, 0.008, 0.004])
    gaussians = make_gaussians(np.random.default_rng(0), 3)
    gaussians = gaussians._replace(opacity_logits=np.array([logit(o) for o in opacities]))
    copies = opacities_of(clone(gaussians, np.ones(3, bool)).gaussians)[3:]
    assert_allclose(copies, [1 - np.sqrt(0.98), SHARED_OPACITY_MIN, 0.004], rtol=CLOSED_FORM)


def test_many_copies_of_an_opaque_gaussian():
    """20 copies: the sum of alternating terms still has the digits that float32 holds."""
    scale = shared_scale_factors(np.array([1 - 1e-9]), 20)[0]
    half, _ = quad(alpha_of_copies, 0, 12 * scale, args=(shared_opacities(1 - 1e-9, 20), scale, 20), epsrel=1e-12)
    assert 2 * half == pytest.approx(np.sqrt(2 * np.pi), rel=ROUNDED_TO_FLOAT32)


def test_float32_stays_float32(rng):
    gaussians = make_gaussians(rng, 6)
    mask = np.arange(6) % 2 == 0
    exact, edit = clone(gaussians, mask), clone(as_dtype(gaussians, np.float32), mask)
    for field, expected in zip(edit.gaussians, exact.gaussians, strict=True):
        assert field.dtype == np.float32
        assert_allclose(field, expected, atol=ROUNDED_TO_FLOAT32)
    assert shared_scale_factors(np.array([0.5], np.float32), 2).dtype == np.float32
    assert shared_opacities(np.array([0.5], np.float32), 2).dtype == np.float32


def test_nobody(rng):
    edit = clone(make_gaussians(rng, 0), np.zeros(0, bool))
    assert len(edit.gaussians.means) == len(edit.parent_ids) == 0
    edit = clone(make_gaussians(rng, 3), np.zeros(3, bool))
    assert_array_equal(edit.parent_ids, np.arange(3))
    nobody = make_stats([], [], [])
    assert len(critical_by_weight(nobody)) == len(critical_by_mass(nobody)) == 0


def test_nobody_is_critical_where_nothing_is_seen():
    stats = make_stats(np.zeros(4), np.zeros(4), np.zeros(4))
    assert not critical_by_weight(stats).any()
    assert not critical_by_mass(stats).any()


def test_equal_weights_are_critical_together():
    """Alpha is capped, so many share the largest weight; none of them is preferred."""
    stats = make_stats(np.ones(10), np.ones(10), [0.99] * 6 + [0.5] * 4)
    assert_array_equal(critical_by_weight(stats), np.arange(10) < 6)


def test_factor_below_one(rng):
    with pytest.raises(InputError, match="clone factor is 0"):
        clone(make_gaussians(rng, 1), np.ones(1, bool), factor=0)
