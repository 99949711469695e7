"""LPIPS: the distance of two images in the features of a network for recognising objects (Zhang et al., CVPR 2018).

Equation (1) of the paper, for images x and x0, layers l and pixels h, w of a layer::

    d(x, x0) = sum_l 1 / (H_l W_l) sum_hw || w_l * (y_lhw - y0_lhw) ||^2

y_l [H_l, W_l, C_l] are the features of a layer after its ReLU, each pixel's vector divided by its length; w_l [C_l]
weights the channels. Files hold the squares of w_l, as the heads ``lin0`` to ``lin4``, each a convolution of 1 x 1
pixel over the squared differences. Equal images have distance 0.

The network takes colours from -1 to 1, and first shifts and scales each channel. **The evaluation released with 3DGS
gives other figures**: it shifts and scales colours from 0 to 1 by the same numbers. gsplat's example trainer follows it
with VGG16, on purpose, but not with AlexNet. :func:`lpips` maps [0, 1] to [-1, 1] first, as its authors recommend; for
3DGS's figure, call it with ``(1 + image) / 2`` and ``(1 + target) / 2``, of images rounded to 8 bits.

The user provides the weights: a file of the state dict of the package ``lpips``, which :data:`HOW_TO_MAKE` makes. The
dtype is that of the image, so usually float32, in which the networks were trained and published figures are computed.
VGG16 takes 204 MB for 480 x 270 pixels, and proportionally more for more. Left out: SqueezeNet, version 0.0 of the
weights, gradients, splitting large images into parts.
"""

import zipfile
import zlib
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.types import Bools, Floats, Ints, View
from minisplat_ref.validation import check_finite

HOW_TO_MAKE = (
    """python -c "import lpips, numpy; numpy.savez('vgg.npz', **lpips.LPIPS(net='vgg').state_dict())" """
    "where the package lpips is installed (net='alex' is smaller and faster)"
)

# For colours from -1 to 1: 2 mean - 1 and 2 std of ImageNet's colours, rounded to three digits as in the package.
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)

LENGTH_MIN = 1e-10  # added to the length of a pixel's features, which may all be zero
WINDOW_BYTES = 1 << 25  # size of the copied windows of a convolution; more at once is not faster


class Convolution(NamedTuple):
    """A convolution followed by a ReLU."""

    key: str
    """KEY in the names of its arrays in the file: ``net.KEY.weight`` [K, C, size, size], ``net.KEY.bias`` [K]."""
    n_in: int
    """Channels C of its input."""
    n_out: int
    """Number K of its filters."""
    size: int = 3
    """Height and width of a filter, pixels."""
    stride: int = 1
    """Distance of neighbouring windows, pixels."""
    padding: int = 1
    """Zeros beyond each border, pixels."""


class MaxPool(NamedTuple):
    """The largest value in each window."""

    size: int
    """Height and width of a window, pixels."""
    stride: int = 2
    """Distance of neighbouring windows, pixels."""


class Backbone(NamedTuple):
    """A network without its weights."""

    name: str
    slices: tuple[tuple[Convolution | MaxPool, ...], ...]
    """Layers in order; each slice ends with a convolution, whose features are compared."""


VGG16 = Backbone(
    "VGG16",
    (
        (Convolution("slice1.0", 3, 64), Convolution("slice1.2", 64, 64)),
        (MaxPool(2), Convolution("slice2.5", 64, 128), Convolution("slice2.7", 128, 128)),
        (MaxPool(2), Convolution("slice3.10", 128, 256), *(Convolution(f"slice3.{i}", 256, 256) for i in (12, 14))),
        (MaxPool(2), Convolution("slice4.17", 256, 512), *(Convolution(f"slice4.{i}", 512, 512) for i in (19, 21))),
        (MaxPool(2), *(Convolution(f"slice5.{i}", 512, 512) for i in (24, 26, 28))),
    ),
)
ALEXNET = Backbone(
    "AlexNet",
    (
        (Convolution("slice1.0", 3, 64, size=11, stride=4, padding=2),),
        (MaxPool(3), Convolution("slice2.3", 64, 192, size=5, padding=2)),
        (MaxPool(3), Convolution("slice3.6", 192, 384)),
        (Convolution("slice4.8", 384, 256),),
        (Convolution("slice5.10", 256, 256),),
    ),
)
BACKBONES = (VGG16, ALEXNET)


class Network(NamedTuple):
    """A backbone with weights."""

    backbone: Backbone
    weights: Mapping[str, Floats]
    """Arrays by their names in the file, of the file's shapes."""


def load_network(path: str | Path) -> Network:
    """Read a network's weights; the shape of its first filters tells VGG16 from AlexNet.

    Parameters
    ----------
    path : str or Path
        An .npz of the state dict of ``lpips.LPIPS``; see :data:`HOW_TO_MAKE`. Other arrays in it do not matter.

    Raises
    ------
    InputError
        The file is missing or no .npz, or an array is missing, has another shape or type, or is not finite.
    """
    arrays = _read_arrays(path)
    first = next(iter(expected_shapes(VGG16)))
    shapes = {backbone.name: expected_shapes(backbone)[first] for backbone in BACKBONES}
    backbone = next((b for b in BACKBONES if first in arrays and arrays[first].shape == shapes[b.name]), None)
    if backbone is None:
        known = " or ".join(f"{shape} ({name})" for name, shape in shapes.items())
        raise InputError(f"{path}: {_wrong(arrays, first)}, expected {known}; make it so: {HOW_TO_MAKE}")
    for name, shape in expected_shapes(backbone).items():
        if name not in arrays or arrays[name].shape != shape or arrays[name].dtype.kind != "f":
            raise InputError(
                f"{path}: {_wrong(arrays, name)}, expected floats of shape {shape} ({backbone.name});"
                f" make it so: {HOW_TO_MAKE}"
            )
        check_finite(f"{path}: {name}", arrays[name])
    return Network(backbone, {name: arrays[name] for name in expected_shapes(backbone)})


def expected_shapes(backbone: Backbone) -> dict[str, tuple[int, ...]]:
    """Return the names and shapes of the arrays that a network needs, the filters of the first layer first."""
    shapes: dict[str, tuple[int, ...]] = {}
    for i, layers in enumerate(backbone.slices):
        for layer in layers:
            if isinstance(layer, Convolution):
                weight, bias = _names(layer)
                shapes[weight] = (layer.n_out, layer.n_in, layer.size, layer.size)
                shapes[bias] = n_out = (layer.n_out,)
        shapes[_head(i)] = (1, *n_out, 1, 1)  # the channels of the slice's last convolution
    return shapes


def _names(layer: Convolution) -> tuple[str, str]:
    return f"net.{layer.key}.weight", f"net.{layer.key}.bias"


def _head(i: int) -> str:
    return f"lin{i}.model.1.weight"  # model.0 is the dropout of its training


def _read_arrays(path: str | Path) -> dict[str, NDArray]:
    """Return the arrays of an .npz that some network needs."""
    names = {name for backbone in BACKBONES for name in expected_shapes(backbone)}
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:  # a .npy is a TypeError here
            return {name: np.asarray(archive[name]) for name in names & set(archive)}
    except FileNotFoundError:
        raise InputError(
            f"{path}: no such file; say with --lpips-weights where the weights of LPIPS are now, or make them again:"
            f" {HOW_TO_MAKE}"
        ) from None
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: not a readable .npz of arrays ({error}); make it so: {HOW_TO_MAKE}") from None


def _wrong(arrays: Mapping[str, NDArray], name: str) -> str:
    """Return the error of an array."""
    return f"{name} is {arrays[name].dtype} of shape {arrays[name].shape}" if name in arrays else f"{name} is missing"


def check_views(network: Network, views: Sequence[View]) -> None:
    """Refuse views that are too small for the network: its last layers would have no pixels.

    Raises
    ------
    InputError
    """
    for view in views:
        _check_size(network.backbone, view.camera.height, view.camera.width, f"view {view.name}")


def _check_size(backbone: Backbone, height: int, width: int, name: str) -> None:
    least = next(n for n in count(1) if _fits(backbone, n))
    if min(height, width) < least:
        raise InputError(
            f"{name} is {width} x {height} pixels, LPIPS by {backbone.name} needs {least} x {least}:"
            " give larger images, or leave the weights of LPIPS out"
        )


def _fits(backbone: Backbone, n: int) -> bool:
    """Return whether an image of n x n pixels has pixels left after every layer."""
    for layer in (layer for layers in backbone.slices for layer in layers):
        padding = layer.padding if isinstance(layer, Convolution) else 0
        if n + 2 * padding < layer.size:
            return False
        n = (n + 2 * padding - layer.size) // layer.stride + 1
    return True


def lpips(image: Floats, target: Floats | Ints, network: Network, mask: Bools | None = None) -> float:
    """Return the perceptual distance of an image from a photograph.

    Parameters
    ----------
    image, target : ndarray of shape (H, W, 3)
        In [0, 1]; the target may also be bytes, of which 255 is 1. Float32 or float64, the dtype of the computation.
    network : Network
    mask : ndarray of shape (H, W) of booleans, optional
        Pixels that count; default all. Outside, the target replaces the image before the network sees it, and the means
        over pixels are divided by the fraction that counts.

    Returns
    -------
    distance : float
        0 for equal images.

    Raises
    ------
    InputError
        The image is too small for the network, or the mask is False everywhere.
    """
    backbone, weights = network
    height, width, _ = image.shape
    _check_size(backbone, height, width, "image")
    target = target / image.dtype.type(255 if target.dtype == np.uint8 else 1)
    counted = 1.0
    if mask is not None:
        if not mask.any():
            raise InputError("mask leaves no pixel to compare: leave the view out")
        image, counted = np.where(mask[:, :, None], image, target), float(np.mean(mask))
    x, x0 = _normalize(image), _normalize(target)  # [H, W, 3]
    distance = 0.0
    for i, layers in enumerate(backbone.slices):
        x, x0 = (_apply(layers, features, weights) for features in (x, x0))  # [H_l, W_l, C_l]
        distance += _layer_distance(x, x0, weights[_head(i)].reshape(-1).astype(x.dtype))
    return distance / counted


def _normalize(image: Floats) -> Floats:
    """Return the network's input [H, W, 3] for colours in [0, 1]."""
    return (2 * image - 1 - np.array(SHIFT, image.dtype)) / np.array(SCALE, image.dtype)


def _layer_distance(y: Floats, y0: Floats, squared_w: Floats) -> float:
    """Return a layer's term of equation (1), given features [H, W, C] and the squares [C] of its w."""
    difference = _unit(y)  # [H, W, C]; in place, as this is where most memory is needed
    difference -= _unit(y0)
    np.square(difference, out=difference)
    return float(np.mean(difference @ squared_w, dtype=np.float64))


def _unit(features: Floats) -> Floats:
    """Return features [H, W, C] with each pixel's vector divided by its length."""
    lengths = np.sqrt(np.einsum("ijc,ijc->ij", features, features))  # [H, W]
    return features / (lengths + features.dtype.type(LENGTH_MIN))[:, :, None]


def _apply(layers: Sequence[Convolution | MaxPool], x: Floats, weights: Mapping[str, Floats]) -> Floats:
    """Return the features [H', W', K] after some layers."""
    for layer in layers:
        if isinstance(layer, MaxPool):
            x = max_pool(x, layer.size, layer.stride)
        else:
            weight, bias = (weights[name].astype(x.dtype, copy=False) for name in _names(layer))
            x = convolve(x, weight, bias, layer.stride, layer.padding)
            np.maximum(x, 0, out=x)  # ReLU
    return x


def convolve(x: Floats, weight: Floats, bias: Floats, stride: int, padding: int) -> Floats:
    """Return the response of every filter at every window.

    There are zeros beyond the borders, and the filter is not mirrored, as is usual for networks::

        y_ijk = b_k + sum_cuv w_kcuv x_c(s i + u - p, s j + v - p)

    Windows are copied into the rows of a matrix, a few rows of pixels at a time, so that the sum is a matrix product.

    Parameters
    ----------
    x : ndarray of shape (H, W, C)
    weight : ndarray of shape (K, C, size, size)
        Filters w.
    bias : ndarray of shape (K,)
    stride : int
        s, pixels.
    padding : int
        p, pixels.

    Returns
    -------
    y : ndarray of shape (H', W', K)
        H' = (H + 2 p - size) // s + 1, likewise W'.
    """
    n_out, _, size, _ = weight.shape
    windows = _windows(np.pad(x, ((padding, padding), (padding, padding), (0, 0))), size, stride)  # [H', W', C, u, v]
    windows = windows.transpose(0, 1, 3, 4, 2)  # [H', W', u, v, C]: contiguous runs of C numbers copy fastest
    filters = weight.transpose(2, 3, 1, 0).reshape(-1, n_out)  # [u v C, K]
    height, width = windows.shape[:2]
    y = np.empty((height, width, n_out), x.dtype)
    n_rows = max(1, WINDOW_BYTES // (width * len(filters) * x.itemsize))
    for start in range(0, height, n_rows):
        band = windows[start : start + n_rows].reshape(-1, len(filters))  # [rows W', u v C], a copy
        np.matmul(band, filters, out=y[start : start + n_rows].reshape(-1, n_out))
    y += bias
    return y


def max_pool(x: Floats, size: int, stride: int) -> Floats:
    """Return the largest value of each channel in every window.

    Parameters
    ----------
    x : ndarray of shape (H, W, C)
    size, stride : int
        Of the windows, pixels; a remainder on the right and at the bottom is ignored.

    Returns
    -------
    ndarray of shape (H', W', C)
        H' = (H - size) // stride + 1, likewise W'.
    """
    windows = _windows(x, size, stride)  # [H', W', C, u, v]
    return np.maximum.reduce([windows[..., u, v] for u in range(size) for v in range(size)])


def _windows(x: Floats, size: int, stride: int) -> Floats:
    """Return a view [H', W', C, size, size] of the windows of an image [H, W, C]."""
    return sliding_window_view(x, (size, size), axis=(0, 1))[::stride, ::stride]
