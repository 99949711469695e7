"""Simplification: the law of sampling against enumeration, and merges against the moments of what was merged."""

from itertools import combinations, permutations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.strategy.initialization import gaussians_from_points
from minisplat_ref.strategy.ops import take
from minisplat_ref.strategy.simplify import (
    by_merging,
    by_rank,
    by_sampling,
    intersection_preserving,
    merge_clusters,
    merge_neighbours,
    most_important,
    optical_masses,
    reinitialise,
    sample,
    select_mass,
)
from scenes import as_dtype, make_gaussians
from tolerances import CLOSED_FORM, MERGED_MOMENTS, ROUNDED_TO_FLOAT32, SAMPLE_FREQUENCY

IMPORTANCE = np.array([0.5, 0.0, 3.0, 1.0, 2.0])


def moments(gaussians, weights):
    """Mean and covariance of the mixture, by the definition."""
    shares = weights / weights.sum()
    mean = shares @ gaussians.means
    offsets = gaussians.means - mean
    own = covariances(gaussians.quats, np.exp(gaussians.log_scales))
    return mean, np.einsum("m,mij->ij", shares, own) + np.einsum("m,mi,mj->ij", shares, offsets, offsets)


def opacities_of(gaussians):
    return 1 / (1 + np.exp(-gaussians.opacity_logits))


def balls(means, *, sizes, opacities):
    """Round Gaussians without view-dependent colour."""
    n = len(means)
    opacities = np.broadcast_to(opacities, n).astype(float)
    return make_gaussians(np.random.default_rng(1), n, sh_degree=0)._replace(
        means=np.array(means, float),
        log_scales=np.log(np.broadcast_to(sizes, (3, n)).T.astype(float)),
        opacity_logits=np.log(opacities / (1 - opacities)),
    )


# Choosing rows --------------------------------------------------------------------------------------------------------


def test_who_never_dominates_does_not_matter():
    assert_array_equal(intersection_preserving(IMPORTANCE, np.array([1, 5, 0, 2, 0])), [0.5, 0, 0, 1, 0])


def test_most_important_by_hand():
    assert_array_equal(most_important(IMPORTANCE, 2), [2, 4])
    assert_array_equal(most_important(np.array([1.0, 2, 1, 1]), 3), [0, 1, 2])


def test_carrying_mass_by_hand():
    assert_array_equal(select_mass(IMPORTANCE, 0.9), [2, 3, 4])
    assert_array_equal(select_mass(IMPORTANCE, 1.0), [0, 2, 3, 4])


@pytest.mark.parametrize("n", [1, 2, 3])
def test_sampling_has_the_law_of_one_draw_after_the_other(n, rng):
    n_draws = 10_000
    counts = dict.fromkeys(combinations((0, 2, 3, 4), n), 0)
    for _ in range(n_draws):
        counts[tuple(sample(IMPORTANCE, n, rng))] += 1
    for ids, count in counts.items():
        probability = 0.0
        for order in permutations(ids):
            left, chance = IMPORTANCE.sum(), 1.0
            for i in order:
                chance *= IMPORTANCE[i] / left
                left -= IMPORTANCE[i]
            probability += chance
        assert abs(count / n_draws - probability) < SAMPLE_FREQUENCY * np.sqrt(probability * (1 - probability))


def test_everybody_is_drawn_when_all_are_asked_for(rng):
    assert_array_equal(sample(IMPORTANCE, 4, rng), [0, 2, 3, 4])
    tiny = np.array([1e-300, 0, 1e300])
    assert_array_equal(sample(tiny, 2, rng), [0, 2])
    assert_array_equal(sample(tiny, 1, rng), [2])


def test_same_generator_same_sample():
    first, second = (sample(np.arange(100.0), 30, np.random.default_rng(7)) for _ in range(2))
    assert_array_equal(first, second)


@pytest.mark.parametrize("choose", [by_sampling, by_rank, by_merging])
def test_choices_leave_n_in_order(choose, rng):
    gaussians = make_gaussians(rng, 60)
    importance = rng.uniform(size=60) * (np.arange(60) % 3 > 0)
    edit = choose(gaussians, importance, 25, rng)
    assert len(edit.parent_ids) == 25 and np.all(importance[edit.parent_ids] > 0)
    assert len(np.unique(edit.parent_ids)) == 25
    for field, old in zip(edit.gaussians, gaussians, strict=True):
        assert field.dtype == old.dtype
        assert_array_equal(field[~edit.is_new], old[edit.parent_ids[~edit.is_new]])


# Merging --------------------------------------------------------------------------------------------------------------


def test_two_merge_by_hand():
    """At x = 0 and 4 with weights 1 and 3: mean 3, variance 0.04 + 3/16 * 16 along the line between them."""
    gaussians = balls([[0, 0, 0], [4, 0, 0], [90, 0, 0]], sizes=0.2, opacities=[0.3, 0.6, 0.9])
    edit = merge_neighbours(gaussians, np.array([1.0, 3, 1]), 2)
    merged = take(edit.gaussians, edit.is_new)
    assert_array_equal(edit.parent_ids, [1, 2])
    assert_array_equal(edit.is_new, [True, False])
    assert_allclose(merged.means, [[3, 0, 0]], atol=CLOSED_FORM)
    covariance = covariances(merged.quats, np.exp(merged.log_scales))[0]
    assert_allclose(covariance, np.diag([3.04, 0.04, 0.04]), atol=1e2 * CLOSED_FORM)
    assert_allclose(merged.sh_dc[0], 0.25 * gaussians.sh_dc[0] + 0.75 * gaussians.sh_dc[1], rtol=CLOSED_FORM)
    growth = np.sqrt((2 * 3.04 * 0.04 + 0.04**2) / (3 * 0.04**2))  # of the cross-section
    assert_allclose(opacities_of(merged), 1 - (0.7 * 0.4) ** (1 / growth), rtol=1e2 * CLOSED_FORM)


def test_two_in_one_place_stop_as_much_as_both_did():
    gaussians = balls([[1, 2, 3]] * 2, sizes=0.1, opacities=[0.5, 0.2])
    merged = merge_neighbours(gaussians, np.array([1.0, 1]), 1).gaussians
    assert_allclose(opacities_of(merged), 1 - 0.5 * 0.8, rtol=1e2 * CLOSED_FORM)
    assert_allclose(np.exp(merged.log_scales), 0.1, rtol=1e2 * CLOSED_FORM)


def test_discs_side_by_side_keep_about_their_opacity():
    """Centres 3.46 deviations apart (as wide as a strip of the same variance): one of twice the length."""
    gaussians = balls([[0, 0, 0], [2 * np.sqrt(3), 0, 0]], sizes=np.array([[1], [1], [1e-3]]), opacities=0.7)
    gaussians = gaussians._replace(quats=np.array([[1.0, 0, 0, 0]] * 2))
    merged = merge_neighbours(gaussians, np.ones(2), 1).gaussians
    assert_allclose(np.exp(np.sort(merged.log_scales[0])), [1e-3, 1, 2], rtol=ROUNDED_TO_FLOAT32)
    assert_allclose(opacities_of(merged), 0.7, atol=ROUNDED_TO_FLOAT32)


def test_given_clusters_keep_their_moments_and_stop_as_much_light(rng):
    gaussians = make_gaussians(rng, 30, opacity_logit=-3.0)  # so faint that no merged one is clamped
    labels = np.append(rng.permutation(np.repeat(np.arange(5), 5)), np.arange(5, 10))
    masses = optical_masses(gaussians)
    edit = merge_clusters(gaussians, masses, labels)
    assert_array_equal(edit.is_new, np.arange(10) < 5)
    assert_allclose(optical_masses(edit.gaussians)[:5], np.bincount(labels, masses)[:5], rtol=MERGED_MOMENTS)
    for label in range(10):
        members, row = labels == label, np.arange(10) == label
        expected = moments(take(gaussians, members), masses[members])
        for found, value in zip(moments(take(edit.gaussians, row), np.ones(1)), expected, strict=True):
            assert_allclose(found, value, atol=MERGED_MOMENTS)


def test_clusters_of_one_stay_as_they_are(rng):
    gaussians = make_gaussians(rng, 4)
    edit = merge_clusters(gaussians, np.ones(4), np.array([2, 0, 3, 1]))
    assert not edit.is_new.any()
    assert_array_equal(edit.parent_ids, [1, 3, 0, 2])
    assert_array_equal(edit.gaussians.means, gaussians.means[[1, 3, 0, 2]])


def test_opaque_stacks_stay_trainable():
    merged = merge_neighbours(balls([[0, 0, 5]] * 6, sizes=0.1, opacities=0.98), np.ones(6), 1).gaussians
    assert_allclose(opacities_of(merged), 0.99, rtol=CLOSED_FORM)


@pytest.mark.parametrize("n", [1, 7, 60])
def test_merging_keeps_mass_mean_and_covariance(n, rng):
    """Every row that is left has the moments of its share, so the mixture of them all has the old ones."""
    gaussians, importance = make_gaussians(rng, 150), rng.uniform(0.1, 2, 150)
    importance[::5] = 0
    one_hot = gaussians._replace(sh_rest=np.repeat(np.eye(150)[:, :, None], 3, axis=2))  # tells who is in a row
    edit = merge_neighbours(one_hot, importance, n)
    shares = edit.gaussians.sh_rest[:, :, 0]  # [n, 150]
    is_member = shares > 0
    assert_array_equal(is_member.sum(axis=0), importance > 0)  # each in one row
    mass = is_member @ importance
    assert_allclose(shares, is_member * importance / mass[:, None], atol=MERGED_MOMENTS)
    is_in = importance > 0
    for actual, expected in zip(
        moments(edit.gaussians, mass), moments(take(gaussians, is_in), importance[is_in]), strict=True
    ):
        assert_allclose(actual, expected, atol=MERGED_MOMENTS)
    assert_array_equal(edit.is_new, is_member.sum(axis=1) > 1)
    assert_array_equal(edit.parent_ids, np.where(is_member, importance, 0).argmax(axis=1))
    assert np.all(np.diff(is_member.argmax(axis=1)) > 0)  # in the order of the first members


def on_a_line(x):
    return balls(np.column_stack([x, np.zeros((len(x), 2))]), sizes=0.1, opacities=0.5)._replace(
        sh_dc=np.zeros((len(x), 3))
    )


def test_nearest_merge_first():
    """Gaps of 1, 2 and 1.5 between wide ones: they close in the order of their widths."""
    gaussians = on_a_line(np.cumsum([0, 5, 1, 5, 2, 5, 1.5, 5]))
    assert_array_equal(np.flatnonzero(merge_neighbours(gaussians, np.ones(8), 7).is_new), [1])
    assert_array_equal(np.flatnonzero(merge_neighbours(gaussians, np.ones(8), 6).is_new), [1, 4])
    assert_array_equal(np.flatnonzero(merge_neighbours(gaussians, np.ones(8), 5).is_new), [1, 2, 3])


def test_only_the_cheaper_half_of_the_pairs_merges_in_a_round():
    """Gaps of 1 and 2 cost 1 / 2 and 4 / 2; only the first closes, and then its middle is 1.7 from a third one.

    That costs 1.7^2 * 2 / 3 = 1.93, less than the gap of 2, which stays open.
    """
    gaussians = on_a_line(np.array([0.0, 1, 2.2, 10, 12]))
    assert_array_equal(merge_neighbours(gaussians, np.ones(5), 3).is_new, [True, False, False])


def test_the_half_of_three_pairs_is_two():
    """Gaps of 1, 1.8 and 3 cost 0.5, 1.62 and 4.5; a third one 1.55 from the middle of the first would cost 1.60."""
    gaussians = on_a_line(np.array([0.0, 1, 2.05, 20, 21.8, 40, 43]))
    assert_array_equal(merge_neighbours(gaussians, np.ones(7), 5).is_new, [True, False, True, False, False])


def test_unimportant_ones_merge_first():
    """Ward: 1 * 1 / 2 for the gap of 1, against 4 * 0.1 / 1.1 for that of 2."""
    gaussians = on_a_line(np.array([0.0, 1, 10, 12]))
    assert_array_equal(merge_neighbours(gaussians, np.array([1, 1, 1, 0.1]), 3).is_new, [False, False, True])
    assert_array_equal(merge_neighbours(gaussians, np.array([1, 1, 1, 0.5]), 3).is_new, [True, False, False])


def test_what_is_merged_counts_by_the_lighter_of_two():
    """Ward: 100 / 101 for the gap of 1 beside a heavy one, against 2 * 2 / 4 * 1.5 for that of sqrt(1.5).

    The product of the weights alone, 100 against 6, or the heavier weight, would put the second gap first.
    """
    gaussians = on_a_line(np.array([0.0, 1, 10, 10 + 1.5**0.5]))
    assert_array_equal(merge_neighbours(gaussians, np.array([1.0, 100, 2, 2]), 3).is_new, [True, False, False])


def test_colours_that_differ_are_far_apart():
    """The distances to the nearest are 1 and 1.2, so a difference of 1 in colour is 11 apart."""
    gaussians = on_a_line(np.array([0.0, 1, 20, 21.2]))
    gaussians.sh_dc[0] = 1 / np.sqrt(3) / SH_C0
    edit = merge_neighbours(gaussians, np.ones(4), 3)
    assert_array_equal(edit.is_new, [False, False, True])


@pytest.mark.parametrize(("gap", "merged"), [(1.66, [0, 0, 1]), (1.68, [1, 0, 0])])
def test_how_far_apart_colours_are(gap, merged):
    """Two of different colour at a distance of 1, two of the same colour at one of 5/3: they are equally near.

    The median distance to the nearest is 4/3, so 0.1 of colour is as far as 10 * 4/3 * 0.1, and 1 + (4/3)^2 = (5/3)^2.
    """
    gaussians = on_a_line(np.array([0.0, 1, 20, 20 + gap]))
    gaussians.sh_dc[0] = 0.1 / np.sqrt(3) / SH_C0
    assert_array_equal(merge_neighbours(gaussians, np.ones(4), 3).is_new, merged)


# Hard cases -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 20, 26])
def test_grids_and_heaps_merge_to_the_end(n):
    """Equal distances everywhere, three in each place: mutual neighbours are not unique."""
    grid = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), axis=-1).reshape(-1, 3)
    gaussians = balls(np.repeat(grid, 3, axis=0), sizes=0.1, opacities=0.5)
    edit = merge_neighbours(gaussians, np.ones(81), n)
    assert len(edit.gaussians.means) == n
    assert all(np.isfinite(field).all() for field in edit.gaussians)


def test_thin_needles_stay_finite():
    """Two alike in one place, forty times: rounding makes the smallest eigenvalue of some negative."""
    needles = make_gaussians(np.random.default_rng(3), 40)
    needles = needles._replace(log_scales=np.tile(np.log([1.0, 1e-9, 1e-12]), (40, 1)))
    merged = merge_neighbours(take(needles, np.repeat(np.arange(40), 2)), np.ones(80), 40)
    assert merged.is_new.all() and all(np.isfinite(field).all() for field in merged.gaussians)
    assert merged.gaussians.log_scales.min() >= np.log(0.99e-12)


def test_nothing_to_merge_changes_nothing(rng):
    gaussians = as_dtype(make_gaussians(rng, 5), np.float32)
    edit = merge_neighbours(gaussians, IMPORTANCE, 4)
    assert_array_equal(edit.parent_ids, [0, 2, 3, 4])
    assert not edit.is_new.any()
    for field, old in zip(edit.gaussians, gaussians, strict=True):
        assert_array_equal(field, old[[0, 2, 3, 4]])


def test_float32_stays_float32(rng):
    gaussians = make_gaussians(rng, 30)
    exact = merge_neighbours(gaussians, np.ones(30), 10)
    rounded = merge_neighbours(as_dtype(gaussians, np.float32), np.ones(30, np.float32), 10)
    assert_array_equal(rounded.parent_ids, exact.parent_ids)
    assert all(field.dtype == np.float32 for field in rounded.gaussians)
    for name in ("means", "log_scales", "opacity_logits", "sh_dc", "sh_rest"):  # a quaternion may change its sign
        actual, expected = getattr(rounded.gaussians, name), getattr(exact.gaussians, name)
        assert_allclose(actual, expected, atol=10 * ROUNDED_TO_FLOAT32)


@pytest.mark.parametrize("choose", [by_sampling, by_rank, by_merging])
@pytest.mark.parametrize(
    ("importance", "n", "message"),
    [
        (IMPORTANCE, 50_000, "budget is 50,000 but only 4 Gaussians have any importance: lower the budget"),
        (IMPORTANCE, 0, "budget is 0"),
        (np.zeros(5), 1, "all importance is 0"),
    ],
)
def test_impossible_budgets(choose, importance, n, message, rng):
    with pytest.raises(InputError, match=message):
        choose(make_gaussians(rng, 5), importance, n, rng)


def test_no_mass_to_carry():
    with pytest.raises(InputError, match="all importance is 0"):
        select_mass(np.zeros(3), 0.99)


# Starting again -------------------------------------------------------------------------------------------------------


def test_reinitialised_is_as_at_the_start(rng):
    points, colors = rng.normal(size=(50, 3)).astype(np.float32), rng.integers(0, 256, (50, 3), np.uint8)
    start = gaussians_from_points(points, colors, 3)
    trained = as_dtype(make_gaussians(rng, 50), np.float32)._replace(means=start.means, sh_dc=start.sh_dc)
    for field, expected in zip(reinitialise(trained, 3), start, strict=True):
        assert field.dtype == np.float32
        assert_array_equal(field, expected)
    assert reinitialise(trained, 1).sh_rest.shape == (50, 3, 3)


def test_three_cannot_start_again(rng):
    with pytest.raises(InputError, match="3 rows"):
        reinitialise(make_gaussians(rng, 3), 3)
