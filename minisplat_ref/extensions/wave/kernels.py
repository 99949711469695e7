"""The sum over Gaussians at every frequency, for fast blending: the closed form once more, by scalars.

Each frequency has one writer, which takes the Gaussians in their order. Values below exp(-CUTOFF) of a Gaussian's peak
are left out before the phase is computed; that is most, as the frequencies of a large Gaussian are few.
"""

import math

import numpy as np

from minisplat_ref.extensions.wave.model import Complexes, Flats, Waves
from minisplat_ref.jit.compile import kernel, prange
from minisplat_ref.types import Floats

CUTOFF = 40.0  # exp(-40) = 4e-18
TURN = 2 * math.pi


@kernel()
def _sum_spectra(centers, axes, scales, weights, k, carrier, z, total):
    n_rows, n_columns, _ = k.shape
    for row in prange(n_rows):
        for column in range(n_columns):
            fx, fy, fz = k[row, column, 0], k[row, column, 1], k[row, column, 2]
            if fz <= 0.0:
                continue
            slowed = fz - carrier  # q_z
            re, im = 0.0, 0.0
            for n in range(len(weights)):
                u = scales[n, 0] * (axes[n, 0, 0] * fx + axes[n, 1, 0] * fy + axes[n, 2, 0] * slowed)
                v = scales[n, 1] * (axes[n, 0, 1] * fx + axes[n, 1, 1] * fy + axes[n, 2, 1] * slowed)
                exponent = 0.5 * TURN * TURN * (u * u + v * v)
                if exponent > CUTOFF:
                    continue
                along = abs(axes[n, 0, 2] * fx + axes[n, 1, 2] * fy + axes[n, 2, 2] * fz)
                size = TURN * scales[n, 0] * scales[n, 1] * weights[n] * along / fz * math.exp(-exponent)
                turns = -fx * centers[n, 0] - fy * centers[n, 1] + fz * z - slowed * centers[n, 2]
                phase = TURN * turns
                re += size * math.cos(phase)
                im += size * math.sin(phase)
            total[row, column] = complex(re, im)


def sum_spectra(flats: Flats, weights: Floats, waves: Waves, z: float = 0.0) -> Complexes:
    """Return the spectrum [rows, columns] of flat Gaussians with weights [N]: ``model.spectrum`` on a grid."""
    total = np.zeros(waves.k.shape[:-1], np.complex128)
    arrays = (np.ascontiguousarray(field, np.float64) for field in (*flats, weights, waves.k))
    _sum_spectra(*arrays, 1 / waves.wavelength, float(z), total)
    return total
