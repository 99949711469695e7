import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import correlate1d

from gradcheck import check_inner_products, check_jacobian
from minisplat_ref.constants import SSIM_C1, SSIM_C2
from minisplat_ref.reference.loss import ssim_map, ssim_map_vjp
from minisplat_ref.rendering.backends import REFERENCE
from tolerances import CLOSED_FORM, GRADIENT_FLOOR, PARITY_FLOAT32_LOSS, PARITY_FLOAT64, SSIM_BY_SCIPY

ROOT = Path(__file__).parents[2]


def two_images(rng, height=20, width=17):
    target = rng.uniform(size=(height, width, 3))
    return np.clip(target + 0.1 * rng.normal(size=target.shape), 0, 1), target


# --- closed form ---


def test_l1_by_hand(backend):
    image, target = np.zeros((2, 2, 3)), np.zeros((2, 2, 3))
    image[0, 0], target[1, 1] = [0.1, 0.2, 0.3], [0.6, 0, 0]
    loss, _ = backend.photometric_loss(image, target, 0.0)
    assert_allclose(loss, 1.2 / 12, rtol=CLOSED_FORM)


def test_equal_images_have_no_loss(backend, rng):
    image, _ = two_images(rng)
    loss, tape = backend.photometric_loss(image, image.copy(), 0.2)
    assert_allclose(loss, 0, atol=CLOSED_FORM)
    assert_allclose(backend.photometric_loss_vjp(tape), 0, atol=CLOSED_FORM)
    assert_allclose(ssim_map(image, image), 1, rtol=1e2 * CLOSED_FORM)


def test_ssim_of_flat_images():
    # Away from the border flat images have no variance: SSIM = (2 a b + C1) / (a^2 + b^2 + C1).
    a, b = 0.3, 0.5
    flat = ssim_map(np.full((21, 21, 3), a), np.full((21, 21, 3), b))
    assert_allclose(flat[10, 10], (2 * a * b + SSIM_C1) / (a * a + b * b + SSIM_C1), rtol=1e2 * CLOSED_FORM)
    assert (np.abs(flat[0, 0] - flat[10, 10]) > 1e-4).all()  # zeros beyond the border are seen there


def test_ssim_of_a_single_bright_pixel():
    # At the pixel itself the window has weight g^2 there: mu = g^2 v, E[x^2] = g^2 v^2, with a black target.
    image, v = np.zeros((15, 15, 3)), 0.7
    image[7, 7] = v
    g = 1 / np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2).sum()
    mean, variance = g * g * v, g * g * v * v * (1 - g * g)
    expected = SSIM_C1 * SSIM_C2 / ((mean**2 + SSIM_C1) * (variance + SSIM_C2))
    assert_allclose(ssim_map(image, np.zeros_like(image))[7, 7], expected, rtol=1e2 * CLOSED_FORM)


@pytest.mark.parametrize("size", [(20, 17), (4, 3), (1, 30)])
def test_ssim_against_scipys_filters(rng, size):
    image, target = two_images(rng, *size)
    window = np.exp(-(np.arange(-5.0, 6) ** 2) / (2 * 1.5**2))
    window /= window.sum()

    def blur(x):
        return correlate1d(correlate1d(x, window, axis=0, mode="constant"), window, axis=1, mode="constant")

    mx, my = blur(image), blur(target)
    vx, vy, cov = blur(image**2) - mx**2, blur(target**2) - my**2, blur(image * target) - mx * my
    expected = (2 * mx * my + SSIM_C1) * (2 * cov + SSIM_C2) / ((mx**2 + my**2 + SSIM_C1) * (vx + vy + SSIM_C2))
    assert_allclose(ssim_map(image, target), expected, rtol=0, atol=SSIM_BY_SCIPY)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_loss_mixes_its_terms(backend, rng, weight):
    image, target = two_images(rng)
    loss, _ = backend.photometric_loss(image, target, weight)
    expected = (1 - weight) * np.abs(image - target).mean() + weight * (1 - ssim_map(image, target).mean())
    assert_allclose(loss, expected, rtol=1e2 * CLOSED_FORM)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("is_masked", [False, True])
def test_bytes_are_255ths(backend, dtype, is_masked, rng):
    image, photograph = two_images(rng)[0].astype(dtype), rng.integers(0, 256, (20, 17, 3), np.uint8)
    mask = rng.uniform(size=(20, 17)) < 0.6 if is_masked else None
    losses, gradients = [], []
    for target in (photograph, (photograph / 255).astype(dtype)):
        loss, tape = backend.photometric_loss(image, target, 0.2, mask)
        losses.append(loss)
        gradients.append(backend.photometric_loss_vjp(tape))
    tolerance = 1e2 * CLOSED_FORM if dtype == np.float64 else PARITY_FLOAT32_LOSS
    assert_allclose(*losses, rtol=tolerance)
    assert gradients[0].dtype == dtype
    assert_allclose(*gradients, rtol=0, atol=tolerance * np.abs(gradients[1]).max())


def test_masked_pixels_neither_count_nor_leak(backend, rng):
    image, target = two_images(rng)
    mask = rng.uniform(size=image.shape[:2]) < 0.6
    loss, tape = backend.photometric_loss(image, target, 0.2, mask)
    filled = np.where(mask[:, :, None], image, target)
    expected = 0.8 * np.abs(image - target)[mask].mean() + 0.2 * (1 - ssim_map(filled, target)[mask].mean())
    assert_allclose(loss, expected, rtol=1e2 * CLOSED_FORM)
    garbage = np.where(mask[:, :, None], image, 1e6 * rng.normal(size=image.shape))
    other_loss, other_tape = backend.photometric_loss(garbage, target, 0.2, mask)
    assert other_loss == loss
    v_image = backend.photometric_loss_vjp(tape)
    assert_array_equal(backend.photometric_loss_vjp(other_tape), v_image)
    assert not v_image[~mask].any() and v_image[mask].any()


def test_full_mask_is_no_mask(backend, rng):
    image, target = two_images(rng)
    results = [backend.photometric_loss(image, target, 0.2, mask) for mask in (None, np.ones((20, 17), dtype=bool))]
    assert results[0][0] == results[1][0]
    assert_array_equal(*(backend.photometric_loss_vjp(tape) for _, tape in results))


def test_gradient_has_the_dtype_of_the_image(backend, rng):
    image, target = (array.astype(np.float32) for array in two_images(rng))
    _, tape = backend.photometric_loss(image, target, 0.2, np.ones((20, 17), dtype=bool))
    assert backend.photometric_loss_vjp(tape).dtype == np.float32


def test_empty_mask_gives_nothing(backend, rng):
    image, target = two_images(rng)
    loss, tape = backend.photometric_loss(image, target, 0.2, np.zeros((20, 17), dtype=bool))
    assert loss == 0.0
    assert not backend.photometric_loss_vjp(tape).any()


# --- gradient ---


def test_ssim_jacobian(rng):
    image, target = two_images(rng, 4, 3)
    check_jacobian(
        lambda x: (ssim_map(x, target),), lambda v: (ssim_map_vjp(image, target, v),), (image,), names=["image"]
    )


@pytest.mark.parametrize("is_masked", [False, True])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_loss_gradient(backend, rng, weight, is_masked):
    image, target = two_images(rng)
    mask = rng.uniform(size=(20, 17)) < 0.6 if is_masked else None
    _, tape = backend.photometric_loss(image, target, weight, mask)
    check_inner_products(
        lambda x: (np.array(backend.photometric_loss(x, target, weight, mask)[0]),),
        (backend.photometric_loss_vjp(tape, 300.0),),
        (image,),
        (np.array(300.0),),
        rng,
        names=["image"],
    )


# --- parity ---


@pytest.mark.parametrize("is_masked", [False, True])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_backends_agree(fast_backend, dtype, is_masked, rng):
    image, target = two_images(rng, 41, 37)
    mask = rng.uniform(size=(41, 37)) < 0.6 if is_masked else None
    expected, tape = REFERENCE.photometric_loss(image, target, 0.2, mask)
    v_expected = REFERENCE.photometric_loss_vjp(tape, 2.0)
    actual, tape = fast_backend.photometric_loss(image.astype(dtype), target.astype(dtype), 0.2, mask)
    v_actual = fast_backend.photometric_loss_vjp(tape, 2.0)
    tolerance = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_LOSS
    assert v_actual.dtype == dtype and np.abs(v_expected).max() > GRADIENT_FLOOR
    assert_allclose(actual, expected, rtol=tolerance)
    assert_allclose(v_actual, v_expected, rtol=0, atol=tolerance * np.abs(v_expected).max())


# --- bytes ---

AT_ANY_NUMBER_OF_THREADS = """
import hashlib
import numba
import numpy as np
from minisplat_ref.rendering.backends import CPU

rng = np.random.default_rng(0)
for dtype in (np.float32, np.float64):
    for height in range(1, 65):
        image, target = rng.uniform(size=(2, height, 9, 3)).astype(dtype)
        found = set()
        for n_threads in range(1, 6):
            numba.set_num_threads(n_threads)
            loss, tape = CPU.photometric_loss(image, target, 0.2)
            found.add((loss, hashlib.sha256(tape.v_image.tobytes()).hexdigest()))
        print(np.dtype(dtype), height, len(found))
"""


def test_same_bytes_at_any_height_and_number_of_threads():
    """Rows are filtered two at a time, and a row's arithmetic must not depend on where the bands of threads begin."""
    environment = os.environ | {"NUMBA_NUM_THREADS": "5", "PYTHONPATH": str(ROOT)}  # five threads on any machine
    command = [sys.executable, "-c", AT_ANY_NUMBER_OF_THREADS]
    lines = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) == 2 * 64
    assert [line for line in lines if not line.endswith(" 1")] == []
