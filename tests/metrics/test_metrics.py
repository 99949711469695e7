"""PSNR, SSIM and the evaluation of views."""

import math

import numpy as np
import pytest

from minisplat_ref.errors import InputError
from minisplat_ref.metrics import correct_colors, evaluate, psnr, ssim
from minisplat_ref.reference.loss import ssim_map
from minisplat_ref.rendering import RenderSettings, render
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import View
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT64


def test_psnr_of_a_constant_error():
    image = np.zeros((4, 5, 3))
    assert psnr(image, image + 0.1) == pytest.approx(20.0, rel=CLOSED_FORM)
    assert psnr(image, image) == math.inf


def test_psnr_pools_the_channels():
    """Errors 0.1, 0, 0: pooled MSE 0.01 / 3. A mean of channel PSNRs would be infinite."""
    assert psnr(np.zeros((4, 5, 3)), np.broadcast_to([0.1, 0, 0], (4, 5, 3))) == pytest.approx(20 + 10 * math.log10(3))


def test_masked_pixels_do_not_count(rng):
    image, target = rng.random((8, 9, 3)), rng.random((8, 9, 3))
    mask = rng.random((8, 9)) < 0.5
    changed = np.where(mask[:, :, None], image, 0.5)
    assert psnr(image, target, mask) == psnr(changed, target, mask) != psnr(image, target)
    assert ssim(image, target, mask, backend=REFERENCE) == ssim(changed, target, mask, backend=REFERENCE)
    with pytest.raises(InputError, match="mask"):
        psnr(image, target, np.zeros((8, 9), bool))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_target_of_bytes_is_that_of_numbers(rng, dtype):
    image, target = rng.random((8, 9, 3)).astype(dtype), rng.integers(0, 256, (8, 9, 3), np.uint8)
    mask = rng.random((8, 9)) < 0.5
    for pixels in (None, mask):
        assert psnr(image, target, pixels) == psnr(image, target.astype(dtype) / 255, pixels)


def test_ssim_is_the_mean_of_the_map(rng, backend):
    image, target = rng.random((15, 13, 3)), rng.random((15, 13, 3))
    assert ssim(image, image, backend=backend) == pytest.approx(1.0, abs=CLOSED_FORM)
    assert ssim(image, target, backend=backend) == pytest.approx(ssim_map(image, target).mean(), rel=PARITY_FLOAT64)


def test_ssim_has_the_published_window(backend):
    """11 pixels and sigma 1.5, K1 = 0.01, K2 = 0.03 (Wang et al. 2004), of one bright pixel in front of black.

    The window moved over the image weighs the pixel by w, its square too: mu = w v, variance = w v^2 - mu^2.
    """
    image, v = np.zeros((21, 21, 3)), 0.7
    image[10, 10] = v
    g = np.exp(-0.5 * (np.arange(-10, 11) / 1.5) ** 2) * (np.abs(np.arange(-10, 11)) <= 5)
    w = np.outer(g, g) / g.sum() ** 2
    mean, c1, c2 = w * v, 1e-4, 9e-4
    expected = c1 * c2 / ((mean**2 + c1) * (w * v * v - mean**2 + c2))
    assert ssim(image, np.zeros_like(image), backend=backend) == pytest.approx(expected.mean(), rel=PARITY_FLOAT64)


def test_colours_corrected_by_hand(rng):
    """A photograph that is an affine map of the rendering: nothing is left, where it does not leave [0, 1]."""
    image = rng.uniform(0.2, 0.6, (9, 11, 3)).astype(np.float32)
    A = np.array([[0.9, 0.1, 0.0], [0.0, 1.2, -0.1], [0.05, 0.0, 0.8]])
    target = image @ A.T + [0.02, -0.03, 0.1]
    np.testing.assert_allclose(correct_colors(image, target), target, atol=1e-6)
    assert psnr(correct_colors(image, target), target) > 100 > 30 > psnr(image, target)
    mask = np.zeros((9, 11), bool)
    mask[:5] = True
    target[5:] = 1 - target[5:]  # what is masked has no say
    np.testing.assert_allclose(correct_colors(image, target, mask)[:5], target[:5], atol=1e-6)
    bytes_ = np.round(255 * target).astype(np.uint8)
    np.testing.assert_allclose(correct_colors(image, bytes_, mask)[:5], target[:5], atol=0.6 / 255)
    grey = np.full((9, 11, 3), 0.5, np.float32)  # a map of rank one
    np.testing.assert_allclose(
        correct_colors(grey, target, mask)[:5], target[:5].mean(axis=(0, 1)) + 0 * grey[:5], atol=1e-6
    )
    assert correct_colors(grey, np.full_like(grey, 3.0)).max() == 1  # clipped, as renderings are


def test_evaluation(rng, backend):
    gaussians = as_dtype(make_gaussians(rng, 30), np.float32)
    background = np.array([0.2, 0.4, 0.6])
    cameras = [make_camera(rng=rng) for _ in range(3)]
    views = []
    for i, camera in enumerate(cameras):
        image = np.clip(render(gaussians, camera, background=background)[0].image, 0, 1)
        worse = np.clip(image + 0.05 * i, 0, 1)
        views.append(View(f"view{i}", camera, np.round(255 * worse).astype(np.uint8), None))
    seen = []
    result = evaluate(
        gaussians, views, RenderSettings(background, backend=backend), on_view=lambda *args: seen.append(args)
    )
    values = [view.psnr for view in result.per_view]
    assert [view.name for view in result.per_view] == ["view0", "view1", "view2"]
    assert values[0] > 50  # rounding to 8 bits only: 10 log10(12 * 255^2) = 58.9 dB
    assert 25 < values[1] < 30 and 19 < values[2] < 25  # 26 and 20 dB, less where the addition is clipped
    assert result.psnr == pytest.approx(np.mean(values))
    assert result.ssim == pytest.approx(np.mean([view.ssim for view in result.per_view]))
    assert result.per_view[0].ssim > result.per_view[1].ssim > result.per_view[2].ssim
    corrected = [view.psnr_corrected for view in result.per_view]
    assert result.psnr_corrected == pytest.approx(np.mean(corrected))
    assert all(after > before for after, before in zip(corrected, values, strict=True)) and corrected[1] > 35
    assert result.lpips is None and "weights" in result.lpips_reason
    assert [view.name for view, _, _ in seen] == ["view0", "view1", "view2"]
    assert seen[0][1].shape == (18, 24, 3) and seen[0][1].max() <= 1.0


def test_a_photograph_s_own_exposure_by_hand(rng):
    """A grey of 0.5 against photographs of 0.6 and 1: 20 and 6.02 dB, but for gains of 1.2 and 4 (clipped)."""
    camera, background = make_camera(rng=rng), np.full(3, 0.5)
    images = [np.full((camera.height, camera.width, 3), value, np.uint8) for value in (153, 255)]
    views = [
        View(f"view{gain}", camera, image, None, log_gain=np.log(np.full(3, gain)))
        for image, gain in zip(images, (1.2, 4.0), strict=True)
    ]
    settings = RenderSettings(background, backend=REFERENCE)
    result = evaluate(make_gaussians(rng, 0), views, settings)
    assert [view.psnr for view in result.per_view] == pytest.approx([20.0, 20 * np.log10(2)])
    assert all(view.psnr_exposed > 100 for view in result.per_view)
    unknown = evaluate(make_gaussians(rng, 0), [view._replace(log_gain=None) for view in views], settings)
    assert unknown.psnr_exposed == unknown.psnr == pytest.approx(result.psnr)


def test_no_views(rng):
    result = evaluate(make_gaussians(rng, 3), [], RenderSettings(np.zeros(3), backend=REFERENCE))
    assert result.psnr is None and result.ssim is None and result.per_view == []
