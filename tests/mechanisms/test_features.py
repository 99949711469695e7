"""Feature banks: responses by hand, gradients of both, and files of weights that do not fit."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from gradcheck import check_inner_products, check_jacobian
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.features import network
from minisplat_ref.mechanisms.features.bank import check_size
from minisplat_ref.mechanisms.features.filters import CLASSICAL, ENERGY, EVEN, WAVELENGTH
from minisplat_ref.mechanisms.features.layers import halve, halve_vjp, max_pool_vjp
from minisplat_ref.metrics.lpips import max_pool
from tolerances import CLOSED_FORM


def wave(angle, size=48):
    y, x = np.mgrid[:size, :size]
    phase = 2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / WAVELENGTH
    return np.repeat((0.5 + 0.5 * np.cos(phase))[..., None], 3, axis=2)


@pytest.mark.parametrize("k", range(4))
def test_a_wave_answers_at_its_own_angle(k):
    """About 1 at its own orientation, and less than half of that at each other."""
    maps, _ = CLASSICAL.features(wave(k * np.pi / 4))
    energies = maps[0][..., ENERGY].mean(axis=(0, 1))
    assert energies[k] == pytest.approx(1.0, abs=0.1)
    assert np.delete(energies, k).max() < 0.5 * energies[k]


def test_brightness_is_a_color_and_no_edge():
    """Even filters do not see a constant; the colour channels have 2 c - 1, the last a constant."""
    maps, _ = CLASSICAL.features(np.full((48, 48, 3), 0.8))
    for map_ in maps:
        assert_allclose(map_[..., :3], 0.6, rtol=CLOSED_FORM)
        assert np.abs(map_[..., EVEN]).max() < 1e-12
        assert_allclose(map_[..., -1], 0.5)
        assert_allclose(map_[..., ENERGY], 0.02, rtol=1e-6)  # the floor
    assert [map_.shape[:2] for map_ in maps] == [(21, 21), (16, 16), (3, 3)]  # of 48, 22 and 9 pixels, filters of 7


def test_halving_keeps_a_constant_and_halves_the_size():
    found = halve(np.full((12, 15, 2), 0.3))
    assert found.shape == (4, 6, 2)  # (n - 3) // 2
    assert_allclose(found, 0.3, rtol=CLOSED_FORM)


def test_gradients_of_the_layers(rng):
    image, pooled = rng.normal(size=(9, 8, 2)), rng.normal(size=(6, 4, 2))
    check_jacobian(lambda x: (halve(x),), lambda v: (halve_vjp((9, 8), v),), (image,), names=("image",))
    check_jacobian(lambda x: (max_pool(x, 2, 2),), lambda v: (max_pool_vjp(pooled, 2, 2, v),), (pooled,), names=("x",))


def test_gradient_of_the_classical_bank(rng):
    image = rng.uniform(size=(37, 38, 3))
    maps, tape = CLASSICAL.features(image)
    v_maps = [rng.normal(size=map_.shape) for map_ in maps]
    v_image = CLASSICAL.features_vjp(tape, v_maps)
    names = ("image",)
    check_inner_products(lambda x: tuple(CLASSICAL.features(x)[0]), (v_image,), (image,), v_maps, rng, names=names)


def weights(rng):
    return {
        "weight_1": rng.normal(size=(4, 3, 3, 3)),
        "bias_1": rng.normal(size=4),
        "weight_2": rng.normal(size=(2, 4, 1, 1)),
        "bias_2": rng.normal(size=2),
        "taps": np.array([1, 2]),
        "pool_before": np.array([2]),
    }


def test_taps_of_two_sizes_are_two_maps(rng, tmp_path):
    np.savez(tmp_path / "net.npz", **weights(rng))
    bank = network.load_bank(tmp_path / "net.npz")
    maps, _ = bank.features(rng.uniform(size=(8, 6, 3)))
    assert [map_.shape for map_ in maps] == [(8, 6, 4), (4, 3, 2)] and bank.min_side == 2
    assert all((map_ >= 0).all() for map_ in maps)  # after the ReLU


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weight_2": np.zeros((2, 5, 1, 1))}, "weight_2 is float64 [2, 5, 1, 1], not floats [2, 4, 1, 1]"),
        ({"weight_1": np.zeros((4, 3, 2, 2))}, "weight_1 is float64 [4, 3, 2, 2], not floats"),
        ({"bias_1": np.zeros(3)}, "bias_1 is float64 [3], not floats [4]"),
        ({"taps": np.array([3])}, "taps is not a list of whole numbers from 1 to 2"),
        ({"taps": np.array([], int)}, "taps names no convolution"),
        ({"pool_before": np.array([1])}, "pool_before is not a list of whole numbers from 2 to 2"),
        ({"std": np.array([1.0, 0, 1])}, "std has a zero"),
        ({"mean": np.zeros(2)}, "mean is float64 [2], not floats [3]"),
        ({"bias_2": np.full(2, np.nan)}, "bias_2"),
    ],
)
def test_weights_that_do_not_fit_are_named(change, message, rng):
    with pytest.raises(InputError) as error:
        network.as_network({**weights(rng), **change}, "net.npz")
    assert message in str(error.value) and str(error.value).startswith("net.npz: ")


def test_a_missing_array_is_named(rng):
    arrays = weights(rng)
    del arrays["bias_2"]
    with pytest.raises(InputError, match="net: bias_2 is missing"):
        network.as_network(arrays, "net")


def test_an_image_that_is_too_small_is_refused():
    check_size(CLASSICAL, CLASSICAL.min_side, CLASSICAL.min_side, "a")
    with pytest.raises(InputError, match="photograph b is 10 x 90 pixels"):
        check_size(CLASSICAL, 10, 90, "photograph b")
    side = CLASSICAL.min_side
    assert all(min(map_.shape) > 0 for map_ in CLASSICAL.features(np.zeros((side, side, 3)))[0])
