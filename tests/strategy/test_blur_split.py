"""Blur split of Mini-Splatting: whom it chooses, and that its two forms of the split keep the parent's moments."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.reference.covariance import covariances
from minisplat_ref.rendering import render
from minisplat_ref.strategy.blur_split import is_blurred, principal_axis_children
from minisplat_ref.strategy.clone_split import clone_and_split, random_children
from minisplat_ref.strategy.ops import take
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, ROUNDED_TO_FLOAT32

AREA_FRACTION = 2e-4


@pytest.fixture
def gaussians(rng):
    return make_gaussians(rng, 6)


def edit_of(gaussians, mean_norms, mask, rng, **settings):
    return clone_and_split(
        gaussians, np.array(mean_norms), threshold=1.0, size_limit=0.1, rng=rng, is_blurred=mask, **settings
    )


# Closed form ----------------------------------------------------------------------------------------------------------


def test_blurred_above_a_fraction_of_the_image():
    """2e-4 of 1000 x 500 pixels is 100 of them; the limit itself is not blurred."""
    assert_array_equal(is_blurred(np.array([0, 99, 100, 101]), 1000, 500, area_fraction=AREA_FRACTION), [0, 0, 0, 1])


def test_children_of_a_gaussian_on_the_axes(rng):
    """Scales 1, 2, 0.5, turned by a quarter about z: the longest axis, y, points along -x of the world."""
    parent = make_gaussians(rng, 1)._replace(
        means=np.array([[3.0, 4.0, 5.0]]), quats=np.array([[1.0, 0, 0, 1]]), log_scales=np.log([[1.0, 2.0, 0.5]])
    )
    children = principal_axis_children(parent, np.array([0]), rng)
    shift = 2 * np.sqrt(2 / np.pi)
    assert_allclose(children.means, [[3 - shift, 4, 5], [3 + shift, 4, 5]], rtol=CLOSED_FORM)
    assert_allclose(np.exp(children.log_scales), [[1, 2 * np.sqrt(1 - 2 / np.pi), 0.5]] * 2, rtol=CLOSED_FORM)


def test_mixture_of_the_children_has_the_parents_moments(gaussians, rng):
    """Half of each child: mean of the means, and covariance within plus covariance between."""
    children = principal_axis_children(gaussians, np.arange(6), rng)
    means = children.means.reshape(2, 6, 3)
    deviations = means - gaussians.means
    within = covariances(children.quats, np.exp(children.log_scales)).reshape(2, 6, 3, 3)
    mixture = (within + deviations[..., :, None] * deviations[..., None, :]).mean(axis=0)
    expected = covariances(gaussians.quats, np.exp(gaussians.log_scales))
    assert_allclose(means.mean(axis=0), gaussians.means, atol=CLOSED_FORM)
    assert_allclose(mixture, expected, atol=CLOSED_FORM)


def test_children_keep_all_but_place_and_length(gaussians, rng):
    ids = np.array([4, 1])
    children, parents = principal_axis_children(gaussians, ids, rng), take(gaussians, np.array([4, 1, 4, 1]))
    for name in ("quats", "opacity_logits", "sh_dc", "sh_rest"):
        assert_array_equal(getattr(children, name), getattr(parents, name))
    assert_array_equal((children.log_scales != parents.log_scales).sum(axis=1), 1)


@pytest.mark.parametrize("draw_children", [random_children, principal_axis_children])
def test_blurred_are_split_whatever_their_gradient_and_size(gaussians, rng, draw_children):
    """0 and 1 are small, 2 and 3 large; 1 and 3 are pulled; then the same four blurred, and 4, 5 are neither."""
    scales = np.array([0.05, 0.05, 0.2, 0.2, 0.05, 0.05])
    gaussians = gaussians._replace(log_scales=np.log(np.repeat(scales[:, None], 3, axis=1)))
    pulled = [0, 2, 0, 2, 0, 2.0]
    without = edit_of(gaussians, pulled, np.zeros(6, bool), rng, draw_children=draw_children)
    assert_array_equal(without.parent_ids, [0, 1, 2, 4, 5, 1, 5, 3, 3])
    edit = edit_of(gaussians, pulled, np.arange(6) < 4, rng, draw_children=draw_children)
    assert_array_equal(edit.parent_ids, [4, 5, 1, 5, 0, 1, 2, 3, 0, 1, 2, 3])  # 1 is cloned and split
    assert_array_equal(edit.is_new, [False] * 2 + [True] * 10)
    assert_array_equal(edit.gaussians.means[2], gaussians.means[1])
    near = np.linalg.norm(edit.gaussians.means - gaussians.means[edit.parent_ids], axis=1)
    assert np.all(near < 6 * scales[edit.parent_ids])  # rows and parent_ids are in the same order


def test_the_mask_is_not_edited(gaussians, rng):
    mask = np.array([True, False, False, False, False, False])
    edit_of(gaussians, np.full(6, 2.0), mask, rng)
    assert mask.sum() == 1


# Hard cases -----------------------------------------------------------------------------------------------------------


def test_tiny_image_does_not_split_everybody():
    """2e-4 of 40 x 30 pixels is a quarter of a pixel."""
    counts = np.array([0, 1, 64, 65])
    assert_array_equal(is_blurred(counts, 40, 30, area_fraction=AREA_FRACTION, min_area=64), [0, 0, 0, 1])
    assert_array_equal(is_blurred(counts, 40, 30, area_fraction=AREA_FRACTION), [0, 1, 1, 1])


def test_splitting_stops(rng):
    """One Gaussian fills the view; split again and again, nobody leads at too many pixels in the end."""
    camera = make_camera(40, 30)
    gaussians = make_gaussians(rng, 1, opacity_logit=3.0)._replace(
        means=np.array([[0.0, 0.0, 3.0]]), log_scales=np.log([[1.0, 0.7, 0.3]])
    )
    areas = []
    for _ in range(12):
        counts = render(gaussians, camera, with_stats=True)[0].stats.dominant_count
        areas.append(counts.max())
        mask = is_blurred(counts, 40, 30, area_fraction=1 / 15)  # above 80 pixels
        edit = edit_of(gaussians, np.zeros(len(mask)), mask, rng, draw_children=principal_axis_children)
        gaussians = edit.gaussians
    assert areas[0] > 1000
    assert areas[-1] <= 80
    assert len(gaussians.means) < 400


def test_round_gaussian_is_cut_once(rng):
    """All axes equal: one of them is chosen, and the same each time."""
    parent = make_gaussians(rng, 1)._replace(log_scales=np.zeros((1, 3)))
    children = principal_axis_children(parent, np.array([0]), rng)
    assert_array_equal(children.log_scales[:, 1:], 0)


def test_nothing_is_drawn(gaussians, rng):
    before = rng.bit_generator.state
    principal_axis_children(gaussians, np.arange(6), rng)
    assert rng.bit_generator.state == before


@pytest.mark.parametrize("draw_children", [random_children, principal_axis_children])
def test_nobody_to_split(gaussians, rng, draw_children):
    assert len(draw_children(gaussians, np.arange(0), rng).means) == 0
    assert len(draw_children(make_gaussians(rng, 0), np.arange(0), rng).means) == 0


def test_float32_stays_float32(gaussians, rng):
    exact = principal_axis_children(gaussians, np.arange(6), rng)
    children = principal_axis_children(as_dtype(gaussians, np.float32), np.arange(6), rng)
    for field, expected in zip(children, exact, strict=True):
        assert field.dtype == np.float32
        assert_allclose(field, expected, atol=ROUNDED_TO_FLOAT32 * 10)
