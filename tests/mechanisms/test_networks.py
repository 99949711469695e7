"""Networks and encodings: by hand, against differences, kernels beside NumPy, and learning a known function."""

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.mechanisms.networks.contraction import contract, contract_vjp
from minisplat_ref.mechanisms.networks.hash_grid import Levels, make_levels, make_table, vertex_rows
from minisplat_ref.mechanisms.networks.mlp import (
    Layer,
    from_shared,
    make_network,
    network_rates,
    to_shared,
    train_step,
    zero_moments,
)
from minisplat_ref.mechanisms.networks.networks import COMPILED, IN_NUMPY, networks_for
from tolerances import CLOSED_FORM, GRADIENT_REL, GRADIENT_STEP, PARITY_FLOAT32_GRADIENT, PARITY_FLOAT64


@pytest.fixture(params=[IN_NUMPY, COMPILED], ids=["NumPy", "kernels"])
def networks(request):
    return request.param


def check_gradient(function, arrays, found, v, rng):
    """Compare ``found``, by array, with differences of ``sum(v function())`` along a random direction of each array."""
    for array, got in zip(arrays, found, strict=True):
        direction = rng.normal(size=array.shape)
        values = []
        for step in (GRADIENT_STEP, -GRADIENT_STEP):
            array += step * direction
            values.append(np.sum(v * function()))
            array -= step * direction
        difference = (values[0] - values[1]) / (2 * GRADIENT_STEP)
        assert got.shape == array.shape and abs(difference) > 1e-2
        assert_allclose(np.sum(got * direction), difference, rtol=GRADIENT_REL)


# Multilayer perceptron


@pytest.mark.parametrize("slope", [0.0, 0.25])
def test_two_layers_by_hand(networks, slope):
    network = (
        Layer(np.array([[1.0, -1.0], [2.0, 0.5]]), np.array([0.5, 0.0])),
        Layer(np.array([[2.0], [3.0]]), np.array([-1.0])),
    )
    # Before the ReLU: (1 + 2 + 0.5, -1 + 0.5) and (-1 + 0.5, 1).
    y, tape = networks.forward(network, np.array([[1.0, 1.0], [-1.0, 0.0]]), slope)
    assert_allclose(y, [[6.0 - 1.5 * slope], [2.0 - slope]], rtol=CLOSED_FORM)
    (first, second), v_x = networks.forward_vjp(network, tape, np.array([[1.0], [10.0]]), slope)
    # v_h = (2, 3) and (20, 30), of which the second and the first number pass the ReLU with the slope.
    assert_allclose(second.weights[:, 0], [3.5 - 5 * slope, -0.5 * slope + 10.0], rtol=CLOSED_FORM)
    assert_allclose(second.biases, [11.0], rtol=CLOSED_FORM)
    v_h = np.array([[2.0, 3 * slope], [20 * slope, 30.0]])
    assert_allclose(first.biases, v_h.sum(axis=0), rtol=CLOSED_FORM)
    assert_allclose(first.weights, [v_h[0] - v_h[1], v_h[0]], rtol=CLOSED_FORM)
    assert_allclose(v_x, v_h @ [[1.0, 2.0], [-1.0, 0.5]], rtol=CLOSED_FORM)


@pytest.mark.parametrize("n", [7, 130])
def test_gradients_of_weights_biases_and_input(networks, n, rng):
    """In both less than a block of rows, and more than two; widths are no multiples of a lane."""
    network, x = make_network((3, 21, 4, 2), rng), rng.normal(size=(n, 3))
    network = tuple(Layer(layer.weights, rng.normal(size=layer.biases.shape)) for layer in network)
    v = rng.normal(size=(n, 2))
    gradients, v_x = networks.forward_vjp(network, networks.forward(network, x, 0.1)[1], v, 0.1)
    arrays = [*(array for layer in network for array in layer), x]
    found = [*(array for layer in gradients for array in layer), v_x]
    check_gradient(lambda: networks.forward(network, x, 0.1)[0], arrays, found, v, rng)


def test_no_rows(networks, rng):
    network = make_network((3, 5, 2), rng)
    y, tape = networks.forward(network, np.zeros((0, 3)))
    gradient, v_x = networks.forward_vjp(network, tape, y)
    assert y.shape == (0, 2) and v_x.shape == (0, 3)
    assert all(not array.any() for layer in gradient for array in layer)


def test_as_shared_parameters(rng):
    network = make_network((3, 5, 2), rng)
    shared = to_shared("net", network) | to_shared("net2", make_network((2, 2), rng))
    assert list(shared)[:4] == ["net_weights_0", "net_biases_0", "net_weights_1", "net_biases_1"]
    back = from_shared("net", shared)
    assert [id(array) for layer in back for array in layer] == [id(array) for layer in network for array in layer]
    assert from_shared("none", shared) == ()
    assert network_rates("net", 2, 0.5) == dict.fromkeys(list(shared)[:4], 0.5)


def test_it_learns_a_known_function(rng):
    """y = |x| is two ReLUs exactly."""
    network = make_network((1, 16, 1), rng)
    moments, errors = zero_moments(network), []
    for step in range(1, 401):
        x = rng.uniform(-1, 1, (64, 1))
        errors.append(train_step(network, x, np.abs(x), 1e-2, moments, step))
    assert np.mean(errors[-20:]) < 1e-3 < errors[0]


def test_the_first_step_of_adam_has_the_length_of_the_rate(rng):
    """m / sqrt(v) is the sign of the gradient after the bias corrections."""
    network = make_network((2, 3), rng)
    before = network[0].weights.copy()
    train_step(network, rng.normal(size=(9, 2)), rng.normal(size=(9, 3)), 0.01, zero_moments(network), 1)
    assert_allclose(np.abs(network[0].weights - before), 0.01, rtol=1e-5)


# Fourier encoding


def test_octaves_by_hand(networks):
    """The sines and cosines of 30 and 60 degrees, then of -90 and -180."""
    root = np.sqrt(3) / 2
    found = networks.fourier(np.array([[1 / 6, -1 / 2]]), 2)
    assert_allclose(found, [[0.5, root, root, 0.5, -1, 0, 0, -1]], atol=CLOSED_FORM)


def test_the_highest_octave_is_exact_in_float32(networks, rng):
    """A float32 number has the encoding of the same number in float64; 2^15 pi x in float32 would be off by 0.01."""
    x = rng.uniform(-2, 2, size=(50, 3)).astype(np.float32)
    assert_allclose(networks.fourier(x, 16), IN_NUMPY.fourier(x.astype(np.float64), 16), atol=1e-6)
    assert_array_equal(networks.fourier(x + np.float32(0), 3).shape, (50, 18))


def test_gradient_of_octaves(networks, rng):
    x, v = rng.normal(size=(9, 3)), rng.normal(size=(9, 30))
    check_gradient(lambda: networks.fourier(x, 5), [x], [networks.fourier_vjp(x, 5, v)], v, rng)


# Contraction


def test_contraction_by_hand():
    """Within the unit ball nothing moves; (0, 3, 4) comes to the length 2 - 1/5; infinity is at 2."""
    x = np.array([[0.0, 0.6, 0.8], [0.1, 0, 0], [0, 3, 4], [0, 0, -1e12], [0, 0, 0]])
    assert_allclose(contract(x), [[0, 0.6, 0.8], [0.1, 0, 0], [0, 1.08, 1.44], [0, 0, -2], [0, 0, 0]], atol=1e-11)


def test_gradient_of_the_contraction(rng):
    x, v = rng.normal(size=(40, 3)), rng.normal(size=(40, 3))
    assert 5 < np.count_nonzero(np.linalg.norm(x, axis=1) > 1) < 38
    check_gradient(lambda: contract(x), [x], [contract_vjp(x, v)], v, rng)


# Hash grid


def test_levels_grow_in_equal_ratios():
    assert make_levels(4, 16, 128, n_rows=2**12, n_features=2) == Levels((16, 32, 64, 128), 2**12, 2)
    assert make_levels(3, 4, 64, n_rows=2, n_features=1).resolutions == (4, 16, 64)
    assert make_levels(1, 5, 99, n_rows=2, n_features=1).resolutions == (5,)
    table = make_table(make_levels(2, 4, 8, n_rows=16, n_features=3), np.random.default_rng(0))
    assert table.shape == (2, 16, 3) and 0 < np.abs(table).max() <= 1e-4


def test_rows_of_vertices_by_hand():
    """A level of 3 cells has 4^3 = 64 vertices; with 65 rows they are counted, with 32 hashed."""
    vertices = np.array([[1, 2, 3], [3, 0, 0]])
    assert vertex_rows(vertices, 3, 64).tolist() == [1 + 4 * (2 + 4 * 3), 3]
    expected = [(1 ^ (2 * 2654435761 % 2**32) ^ (3 * 805459861 % 2**32)) % 32, 3]
    assert vertex_rows(vertices, 3, 32).tolist() == expected


def test_a_linear_function_is_interpolated_exactly(networks, rng):
    """Features that are x + 10 y + 100 z at the vertices are so between them; outside, they are those of the face."""
    levels = Levels((3, 4), 5**3, 1)
    table = np.zeros((2, 5**3, 1))
    for level, n in enumerate(levels.resolutions):
        i, j, k = np.meshgrid(*[np.arange(n + 1)] * 3, indexing="ij")
        table[level, i + (n + 1) * (j + (n + 1) * k), 0] = (i + 10 * j + 100 * k) / n
    x = np.concatenate([rng.uniform(size=(20, 3)), [[0, 0, 0], [1, 1, 1], [-0.5, 0.5, 1.5]]])
    expected = np.clip(x, 0, 1) @ [1, 10, 100]
    assert_allclose(networks.hash_grid(table, x, levels), np.stack([expected] * 2, axis=1), rtol=CLOSED_FORM)


def test_gradients_of_table_and_points(networks, rng):
    """The second level has 11^3 vertices in 16 rows: many share one."""
    levels = Levels((2, 10), 2**4, 2)
    table, x = rng.normal(size=(2, 2**4, 2)), rng.uniform(-0.1, 1.1, size=(30, 3))
    assert ((x < 0) | (x > 1)).any(axis=1).sum() > 5
    v = rng.normal(size=(30, 4))
    found = networks.hash_grid_vjp(table, x, levels, v)
    check_gradient(lambda: networks.hash_grid(table, x, levels), [table, x], found, v, rng)


# Kernels beside NumPy


def everything(networks, dtype, n=700):
    """All results on random data, in a list."""
    rng = np.random.default_rng(7)
    network = tuple(Layer(*(a.astype(dtype) for a in layer)) for layer in make_network((20, 33, 9), rng))
    x, v_y = rng.normal(size=(n, 20)).astype(dtype), rng.normal(size=(n, 9)).astype(dtype)
    y, tape = networks.forward(network, x, 0.01)
    gradient, v_x = networks.forward_vjp(network, tape, v_y, 0.01)
    places, v = rng.uniform(size=(n, 3)).astype(dtype), rng.normal(size=(n, 24)).astype(dtype)
    levels = Levels((5, 40), 2**8, 12)
    table = rng.normal(size=(2, 2**8, 12)).astype(dtype)
    return [
        *(y, v_x, *(array for layer in gradient for array in layer)),
        *(networks.fourier(places, 4), networks.fourier_vjp(places, 4, v)),
        *(networks.hash_grid(table, places, levels), *networks.hash_grid_vjp(table, places, levels, v)),
    ]


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, PARITY_FLOAT64), (np.float32, PARITY_FLOAT32_GRADIENT)])
def test_kernels_agree_with_numpy(dtype, tolerance):
    for found, expected in zip(everything(COMPILED, dtype), everything(IN_NUMPY, dtype), strict=True):
        assert found.dtype == expected.dtype == dtype
        assert np.abs(found - expected).max() < tolerance * np.abs(expected).max()


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
def test_same_bytes_at_any_number_of_threads():
    n_threads = numba.get_num_threads()
    try:
        results = []
        for n in (1, numba.config.NUMBA_NUM_THREADS):
            numba.set_num_threads(n)
            results.append([array.tobytes() for array in everything(COMPILED, np.float32, n=5000)])
    finally:
        numba.set_num_threads(n_threads)
    assert results[0] == results[1]


def test_a_backend_chooses(backend):
    assert networks_for(backend) is (COMPILED if backend.is_compiled else IN_NUMPY)
