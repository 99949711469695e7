"""The gradients of the layers of features: convolution, maximum of windows, halving.

The forward functions of the first two are :func:`~minisplat_ref.metrics.lpips.convolve` and
:func:`~minisplat_ref.metrics.lpips.max_pool`.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from minisplat_ref.types import Floats

BINOMIAL = np.array([1, 4, 6, 4, 1]) / 16
"""A blur that halving needs so as not to alias."""
HALVING_SIDE = len(BINOMIAL)


def convolve_vjp(shape: tuple[int, int], weight: Floats, stride: int, padding: int, v_y: Floats) -> Floats:
    """Gradient of a convolution with respect to its input.

    From ``y_ijk = b_k + sum_cuv w_kcuv x_c(s i + u - p, s j + v - p)`` follows, filter pixel by filter pixel::

        dL/dx_c(s i + u - p, s j + v - p) += sum_k w_kcuv v_y_ijk

    Parameters
    ----------
    shape : (H, W)
        Of the input.
    weight : ndarray of shape (K, C, size, size)
        Filters w.
    stride, padding : int
        s and p, pixels.
    v_y : ndarray of shape (H', W', K)

    Returns
    -------
    v_x : ndarray of shape (H, W, C)
    """
    (height, width), (rows, columns) = shape, v_y.shape[:2]
    n_channels, size = weight.shape[1], weight.shape[2]
    v_x = np.zeros((height + 2 * padding, width + 2 * padding, n_channels), v_y.dtype)
    for u in range(size):
        for v in range(size):
            part = v_x[u : u + stride * rows : stride, v : v + stride * columns : stride]
            part += v_y @ weight[:, :, u, v]
    return v_x[padding : padding + height, padding : padding + width]


def max_pool_vjp(x: Floats, size: int, stride: int, v_y: Floats) -> Floats:
    """Gradient of :func:`minisplat_ref.metrics.lpips.max_pool`: each window passes v_y on to its first largest pixel.

    Parameters
    ----------
    x : ndarray of shape (H, W, C)
        Input of the forward function.
    size, stride : int
        Of the windows, pixels.
    v_y : ndarray of shape (H', W', C)
    """
    windows = sliding_window_view(x, (size, size), axis=(0, 1))[::stride, ::stride]  # [H', W', C, size, size]
    chosen = windows.reshape(*windows.shape[:3], size * size).argmax(axis=3)  # [H', W', C]
    rows, columns, channels = np.indices(chosen.shape, sparse=True)
    v_x = np.zeros_like(x)
    np.add.at(v_x, (stride * rows + chosen // size, stride * columns + chosen % size, channels), v_y)
    return v_x


def halve(image: Floats) -> Floats:
    """Return an image of half the size: blurred by :data:`BINOMIAL` both ways, then every second pixel.

    ``y(i, j) = sum_uv b_u b_v x(2 i + u, 2 j + v)``, only where the whole blur is inside: n pixels become (n - 3) // 2.

    Parameters
    ----------
    image : ndarray of shape (H, W, C)
    """
    for axis in (0, 1):
        n = (image.shape[axis] - HALVING_SIDE) // 2 + 1
        taps = (np.take(image, np.arange(u, u + 2 * n - 1, 2), axis) for u in range(HALVING_SIDE))
        image = sum(
            (image.dtype.type(b) * tap for b, tap in zip(BINOMIAL, taps, strict=True)), np.zeros((), image.dtype)
        )
    return image


def halve_vjp(shape: tuple[int, int], v_y: Floats) -> Floats:
    """Gradient of :func:`halve`: ``dL/dx(2 i + u, 2 j + v) += b_u b_v v_y(i, j)``, one axis after the other.

    Parameters
    ----------
    shape : (H, W)
        Of the input.
    v_y : ndarray of shape (H', W', C)
    """
    for axis in (1, 0):
        v_x = np.zeros((*v_y.shape[:axis], shape[axis], *v_y.shape[axis + 1 :]), v_y.dtype)
        n = v_y.shape[axis]
        for u, b in enumerate(BINOMIAL):
            into = (slice(None),) * axis + (slice(u, u + 2 * n - 1, 2),)
            v_x[into] += v_y.dtype.type(b) * v_y
        v_y = v_x
    return v_y
