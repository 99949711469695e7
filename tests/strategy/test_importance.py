"""Importance over several views against the weights of all pairs, and the mass mask by hand."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.reference.compositing import composite_all_pairs
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.strategy.importance import ImportanceStats, collect_importance, indoor, mass_mask, outdoor
from minisplat_ref.strategy.ops import take
from minisplat_ref.types import view_from
from scenes import activated, as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

N_GAUSSIANS = 30


def looking(cameras):
    """Views from these cameras."""
    return [view_from(camera) for camera in cameras]


@pytest.fixture
def gaussians(rng):
    """Thirty that overlap, and at the end one behind all cameras and one too faint to be drawn."""
    gaussians = make_gaussians(rng, N_GAUSSIANS, size=0.2, opacity_logit=1)
    gaussians.means[-2, 2] = -5
    gaussians.opacity_logits[-1] = -9
    return gaussians


@pytest.fixture
def cameras(rng):
    """Three views of different sizes; the last looks at a few of the Gaussians only."""
    aside = make_camera(rng=rng)._replace(cam_from_world_t=np.array([1.2, 0, 0]))
    return [make_camera(37, 29, fx=40, fy=45), make_camera(30, 20, fx=35, fy=35, rng=rng), aside]


def weights_of(gaussians, camera):
    """Weights [H, W, N] of all pairs: a channel of one's own is an image of one's weights."""
    projection = REFERENCE.project(*activated(gaussians), camera, GSPLAT_MAIN)
    n = len(gaussians.means)
    return composite_all_pairs(projection, np.eye(n), np.zeros(n), camera.width, camera.height, GSPLAT_MAIN)[0]


# Several views --------------------------------------------------------------------------------------------------------


def test_sums_over_views(backend, gaussians, cameras):
    stats = collect_importance(gaussians, looking(cameras), RenderSettings(backend=backend))
    expected_mean = np.zeros(N_GAUSSIANS)
    images = [weights_of(gaussians, camera) for camera in cameras]
    for image in images:
        wins = np.unique(image.argmax(axis=2)[image.any(axis=2)])
        expected_mean[wins] += image.sum(axis=(0, 1))[wins] / (image[:, :, wins] > 0).sum(axis=(0, 1))
    assert_allclose(stats.mean_weight_sum, expected_mean, rtol=0, atol=PARITY_FLOAT64)
    assert_allclose(stats.blend_weight_sum, sum(i.sum(axis=(0, 1)) for i in images), rtol=PARITY_FLOAT64)
    assert_allclose(stats.blend_weight_max, np.max([i.max(axis=(0, 1)) for i in images], axis=0), rtol=PARITY_FLOAT64)
    winners = np.concatenate([image.argmax(axis=2)[image.any(axis=2)] for image in images])
    assert_array_equal(stats.dominant_count, np.bincount(winners, minlength=N_GAUSSIANS))
    assert 0 < np.count_nonzero(stats.dominant_count) < np.count_nonzero(stats.blend_weight_sum)
    assert_array_equal(indoor(stats), stats.blend_weight_sum)
    assert_array_equal(outdoor(stats), stats.mean_weight_sum)


def test_visible_are_those_that_carry_the_view(backend, gaussians, cameras):
    stats = collect_importance(gaussians, looking(cameras), RenderSettings(backend=backend), visibility_mass=0.9)
    for v, camera in enumerate(cameras):
        weight_sums = weights_of(gaussians, camera).sum(axis=(0, 1))
        is_visible = stats.is_visible[:, v]
        kept, dropped = weight_sums[is_visible], weight_sums[~is_visible]
        assert kept.min() > dropped.max()  # the most important ones,
        assert kept.sum() >= 0.9 * weight_sums.sum() > kept.sum() - kept.min()  # and none too many
    assert 0 < stats.is_visible[:, 2].sum() < stats.is_visible[:, 0].sum()


def test_the_frustum_is_wider_than_what_is_seen(backend, gaussians, cameras):
    stats = collect_importance(gaussians, looking(cameras), RenderSettings(backend=backend))
    radii = [backend.project(*activated(gaussians), camera, GSPLAT_MAIN).radii for camera in cameras]
    assert_array_equal(stats.frustum_count, np.sum([(r > 0).all(axis=1) for r in radii], axis=0))
    assert stats.frustum_count[-2] == 0 and stats.frustum_count.max() == 3
    assert np.all(stats.is_visible.sum(axis=1) <= stats.frustum_count)


@pytest.mark.parametrize("field", ImportanceStats._fields)
def test_float32_and_types(gaussians, cameras, field):
    expected = getattr(collect_importance(gaussians, looking(cameras), RenderSettings(backend=REFERENCE)), field)
    actual = getattr(
        collect_importance(as_dtype(gaussians, np.float32), looking(cameras), RenderSettings(backend=CPU)), field
    )
    assert actual.dtype == expected.dtype
    if expected.dtype == np.float64:
        assert_allclose(actual, expected, rtol=0, atol=PARITY_FLOAT32_IMAGE * expected.max())
    else:
        assert_array_equal(actual, expected)


def test_hidden_gaussian_is_no_winner_but_has_weight():
    """Half transparent in front, opaque behind: 0.6 against 0.4 * 0.9 where both are at their peaks."""
    pair = make_gaussians(np.random.default_rng(0), 2)._replace(
        means=np.array([[0.0, 0, 2], [0, 0, 3]]),
        log_scales=np.log([[0.2] * 3, [0.01] * 3]),
        opacity_logits=np.log([0.6 / 0.4, 0.9 / 0.1]),
    )
    camera = make_camera(25, 19)
    stats = collect_importance(pair, looking([camera, camera]))
    assert_allclose(stats.blend_weight_max, [0.6, 0.36], rtol=CLOSED_FORM)
    assert stats.dominant_count[1] == 0 and stats.blend_weight_sum[1] > 0.72
    assert outdoor(stats)[1] == 0 and outdoor(stats)[0] > 0


# Mass mask ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("importance", "mass", "expected"),
    [
        ([0, 2, 3, 3], 0.75, [2, 3]),  # 6 of 8: the least carries just what may go
        ([0, 2, 3, 3], 0.76, [1, 2, 3]),
        ([7, 2, 1, 0], 0.6, [0]),
        ([0, 1, 3, 6], 1.0, [1, 2, 3]),
        ([0, 1, 3, 6], 0.0, []),
        ([1, 1, 1, 1], 0.5, [0, 1]),
        ([5], 0.99, [0]),
        ([0, 0, 0], 0.99, []),
        ([], 0.99, []),
    ],
)
def test_mass_mask_by_hand(importance, mass, expected):
    assert_array_equal(np.flatnonzero(mass_mask(np.array(importance, float), mass)), expected)


def test_small_importance_counts():
    """The released code adds 1e-6 to each, and so drops everything of a scene as faint as this."""
    assert_array_equal(mass_mask(np.array([1e-9, 2e-9, 7e-9]), 0.95), [True, True, True])


def test_many_small_ones_keep_their_sum():
    """A running sum in their own dtype would stop growing at 2048, as float32's does at 16 million."""
    assert mass_mask(np.ones(10_000, np.float16), 0.5).sum() == 5_000


def test_mass_is_not_rank(rng):
    """Of log-normal importance, most of the mass lies in far more than one in a hundred."""
    importance = np.exp(2 * rng.normal(size=20_000))
    mask = mass_mask(importance, 0.99)
    assert 0.3 < mask.mean() < 0.8
    assert importance[mask].min() >= importance[~mask].max()


# Hard cases -----------------------------------------------------------------------------------------------------------


def test_nobody_and_no_view(rng, cameras):
    stats = collect_importance(make_gaussians(rng, 0), looking(cameras))
    assert stats.is_visible.shape == (0, 3) and stats.blend_weight_sum.shape == (0,)
    stats = collect_importance(make_gaussians(rng, 4), [])
    assert stats.is_visible.shape == (4, 0) and not stats.frustum_count.any()


def test_nothing_is_seen(gaussians):
    gaussians.means[:, 2] = -3
    stats = collect_importance(gaussians, looking([make_camera()]))
    assert not any(field.any() for field in stats)


def test_rows_follow_an_edit(gaussians, cameras):
    stats = take(collect_importance(gaussians, looking(cameras)), np.array([4, 7]))
    assert stats.is_visible.shape == (2, 3) and stats.dominant_count.shape == (2,)
