"""Fourier encoding: each number as sines and cosines of octaves (NeRF, Mildenhall et al. 2020, eq. 4).

::

    gamma(x) = (sin(2^0 pi x), ..., sin(2^(K-1) pi x), cos(2^0 pi x), ..., cos(2^(K-1) pi x))

for every number of x. A product with 2^k is exact, and so is what remains after the nearest multiple of 2, the period:
so the sine of the highest octave is as good as that of the lowest, in float32, too.
"""

import numpy as np

from minisplat_ref.types import Floats


def encode(x: Floats, n_octaves: int) -> Floats:
    """Return gamma [B, 2 K D] of x [B, D]; for each number of x all sines, then all cosines.

    Parameters
    ----------
    x : ndarray of shape (B, D)
        Of period 2: numbers that differ by 2 have one encoding.
    n_octaves : int
        K.
    """
    angles = _angles(x, n_octaves)  # [B, D, K]
    return np.concatenate([np.sin(angles), np.cos(angles)], axis=2).reshape(len(x), 2 * n_octaves * x.shape[1])


def encode_vjp(x: Floats, n_octaves: int, v_gamma: Floats) -> Floats:
    """Gradient of :func:`encode` with respect to x.

    ::

        v_x = sum_k 2^k pi (cos(2^k pi x) v_sin_k - sin(2^k pi x) v_cos_k)

    Parameters
    ----------
    x, n_octaves
        As in :func:`encode`.
    v_gamma : ndarray of shape (B, 2 K D)
        Derivative with respect to the encoding.
    """
    angles = _angles(x, n_octaves)
    v_sin, v_cos = np.split(v_gamma.reshape(len(x), x.shape[1], 2 * n_octaves), 2, axis=2)
    slopes = (np.pi * 2.0 ** np.arange(n_octaves)).astype(x.dtype)
    return np.sum(slopes * (np.cos(angles) * v_sin - np.sin(angles) * v_cos), axis=2)


def _angles(x: Floats, n_octaves: int) -> Floats:
    """Return the angles [B, D, K] in [-pi, pi]."""
    turns = x[..., None] * (2.0 ** np.arange(n_octaves)).astype(x.dtype)
    return x.dtype.type(np.pi) * (turns - 2 * np.rint(turns / 2))
