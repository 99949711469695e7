"""The multilayer perceptron of :mod:`.mlp` as kernels: the same functions, compiled.

Rows are taken in blocks that stay in the cache through all layers, forward and back; the forward pass is computed again
for the gradient instead of stored. Widths are padded with zeros to multiples of 16. That changes nothing: the ReLU of 0
is 0, and so is the product of anything with a weight of 0.

All three products are sums of four rows by sixteen columns at a time, in a fixed order. The gradient of the weights is
a sum over rows, in ``N_CHUNKS`` chunks whatever the number of threads, which are then added one after the other.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.jit.lanes import WIDTH, load, store
from minisplat_ref.types import Floats, Ints

N_CHUNKS = 32
BLOCK = 64  # rows, a multiple of 4
COLUMNS = 2 * WIDTH  # two lanes: with four rows, as many sums as keep both multipliers busy


class Padded(NamedTuple):
    """A network as flat arrays."""

    widths: Ints
    """[L + 1] numbers per row before and after each layer, multiples of ``COLUMNS``."""
    weights: Floats
    """All W_l [widths[l], widths[l + 1]], one after the other."""
    transposed: Floats
    """All W_l^T, at the same places."""
    biases: Floats
    """All b_l."""
    slope: Any
    """Of the leaky ReLU, in the dtype of the weights."""


class Matrix(NamedTuple):
    """A matrix in a flat array: entry (i, j) is at ``start + i row + j column``."""

    numbers: Floats
    start: int
    row: int
    column: int


@scalar
def _add_to_row(sums, number, lanes):
    """Return two sums, each with a number times its lanes added."""
    return sums[0] + number * lanes[0], sums[1] + number * lanes[1]


@scalar
def _add_product(
    out,  # Matrix [M, N], whose column stride is 1
    left,  # Matrix [M, K]
    right,  # Matrix [K, N], whose column stride is 1
    shape,  # M, a multiple of 4; K; N, a multiple of COLUMNS
):
    """Add ``left right`` to ``out``; each entry is a sum over k in ascending order."""
    m, n_inner, n = shape
    a, b, c = left.numbers, right.numbers, out.numbers
    for i in range(0, m, 4):
        first = left.start + i * left.row
        for j in range(0, n, COLUMNS):
            at0 = out.start + i * out.row + j
            at1, at2, at3 = at0 + out.row, at0 + 2 * out.row, at0 + 3 * out.row
            row0 = load(c, at0), load(c, at0 + WIDTH)
            row1 = load(c, at1), load(c, at1 + WIDTH)
            row2 = load(c, at2), load(c, at2 + WIDTH)
            row3 = load(c, at3), load(c, at3 + WIDTH)
            for k in range(n_inner):
                place, of_right = first + k * left.column, right.start + k * right.row + j
                lanes = load(b, of_right), load(b, of_right + WIDTH)
                row0 = _add_to_row(row0, a[place], lanes)
                row1 = _add_to_row(row1, a[place + left.row], lanes)
                row2 = _add_to_row(row2, a[place + 2 * left.row], lanes)
                row3 = _add_to_row(row3, a[place + 3 * left.row], lanes)
            store(c, at0, row0)
            store(c, at1, row1)
            store(c, at2, row2)
            store(c, at3, row3)


@scalar
def _load_rows(buffer, start, width, rows, begin, end):
    """Copy rows [begin, end) of an array [B, D] into a block [BLOCK, width], zero where there are none."""
    n = rows.shape[1]
    for i in range(BLOCK):
        for j in range(width):
            is_there = begin + i < end and j < n
            buffer[start + i * width + j] = rows[begin + i, j] if is_there else 0


@scalar
def _run_layers(h, starts, network):
    """Compute the layers of a block from its input; the last without ReLU.

    ``h`` holds h_l at ``starts[l]``, the input at the first.
    """
    widths = network.widths
    n_layers = widths.size - 1
    weight, bias = 0, 0
    for layer in range(n_layers):
        n, m = widths[layer], widths[layer + 1]
        for i in range(BLOCK):
            for j in range(m):
                h[starts[layer + 1] + i * m + j] = network.biases[bias + j]
        left, right = Matrix(h, starts[layer], n, 1), Matrix(network.weights, weight, m, 1)
        _add_product(Matrix(h, starts[layer + 1], m, 1), left, right, (BLOCK, n, m))
        if layer < n_layers - 1:
            for i in range(starts[layer + 1], starts[layer + 2]):
                h[i] = max(h[i], network.slope * h[i])
        weight += n * m
        bias += m


@scalar
def _starts_of(widths):
    """Return where the blocks of numbers before, between and after the layers begin, and the end."""
    starts = np.zeros(widths.size + 1, np.int64)
    for layer in range(widths.size):
        starts[layer + 1] = starts[layer] + BLOCK * widths[layer]
    return starts


@kernel()
def _forward_rows(
    network,  # Padded
    x,  # [B, inputs]
    y,  # [B, outputs]
):
    starts = _starts_of(network.widths)
    n_blocks = (x.shape[0] + BLOCK - 1) // BLOCK
    for chunk in prange(N_CHUNKS):
        h = np.empty(starts[-1], x.dtype)
        for block in range(n_blocks * chunk // N_CHUNKS, n_blocks * (chunk + 1) // N_CHUNKS):
            begin, end = block * BLOCK, min(x.shape[0], (block + 1) * BLOCK)
            _load_rows(h, 0, network.widths[0], x, begin, end)
            _run_layers(h, starts, network)
            for row in range(begin, end):
                for j in range(y.shape[1]):
                    y[row, j] = h[starts[-2] + (row - begin) * network.widths[-1] + j]


@scalar
def _back_through(v, w, h_start, h, at, network):
    """Add the gradient of one layer to that of the weights; return nothing, ``v`` becomes that of the layer's input.

    ``at`` is the layer, its weights' place, its biases' place and the arrays of their gradients.
    """
    layer, weight, bias, v_weights, v_biases = at
    n, m = network.widths[layer], network.widths[layer + 1]
    for i in range(BLOCK):
        for j in range(m):
            v_biases[bias + j] += v[i * m + j]
    _add_product(Matrix(v_weights, weight, m, 1), Matrix(h, h_start, 1, n), Matrix(v, 0, m, 1), (n, BLOCK, m))
    w[: BLOCK * n] = 0
    _add_product(Matrix(w, 0, n, 1), Matrix(v, 0, m, 1), Matrix(network.transposed, weight, n, 1), (BLOCK, m, n))
    for i in range(BLOCK * n):
        is_kept = layer == 0 or h[h_start + i] > 0
        v[i] = w[i] if is_kept else network.slope * w[i]


@kernel()
def _backward_rows(
    network,  # Padded
    x,  # [B, inputs]
    v_y,  # [B, outputs]
    v_x,  # [B, inputs]
    v_weights,  # [N_CHUNKS, all weights], zeros
    v_biases,  # [N_CHUNKS, all biases], zeros
):
    starts = _starts_of(network.widths)
    n_layers = network.widths.size - 1
    n_blocks = (x.shape[0] + BLOCK - 1) // BLOCK
    for chunk in prange(N_CHUNKS):
        h = np.empty(starts[-1], x.dtype)
        v, w = np.empty(BLOCK * network.widths.max(), x.dtype), np.empty(BLOCK * network.widths.max(), x.dtype)
        for block in range(n_blocks * chunk // N_CHUNKS, n_blocks * (chunk + 1) // N_CHUNKS):
            begin, end = block * BLOCK, min(x.shape[0], (block + 1) * BLOCK)
            _load_rows(h, 0, network.widths[0], x, begin, end)
            _run_layers(h, starts, network)
            _load_rows(v, 0, network.widths[-1], v_y, begin, end)
            weight, bias = network.weights.size, network.biases.size
            for k in range(n_layers):
                layer = n_layers - 1 - k
                weight -= network.widths[layer] * network.widths[layer + 1]
                bias -= network.widths[layer + 1]
                at = (layer, weight, bias, v_weights[chunk], v_biases[chunk])
                _back_through(v, w, starts[layer], h, at, network)
            for row in range(begin, end):
                for j in range(x.shape[1]):
                    v_x[row, j] = v[(row - begin) * network.widths[0] + j]


def forward(network: Any, x: Floats, slope: float = 0.0) -> tuple[Floats, list[Floats]]:
    """Return y [B, outputs] and the tape; see :func:`minisplat_ref.mechanisms.networks.mlp.forward`."""
    y = np.empty((len(x), network[-1].weights.shape[1]), x.dtype)
    _forward_rows(_padded(network, slope), x, y)
    return y, [x]


def forward_vjp(network: Any, inputs: list[Floats], v_y: Floats, slope: float = 0.0) -> tuple[Any, Floats]:
    """Gradient of :func:`forward`; see :func:`minisplat_ref.mechanisms.networks.mlp.forward_vjp`."""
    x, padded = inputs[0], _padded(network, slope)
    v_x = np.empty_like(x)
    v_weights = np.zeros((N_CHUNKS, padded.weights.size), x.dtype)
    v_biases = np.zeros((N_CHUNKS, padded.biases.size), x.dtype)
    _backward_rows(padded, x, v_y, v_x, v_weights, v_biases)
    return _unpadded(network, padded.widths, _sum_in_order(v_weights), _sum_in_order(v_biases)), v_x


def _sum_in_order(parts: Floats) -> Floats:
    """Return the sum over the first axis, of one after the other."""
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def _padded(network: Any, slope: float) -> Padded:
    shapes = [layer.weights.shape for layer in network]
    widths = np.array([shapes[0][0], *(shape[1] for shape in shapes)])
    widths = -(-widths // COLUMNS) * COLUMNS
    weights, transposed, biases = [], [], []
    for k, layer in enumerate(network):
        whole = np.zeros((widths[k], widths[k + 1]), layer.weights.dtype)
        whole[: shapes[k][0], : shapes[k][1]] = layer.weights
        weights.append(whole.ravel())
        transposed.append(whole.T.ravel())
        biases.append(np.pad(layer.biases, (0, widths[k + 1] - shapes[k][1])))
    dtype = network[0].weights.dtype
    return Padded(
        widths, np.concatenate(weights), np.concatenate(transposed), np.concatenate(biases), dtype.type(slope)
    )


def _unpadded(network: Any, widths: Ints, weights: Floats, biases: Floats) -> Any:
    layers, weight, bias = [], 0, 0
    for k, layer in enumerate(network):
        n, m = layer.weights.shape
        whole = weights[weight : weight + widths[k] * widths[k + 1]].reshape(widths[k], widths[k + 1])
        layers.append(type(layer)(np.ascontiguousarray(whole[:n, :m]), biases[bias : bias + m].copy()))
        weight, bias = weight + whole.size, bias + widths[k + 1]
    return tuple(layers)
