"""The curve between linear light and sRGB (IEC 61966-2-1), without an upper limit.

A photograph ends at 1; brighter colours keep their gradient here, so that they can become darker.
"""

import numpy as np

from minisplat_ref.types import Floats

KNEE = 0.0031308  # below it the curve is a line


def encode_srgb(linear: Floats) -> Floats:
    """Return ``12.92 x`` up to the knee, and ``1.055 x^(1 / 2.4) - 0.055`` beyond."""
    bright = np.maximum(linear, KNEE)
    return np.where(linear <= KNEE, 12.92 * linear, 1.055 * bright ** (1 / 2.4) - 0.055).astype(linear.dtype)


def encode_srgb_vjp(linear: Floats, v_encoded: Floats) -> Floats:
    """Gradient of :func:`encode_srgb`: ``12.92 v`` up to the knee, ``1.055 / 2.4 x^(1 / 2.4 - 1) v`` beyond."""
    slope = np.where(linear <= KNEE, 12.92, 1.055 / 2.4 * np.maximum(linear, KNEE) ** (1 / 2.4 - 1))
    return (slope * v_encoded).astype(linear.dtype)


def decode_srgb(encoded: Floats) -> Floats:
    """Return linear values of sRGB ones in [0, 1]: the inverse of :func:`encode_srgb`."""
    return np.where(encoded <= 12.92 * KNEE, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
