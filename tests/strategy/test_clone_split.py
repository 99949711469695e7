"""Density control of 3DGS: who is cloned, split and pruned, on Gaussians chosen by hand."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.reference.covariance import covariances
from minisplat_ref.strategy.clone_split import (
    cap_opacity_logits,
    clone_and_split,
    logit,
    prune_faint,
    prune_large,
    screen_gradient_norms,
)
from minisplat_ref.strategy.ops import take
from minisplat_ref.types import Gaussians
from scenes import as_dtype, make_gaussians
from tolerances import CLOSED_FORM, SAMPLE_MEAN

THRESHOLD, SIZE_LIMIT = 2e-4, 0.1


@pytest.fixture
def gaussians(rng):
    """Largest scales 0.05, 0.1 (just at the limit), 0.2, 0.2, 0.05."""
    scales = np.array([[0.05, 0.01, 0.01], [0.01, 0.1, 0.01], [0.01, 0.02, 0.2], [0.2, 0.2, 0.2], [0.05] * 3])
    return make_gaussians(rng, 5)._replace(log_scales=np.log(scales))


def edit_of(gaussians, mean_norms, rng):
    return clone_and_split(gaussians, mean_norms, threshold=THRESHOLD, size_limit=SIZE_LIMIT * (1 + 1e-9), rng=rng)


# Closed form ----------------------------------------------------------------------------------------------------------


def test_gradient_in_normalised_device_coordinates():
    """NDC are two units wide: one pixel of 40 is 2 / 40 unit, so a derivative per pixel grows by 40 / 2."""
    v_means2d = np.array([[3.0, 0.0], [0.0, 4.0], [3.0, 4.0]])
    assert_allclose(screen_gradient_norms(v_means2d, 40, 20), [60, 40, np.hypot(60, 40)], rtol=CLOSED_FORM)
    assert screen_gradient_norms(v_means2d.astype(np.float32), 40, 20).dtype == np.float32


def test_small_are_cloned_and_large_are_split(gaussians, rng):
    mean_norms = np.array([2e-4, 1.0, 2e-4, 1.9e-4, 0.0])  # 0 and 1 clone, 2 splits, 3 and 4 stay
    edit = edit_of(gaussians, mean_norms, rng)
    assert_array_equal(edit.parent_ids, [0, 1, 3, 4, 0, 1, 2, 2])
    assert_array_equal(edit.is_new, [False] * 4 + [True] * 4)
    for field, old in zip(edit.gaussians, gaussians, strict=True):
        assert_array_equal(field[:6], old[[0, 1, 3, 4, 0, 1]])  # survivors and clones are exact copies


def test_children_share_all_but_place_and_size(gaussians, rng):
    edit = edit_of(gaussians, np.array([0, 0, 1.0, 0, 0]), rng)
    children, parent = take(edit.gaussians, edit.is_new), take(gaussians, np.array([2, 2]))
    assert_allclose(np.exp(children.log_scales), np.exp(parent.log_scales) / 1.6, rtol=CLOSED_FORM)
    for name in ("quats", "opacity_logits", "sh_dc", "sh_rest"):
        assert_array_equal(getattr(children, name), getattr(parent, name))
    assert len(np.unique(children.means[:, 0])) == 2
    assert np.all(children.means != parent.means)


def test_children_are_distributed_as_the_parent(rng):
    """Mean and covariance of 2 x 4000 children are those of the Gaussian that they replace: R has the right side."""
    parent = make_gaussians(rng, 1)._replace(
        quats=np.array([[0.9, 0.1, -0.3, 0.2]]), log_scales=np.log([[0.5, 0.1, 0.02]])
    )
    parents = take(parent, np.zeros(4_000, int))
    children = edit_of(parents, np.ones(4_000), rng).gaussians.means
    expected = covariances(parent.quats, np.exp(parent.log_scales))[0]
    assert_allclose(children.mean(axis=0), parent.means[0], atol=SAMPLE_MEAN * 0.5)
    assert_allclose(np.cov(children.T), expected, atol=SAMPLE_MEAN * 0.5**2)


def test_prune_faint(gaussians):
    opacities = np.array([0.004, 0.0051, 0.5, 0.0049, 0.9])
    edit = prune_faint(gaussians._replace(opacity_logits=np.log(opacities / (1 - opacities))), min_opacity=0.005)
    assert_array_equal(edit.parent_ids, [1, 2, 4])
    assert not edit.is_new.any()


def test_prune_large(gaussians):
    assert_array_equal(prune_large(gaussians, size_limit=0.15).parent_ids, [0, 1, 4])


def test_opacity_reset_only_lowers():
    opacities = np.array([0.9, 0.01, 0.003])
    logits = cap_opacity_logits(np.log(opacities / (1 - opacities)), ceiling=0.01)
    assert_allclose(1 / (1 + np.exp(-logits)), [0.01, 0.01, 0.003], rtol=CLOSED_FORM)


def test_logit_inverts_the_sigmoid():
    assert 1 / (1 + np.exp(-logit(0.3))) == pytest.approx(0.3, rel=CLOSED_FORM)


# Hard cases -----------------------------------------------------------------------------------------------------------


def test_empty_population(rng):
    nobody = make_gaussians(rng, 0)
    for edit in (
        edit_of(nobody, np.zeros(0), rng),
        prune_faint(nobody, min_opacity=0.005),
        prune_large(nobody, size_limit=1.0),
    ):
        assert len(edit.gaussians.means) == len(edit.parent_ids) == len(edit.is_new) == 0


def test_everybody_can_be_pruned(gaussians):
    assert len(prune_large(gaussians, size_limit=1e-3).gaussians.means) == 0


def test_float32_stays_float32(gaussians, rng):
    edit = edit_of(as_dtype(gaussians, np.float32), np.ones(5), rng)
    assert isinstance(edit.gaussians, Gaussians)
    assert all(field.dtype == np.float32 for field in edit.gaussians)


def test_same_generator_same_children(gaussians):
    first, second = (edit_of(gaussians, np.ones(5), np.random.default_rng(7)) for _ in range(2))
    assert_array_equal(first.gaussians.means, second.gaussians.means)
