"""The Fourier encoding of :mod:`.fourier` as kernels: the same functions, compiled."""

import math

import numpy as np

from minisplat_ref.jit.compile import kernel, prange, scalar
from minisplat_ref.types import Floats


@scalar
def _angle(number, octave, pi, two):
    turns = number * octave
    return pi * (turns - two * np.rint(turns / two))


@kernel()
def _encode_rows(
    x,  # [B, D]
    octaves,  # [K] 2^k
    pi_two,  # pi and 2 in the dtype of x
    gamma,  # [B, D, 2 K]
):
    n = octaves.size
    for row in prange(x.shape[0]):
        for i in range(x.shape[1]):
            for k in range(n):
                angle = _angle(x[row, i], octaves[k], pi_two[0], pi_two[1])
                gamma[row, i, k], gamma[row, i, n + k] = math.sin(angle), math.cos(angle)


@kernel()
def _encode_rows_back(
    x,  # [B, D]
    octaves,  # [K]
    pi_two,
    v_gamma,  # [B, D, 2 K]
    v_x,  # [B, D]
):
    n = octaves.size
    for row in prange(x.shape[0]):
        for i in range(x.shape[1]):
            total = v_x[row, i]
            for k in range(n):
                angle = _angle(x[row, i], octaves[k], pi_two[0], pi_two[1])
                v_angle = math.cos(angle) * v_gamma[row, i, k] - math.sin(angle) * v_gamma[row, i, n + k]
                total += pi_two[0] * octaves[k] * v_angle
            v_x[row, i] = total


def encode(x: Floats, n_octaves: int) -> Floats:
    """Return gamma [B, 2 K D]; see :func:`minisplat_ref.mechanisms.networks.fourier.encode`."""
    gamma = np.empty((*x.shape, 2 * n_octaves), x.dtype)
    _encode_rows(x, *_constants(x, n_octaves), gamma)
    return gamma.reshape(len(x), 2 * n_octaves * x.shape[1])


def encode_vjp(x: Floats, n_octaves: int, v_gamma: Floats) -> Floats:
    """Gradient of :func:`encode`; see :func:`minisplat_ref.mechanisms.networks.fourier.encode_vjp`."""
    v_x = np.zeros_like(x)
    _encode_rows_back(x, *_constants(x, n_octaves), v_gamma.reshape(*x.shape, 2 * n_octaves), v_x)
    return v_x


def _constants(x: Floats, n_octaves: int) -> tuple[Floats, Floats]:
    return (2.0 ** np.arange(n_octaves)).astype(x.dtype), np.array([np.pi, 2.0]).astype(x.dtype)
