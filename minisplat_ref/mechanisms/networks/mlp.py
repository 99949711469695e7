"""A multilayer perceptron in NumPy: forward, its gradient, and training on pairs by Adam.

With the layers' weights W_l and biases b_l and the leaky ReLU ``r(x) = max(x, s x)`` of slope ``0 <= s < 1``, which at
0 is the ReLU::

    h_0 = x,   h_{l+1} = r(h_l W_l + b_l),   y = h_{L-1} W_{L-1} + b_{L-1}

:mod:`.mlp_kernels` is the compiled twin. Here matrix products are BLAS's, so the last digits may depend on how many
threads it takes; there they do not.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.reference.adam import adam_update
from minisplat_ref.types import AdamStep, Floats

BETA1, BETA2, EPS = 0.9, 0.999, 1e-8  # of Adam, as published


class Layer(NamedTuple):
    """One layer."""

    weights: Floats
    """[inputs, outputs] W."""
    biases: Floats
    """[outputs] b."""


Network = tuple[Layer, ...]


def make_network(sizes: tuple[int, ...], rng: np.random.Generator) -> Network:
    """Return a network of random weights of variance 2 / inputs (He et al. 2015), and biases of 0.

    Parameters
    ----------
    sizes : tuple of int
        Inputs, hidden layers, outputs.
    rng : Generator
    """
    return tuple(Layer(rng.normal(size=(n, m)) * np.sqrt(2 / n), np.zeros(m)) for n, m in pairwise(sizes))


def forward(network: Network, x: Floats, slope: float = 0.0) -> tuple[Floats, list[Floats]]:
    """Return y [B, outputs] for x [B, inputs], and the inputs h_l of all layers for :func:`forward_vjp`.

    ``slope`` is that of the leaky ReLU; 0 for the ReLU.
    """
    inputs = []
    for layer in network[:-1]:
        inputs.append(x)
        x = x @ layer.weights + layer.biases
        x = np.maximum(x, x.dtype.type(slope) * x)
    return x @ network[-1].weights + network[-1].biases, [*inputs, x]


def forward_vjp(network: Network, inputs: list[Floats], v_y: Floats, slope: float = 0.0) -> tuple[Network, Floats]:
    """Gradient of :func:`forward` with respect to the network and to x.

    ::

        v_W_l = h_l^T v,   v_b_l = sum over rows of v,   v_h_l = v W_l^T
        v     = v_y in the last layer; below, v_h_{l+1} where h_{l+1} > 0, and s v_h_{l+1} elsewhere

    Parameters
    ----------
    network : Network
    inputs : list of ndarray
        From :func:`forward`.
    v_y : ndarray of shape (B, outputs)
        Derivative with respect to y.
    slope : float
        s, as in :func:`forward`.
    """
    v, gradients = v_y, []
    for k in range(len(network) - 1, -1, -1):
        gradients.append(Layer(inputs[k].T @ v, v.sum(axis=0)))
        v = v @ network[k].weights.T
        if k > 0:
            v = np.where(inputs[k] > 0, v, v.dtype.type(slope) * v)
    return tuple(reversed(gradients)), v


def to_shared(name: str, network: Network) -> dict[str, Floats]:
    """Return the arrays of a network as shared parameters: ``NAME_weights_0``, ``NAME_biases_0``, and so on."""
    return {
        f"{name}_{kind}_{k}": array
        for k, layer in enumerate(network)
        for kind, array in zip(Layer._fields, layer, strict=True)
    }


def from_shared(name: str, shared: Mapping[str, Floats]) -> Network:
    """Return the network of that name from shared parameters; one without layers if there is none."""
    layers: list[Layer] = []
    while f"{name}_weights_{len(layers)}" in shared:
        k = len(layers)
        layers.append(Layer(shared[f"{name}_weights_{k}"], shared[f"{name}_biases_{k}"]))
    return tuple(layers)


def network_rates(name: str, n_layers: int, rate: Any) -> dict[str, Any]:
    """Return one learning rate, a number or a schedule, for all arrays of a network, by their shared names."""
    return {f"{name}_{kind}_{k}": rate for k in range(n_layers) for kind in Layer._fields}


def train_step(network: Network, x: Floats, y: Floats, rate: float, moments: list[Floats], step: int) -> float:
    """Take one step of Adam on the mean squared error of a batch, in place; return the error before it.

    Parameters
    ----------
    network : Network
    x, y : ndarray of shape (B, inputs) and (B, outputs)
        Inputs and the outputs that they should map to.
    rate : float
        Learning rate.
    moments : list of ndarray
        From :func:`zero_moments`.
    step : int
        Counted from 1.
    """
    found, inputs = forward(network, x)
    error = found - y
    gradients, _ = forward_vjp(network, inputs, 2 * error / error.size)
    correction = np.sqrt(1 - BETA2**step)
    how = AdamStep(rate * correction / (1 - BETA1**step), BETA1, BETA2, EPS * correction)
    flat = [array for layer in network for array in layer]
    v_flat = [array for layer in gradients for array in layer]
    for k, (array, v) in enumerate(zip(flat, v_flat, strict=True)):
        values, gradient, first, second = (np.atleast_2d(a) for a in (array, v, *moments[2 * k : 2 * k + 2]))  # views
        adam_update(values, gradient, first, second, None, how)
    return float(np.mean(error**2))


def zero_moments(network: Network) -> list[Floats]:
    """Return zeros for the two moments of every array of weights and biases."""
    return [np.zeros_like(array) for layer in network for array in layer for _ in range(2)]
