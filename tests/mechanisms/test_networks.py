"""Networks: one layer by hand, gradients against differences, and learning a function that is known."""

import numpy as np
from numpy.testing import assert_allclose

from minisplat_ref.mechanisms.networks.mlp import Layer, forward, forward_vjp, make_network, train_step, zero_moments
from tolerances import CLOSED_FORM, GRADIENT_REL, GRADIENT_STEP


def test_two_layers_by_hand():
    network = (
        Layer(np.array([[1.0, -1.0], [2.0, 0.5]]), np.array([0.5, 0.0])),
        Layer(np.array([[2.0], [3.0]]), np.array([-1.0])),
    )
    y, inputs = forward(network, np.array([[1.0, 1.0], [-1.0, 0.0]]))
    # Hidden: (1 + 2 + 0.5, relu(-1 + 0.5)) and (relu(-1 + 0.5), 1).
    assert_allclose(inputs[1], [[3.5, 0], [0, 1]], rtol=CLOSED_FORM)
    assert_allclose(y, [[6.0], [2.0]], rtol=CLOSED_FORM)


def test_gradients_of_weights_biases_and_input(rng):
    network, x = make_network((3, 5, 4, 2), rng), rng.normal(size=(7, 3))
    network = tuple(Layer(layer.weights, rng.normal(size=layer.biases.shape)) for layer in network)
    v = rng.normal(size=(7, 2))
    gradients, v_x = forward_vjp(network, forward(network, x)[1], v)
    arrays = [*(array for layer in network for array in layer), x]
    found = [*(array for layer in gradients for array in layer), v_x]
    for array, got in zip(arrays, found, strict=True):
        direction = rng.normal(size=array.shape)

        def value(step, array=array, direction=direction):
            array += step * direction
            result = np.sum(v * forward(network, x)[0])
            array -= step * direction
            return result

        difference = (value(GRADIENT_STEP) - value(-GRADIENT_STEP)) / (2 * GRADIENT_STEP)
        assert abs(difference) > 1e-2
        assert_allclose(np.sum(got * direction), difference, rtol=GRADIENT_REL)


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
