"""Features of a convolutional network with weights from the user; none are downloaded or shipped.

The file is an .npz of plain arrays, for convolutions k = 1, 2, ... in their order, each followed by a ReLU:

=================  ====================  ==========================================================================
``weight_K``       [out, in, n, n]       filters, n odd; zeros beyond the borders, so that the size stays
``bias_K``         [out]
``pool_before``    [...] whole numbers   convolutions, not the first, before which the maximum of 2 x 2 pixels is taken
``taps``           [...] whole numbers   convolutions whose output, after the ReLU, is a feature
``mean``, ``std``  [3] each, optional    colours from 0 to 1 become ``(c - mean) / std`` first
=================  ====================  ==========================================================================

Taps of one size become one map with the channels of all. VGG16's third block, which ARF and G-Style use, is
``pool_before = [3, 5]``, ``taps = [5, 6, 7]``, with ``mean = [0.485, 0.456, 0.406]``, ``std = [0.229, 0.224, 0.225]``
and seven convolutions, which :data:`HOW_TO_MAKE` writes.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.io.npz import read_npz
from minisplat_ref.mechanisms.features.bank import FeatureBank
from minisplat_ref.mechanisms.features.layers import convolve_vjp, max_pool_vjp
from minisplat_ref.metrics.lpips import convolve, max_pool
from minisplat_ref.types import Floats
from minisplat_ref.validation import check_finite

WAY_OUT = "the docstring of minisplat_ref/mechanisms/features/network.py has the layout"
HOW_TO_MAKE = """\
import numpy, torchvision
layers = torchvision.models.vgg16(weights="DEFAULT").features
convs = [layer for layer in layers if hasattr(layer, "weight")][:7]
arrays = {f"weight_{k}": conv.weight.detach().numpy() for k, conv in enumerate(convs, 1)}
arrays |= {f"bias_{k}": conv.bias.detach().numpy() for k, conv in enumerate(convs, 1)}
numpy.savez("vgg16_block3.npz", **arrays, pool_before=[3, 5], taps=[5, 6, 7],
            mean=[0.485, 0.456, 0.406], std=[0.229, 0.224, 0.225])
"""
"""Run where torchvision is installed."""


class Convolutions(NamedTuple):
    """A network of convolutions, each followed by a ReLU."""

    weights: tuple[Floats, ...]
    """[out, in, n, n] each."""
    biases: tuple[Floats, ...]
    """[out] each."""
    pool_before: frozenset[int]
    """Convolutions, counted from 1, before which the size is halved."""
    taps: frozenset[int]
    """Convolutions whose output is a feature."""
    mean: Floats
    """[3]."""
    std: Floats
    """[3]."""


class _Tape(NamedTuple):
    inputs: list[Floats]
    """Of each convolution."""
    outputs: list[Floats]
    """After each ReLU."""


def load_bank(path: str | Path) -> FeatureBank:
    """Read a network's weights as a feature bank.

    Parameters
    ----------
    path : str or Path
        An .npz; the module has its layout.

    Raises
    ------
    InputError
        The file is missing or no .npz, or an array is missing, not finite, or does not fit the others.
    """
    net = as_network(read_npz(path, WAY_OUT), str(path))
    return FeatureBank(
        f"the network of {Path(path).name}",
        partial(features, net),
        partial(features_vjp, net),
        max(1, 2 ** len(net.pool_before)),
    )


def as_network(arrays: Mapping[str, NDArray[Any]], source: str) -> Convolutions:
    """Return the network of a file's arrays.

    Raises
    ------
    InputError
        Names the array that does not fit, with ``source`` before it.
    """
    weights, biases, n_in = [], [], 3
    for k in count(1):
        weight, bias = arrays.get(f"weight_{k}"), arrays.get(f"bias_{k}")
        if weight is None and k > 1:
            break
        n_out = 0 if weight is None or weight.ndim != 4 else weight.shape[0]
        side = 0 if not n_out or weight is None else weight.shape[3]
        _expect(source, f"weight_{k}", weight, (n_out, n_in, side, side), side % 2 == 1)
        _expect(source, f"bias_{k}", bias, (n_out,))
        assert weight is not None and bias is not None, "checked"
        weights.append(weight)
        biases.append(bias)
        n_in = n_out
    mean, std = (arrays.get(name, np.full(3, usual)) for name, usual in (("mean", 0.0), ("std", 1.0)))
    _expect(source, "mean", mean, (3,))
    _expect(source, "std", std, (3,))
    if not std.all():
        raise InputError(f"{source}: std has a zero, by which colours would be divided; {WAY_OUT}")
    taps = _parse_numbers(source, "taps", arrays, 1, len(weights))
    pool_before = _parse_numbers(source, "pool_before", arrays, 2, len(weights))
    if not taps:
        raise InputError(f"{source}: taps names no convolution, so there are no features; {WAY_OUT}")
    return Convolutions(tuple(weights), tuple(biases), pool_before, taps, mean, std)


def _expect(source: str, name: str, array: NDArray[Any] | None, shape: tuple[int, ...], is_right: bool = True) -> None:
    if array is None:
        raise InputError(f"{source}: {name} is missing; {WAY_OUT}")
    if not is_right or array.shape != shape or array.dtype.kind != "f":
        known = ", ".join(str(n) if n else "n" for n in shape)
        raise InputError(f"{source}: {name} is {array.dtype} {list(array.shape)}, not floats [{known}]; {WAY_OUT}")
    check_finite(f"{source}: {name}", array)


def _parse_numbers(source: str, name: str, arrays: Mapping[str, NDArray[Any]], first: int, n: int) -> frozenset[int]:
    """Return the numbers of convolutions that an array names."""
    array = arrays.get(name)
    if array is None:
        raise InputError(f"{source}: {name} is missing; {WAY_OUT}")
    is_empty = array.size == 0
    if not is_empty and (array.dtype.kind not in "iu" or array.ndim != 1 or array.min() < first or array.max() > n):
        raise InputError(f"{source}: {name} is not a list of whole numbers from {first} to {n}; {WAY_OUT}")
    return frozenset(int(k) for k in array.ravel())


def features(net: Convolutions, image: Floats) -> tuple[list[Floats], _Tape]:
    """Return the maps [h, w, C] of an image [H, W, 3], one for each size that is tapped, and a tape."""
    dtype = image.dtype
    x: Floats = (image - net.mean.astype(dtype)) / net.std.astype(dtype)
    tape, is_new = _Tape([], []), True
    maps: list[Floats] = []
    for k, (weight, bias) in enumerate(zip(net.weights, net.biases, strict=True), 1):
        if k in net.pool_before:
            x, is_new = max_pool(x, 2, 2), True
        tape.inputs.append(x)
        x = np.maximum(convolve(x, weight.astype(dtype), bias.astype(dtype), 1, weight.shape[2] // 2), 0)
        tape.outputs.append(x)
        if k in net.taps:
            maps[len(maps) - (not is_new) :] = [x if is_new else np.concatenate([maps[-1], x], axis=2)]
            is_new = False
    return maps, tape


def features_vjp(net: Convolutions, tape: _Tape, v_maps: Sequence[Floats]) -> Floats:
    """Gradient of :func:`features`, from the last convolution to the first.

    ``v_x`` of a convolution's output is the sum from its tap and from the layers behind it, and 0 where the ReLU has
    cut off; then follow :func:`.layers.convolve_vjp`, and :func:`.layers.max_pool_vjp` where the size was halved.

    Parameters
    ----------
    net : Convolutions
    tape : of :func:`features`
    v_maps : sequence of ndarray of shape (h, w, C)

    Returns
    -------
    v_image : ndarray of shape (H, W, 3)
    """
    of_taps = _split(net, v_maps)
    v_x = np.zeros_like(tape.outputs[-1])
    for k in range(len(net.weights), 0, -1):
        weight, x, y = net.weights[k - 1].astype(v_x.dtype), tape.inputs[k - 1], tape.outputs[k - 1]
        v_y = (v_x + of_taps[k] if k in of_taps else v_x) * (y > 0)
        v_x = convolve_vjp((x.shape[0], x.shape[1]), weight, 1, weight.shape[2] // 2, v_y)
        if k in net.pool_before:
            v_x = max_pool_vjp(tape.outputs[k - 2], 2, 2, v_x)
    return v_x / net.std.astype(v_x.dtype)


def _split(net: Convolutions, v_maps: Sequence[Floats]) -> dict[int, Floats]:
    """Return the gradients of maps by the tap that made their channels."""
    found, m, start = {}, -1, 0
    is_new = True
    for k in range(1, len(net.weights) + 1):
        is_new = is_new or k in net.pool_before
        if k in net.taps:
            m, start = (m + 1, 0) if is_new else (m, start)
            n = len(net.biases[k - 1])
            found[k], start, is_new = v_maps[m][..., start : start + n], start + n, False
    return found
