"""A hologram as an .npz: one complex field for each colour, and the data for viewing it."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.wave.reference import Complexes
from minisplat_ref.extensions.wave.sampling import Grid
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.npz import read_npz
from minisplat_ref.types import Floats

WAY_OUT = "give a file of minisplat-ref wave hologram"
NAMES = ("real", "imaginary", "wavelengths", "pitch", "depths", "thickness")


class Hologram(NamedTuple):
    """The content of a display."""

    fields: Complexes
    """[3, H, W] of red, green and blue light in the plane z = 0; an image's values are their absolute values."""
    wavelengths: Floats
    """[3] metres."""
    pitch: float
    """Metres."""
    depths: Floats
    """[2] of the camera, world units, that lie at z = D / 2 and at -D / 2."""
    thickness: float
    """D, metres."""

    @property
    def grid(self) -> Grid:
        """The pixels."""
        return Grid(self.fields.shape[2], self.fields.shape[1], self.pitch)

    def z_of(self, depth: float) -> float:
        """Return the plane z, metres, in which something at a depth of the camera is sharp."""
        a, b = 1 / self.depths
        return float(self.thickness * (1 / depth - (a + b) / 2) / (a - b))


def save(path: Path, hologram: Hologram) -> None:
    """Write a hologram.

    Raises
    ------
    InputError
        It cannot be written.
    """
    fields = hologram.fields.astype(np.complex64)
    values = (fields.real, fields.imag, *map(np.asarray, hologram[1:]))
    arrays: dict[str, Any] = dict(zip(NAMES, values, strict=True))
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)


def load(path: Path) -> Hologram:
    """Read a hologram.

    Raises
    ------
    InputError
        The file is no hologram, or is damaged.
    """
    arrays = read_npz(path, WAY_OUT)
    if missing := [name for name in NAMES if name not in arrays]:
        raise InputError(f"{path} lacks {', '.join(missing)}: {WAY_OUT}")
    real, imaginary, wavelengths, pitch, depths, thickness = (arrays[name] for name in NAMES)
    is_shaped = real.ndim == 3 and real.shape[0] == 3 and min(real.shape) > 0 and imaginary.shape == real.shape
    numbers = np.concatenate([np.ravel(a).astype(np.float64) for a in (wavelengths, pitch, depths, thickness)])
    are_numbers = wavelengths.shape == (3,) and depths.shape == (2,) and pitch.size == thickness.size == 1
    is_finite = np.isfinite(numbers).all() and np.isfinite(real).all() and np.isfinite(imaginary).all()
    if not (is_shaped and are_numbers and is_finite and numbers.min() > 0 and depths[0] < depths[1]):
        raise InputError(f"{path} is no hologram of three colours with positive lengths: {WAY_OUT}")
    fields = real.astype(np.float64) + 1j * imaginary
    return Hologram(fields, wavelengths, float(pitch), depths, float(thickness))
