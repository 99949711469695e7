"""Stages for the gradient check: the closed form, with respect to all its inputs. Nothing is trained."""

import numpy as np

from minisplat_ref.extensions.wave.reference import Flats, spectrum, spectrum_vjp, waves_of
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats

WAVELENGTH, Z = 1.0, 0.4  # lengths are in wavelengths, so that differences find no numbers of very different sizes
N = 3


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the spectrum of tilted Gaussians in the plane z; it is NumPy on every backend."""
    fx, fy = rng.uniform(-0.4, 0.4, size=(2, 12))
    waves = waves_of(fx, fy, WAVELENGTH)
    inputs: dict[str, Floats] = {
        "centers": rng.uniform(-0.6, 0.6, size=(N, 3)),
        "quats": np.array([1.0, 0, 0, 0]) + 0.3 * rng.normal(size=(N, 4)),
        "scales": rng.uniform(0.4, 0.9, size=(N, 2)),
        "amplitudes": rng.uniform(0.5, 1.5, size=N),
    }

    def function(centers: Floats, quats: Floats, scales: Floats, amplitudes: Floats) -> Point:
        axes = rotation_matrices(quats)
        field = spectrum(Flats(centers, axes, scales), amplitudes, waves, Z)
        return Point((field.real, field.imag), (axes[:, :, 2] @ waves.k.T > 0,))

    def vjp(v_real: Floats, v_imaginary: Floats) -> tuple[Floats, ...]:
        centers, quats, scales, amplitudes = inputs.values()
        flats = Flats(centers, rotation_matrices(quats), scales)
        v = spectrum_vjp(flats, amplitudes, waves, Z, v_real + 1j * v_imaginary)
        return v.centers, rotation_matrices_vjp(quats, v.axes), v.scales, v.amplitudes

    return (Stage("spectrum", inputs, ("real", "imaginary"), function, vjp),)
