"""Halves: together they have the mean, the covariance and the optical depth of what they replace."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.reference.covariance import covariances
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.strategy.halving import halves, thin_logits
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM


@pytest.fixture
def gaussians(rng):
    return make_gaussians(rng, 6)


def opacity(logits):
    return 1 / (1 + np.exp(-logits))


def test_a_gaussian_on_the_axes():
    """Scales 1, 2, 0.5 and d = 0.6: the halves are 2.4 apart on y, 0.8 times as long; tau is shared by 1.6."""
    parent = make_gaussians(np.random.default_rng(0), 1)._replace(
        means=np.array([[3.0, 4.0, 5.0]]),
        quats=np.array([[1.0, 0, 0, 0]]),
        log_scales=np.log([[1.0, 2.0, 0.5]]),
        opacity_logits=np.zeros(1),
    )
    edit = halves(parent, np.array([0]), offset=0.6)
    assert_allclose(edit.gaussians.means, [[3, 2.8, 5], [3, 5.2, 5]], rtol=CLOSED_FORM)
    assert_allclose(np.exp(edit.gaussians.log_scales), [[1, 1.6, 0.5]] * 2, rtol=CLOSED_FORM)
    assert_allclose(1 - opacity(edit.gaussians.opacity_logits), [0.5 ** (1 / 1.6)] * 2, rtol=CLOSED_FORM)


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.5, 0.9])
def test_the_moments_stay(gaussians, offset):
    """Of the even mixture: mean of the means, and covariance within plus covariance between."""
    edit = halves(gaussians, np.arange(6), offset=offset)
    means = edit.gaussians.means.reshape(2, 6, 3)
    deviations = means - gaussians.means
    within = covariances(edit.gaussians.quats, np.exp(edit.gaussians.log_scales)).reshape(2, 6, 3, 3)
    mixture = (within + deviations[..., :, None] * deviations[..., None, :]).mean(axis=0)
    assert_allclose(means.mean(axis=0), gaussians.means, atol=CLOSED_FORM)
    assert_allclose(mixture, covariances(gaussians.quats, np.exp(gaussians.log_scales)), atol=CLOSED_FORM)


def test_the_optical_depth_stays(gaussians):
    """Its integral over space is tau times the product of the scales, up to (2 pi)^1.5."""

    def integrals(g):
        return -np.log1p(-opacity(g.opacity_logits)) * np.exp(g.log_scales.sum(axis=1))

    edit = halves(gaussians, np.arange(6))
    assert_allclose(integrals(edit.gaussians).reshape(2, 6).sum(axis=0), integrals(gaussians), rtol=CLOSED_FORM)


def test_rows_and_parents(gaussians):
    """Rows that are not halved stay as they are; a first half keeps its parent's place and moments."""
    edit = halves(gaussians, np.array([1, 4]))
    untouched = [0, 2, 3, 5]
    for field, old in zip(edit.gaussians, gaussians, strict=True):
        assert_array_equal(field[untouched], old[untouched])
    assert_array_equal(edit.parent_ids, [0, 1, 2, 3, 4, 5, 1, 4])
    assert_array_equal(edit.is_new, [0, 0, 0, 0, 0, 0, 1, 1])
    assert not np.array_equal(edit.gaussians.means[1], gaussians.means[1])


def test_nothing_to_halve(gaussians):
    edit = halves(gaussians, np.zeros(0, int))
    for field, old in zip(edit.gaussians, gaussians, strict=True):
        assert_array_equal(field, old)
    assert not edit.is_new.any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_logits_of_any_size(dtype):
    """1 - o is 1e-44 for a logit of 100; what is nearly transparent has o' = factor o."""
    logits = np.array([-80.0, -20.0, 0.0, 20.0, 100.0], dtype)
    thinned = thin_logits(logits, 0.5)
    assert thinned.dtype == dtype and np.isfinite(thinned).all()
    assert_allclose(thinned[:2], logits[:2] + np.log(0.5), rtol=1e-6)
    assert_allclose(thinned[3:], logits[3:] / 2, rtol=1e-4)
    assert_allclose(thin_logits(logits, 1.0), logits, rtol=1e-6, atol=1e-6)


def test_logits_whose_opacity_is_no_number_above_0():
    """Below -745 the opacity underflows in float64; its logarithm does not. Above and below -40 the formulas agree."""
    logits = np.array([-1e4, -800.0, -745.2, -40.000001, -39.999999])
    assert_allclose(thin_logits(logits, 0.5), logits - np.log(2), rtol=1e-14)
    assert_allclose(thin_logits(logits, 3.0), logits + np.log(3), rtol=1e-14)


def test_the_image_hardly_changes(rng):
    """Unlike that of a plain clone, which is more opaque; the rest is the mixture's flatter top."""
    gaussians, camera = make_gaussians(rng, 1, size=0.3), make_camera()
    gaussians = gaussians._replace(opacity_logits=np.zeros(1))

    def alpha(g):
        return render(g, camera, background=np.zeros(3), backend=CPU)[0].alpha

    before = alpha(gaussians)
    halved = alpha(halves(gaussians, np.array([0])).gaussians)
    cloned = alpha(type(gaussians)(*(np.concatenate([field, field]) for field in gaussians)))
    assert np.abs(halved - before).max() < 0.25 * np.abs(cloned - before).max()
