"""A hologram as a file and on a display of phases, and the command ``minisplat-ref wave focus``, which views it.

The file is an .npz with one complex field for each colour, and the data for viewing it. ``wave focus`` shows what an
eye or a camera sees that is focused on a depth.

Double-phase encoding makes phases alone of a field, for a display that changes nothing else. With the amplitude A in
[0, 1] and the phase p, ``A exp(i p)`` is the mean of two waves of amplitude 1,

    (exp(i (p + arccos A)) + exp(i (p - arccos A))) / 2

which neighbouring pixels show on a checkerboard. An aperture in the focal plane of the display, here of half the band
on either axis, blurs them to their mean and holds back the copies that the checkerboard makes.

The mean is right as far as neighbours have the same phase. Where the field is nearly black its phase is noise, which
would light up; it is taken as 0 there, that of the wave along z in the display's plane.
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.wave.model import (
    Complexes,
    Grid,
    compute_field,
    compute_spectrum,
    finest_pitch,
    grid_waves,
    propagate,
)
from minisplat_ref.interface.arguments import HelpFormatter, positive
from minisplat_ref.io import write_image
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.npz import read_npz
from minisplat_ref.types import Floats

WAY_OUT = "give a file of minisplat-ref wave hologram"
NAMES = ("real", "imaginary", "wavelengths", "pitch", "depths", "thickness")
APERTURE = 0.5  # of the band
BLACK = 1 / 255  # of the largest amplitude

EPILOG = """\
examples:
  minisplat-ref wave focus fox.npz --depth 3.5 --out near.png
  minisplat-ref wave focus fox.npz --depth 9 --phase-only --out far.png
"""


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


def save_hologram(path: Path, hologram: Hologram) -> None:
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


def load_hologram(path: Path) -> Hologram:
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


def encode_phases(field: Complexes) -> tuple[Floats, float]:
    """Return the phases [H, W] in [0, 2 pi) of a field, and the amplitude that 1 represents."""
    peak = float(np.abs(field).max()) or 1.0
    amplitudes = np.minimum(np.abs(field) / peak, 1)
    half = np.arccos(amplitudes)
    rows, columns = np.indices(field.shape)
    signs = 1 - 2 * ((rows + columns) % 2)
    phases: Floats = np.where(amplitudes < BLACK, 0, np.angle(field)) + signs * half
    return np.mod(phases, 2 * np.pi), peak


def decode_phases(phases: Floats, peak: float, grid: Grid, wavelength: float) -> Complexes:
    """Return the field [H, W] that phases show behind the aperture."""
    waves = grid_waves(grid, wavelength)
    bound = APERTURE / (2 * grid.pitch)
    passes = (np.abs(waves.k[..., 0]) < bound) & (np.abs(waves.k[..., 1]) < bound)
    shown = compute_field(compute_spectrum(peak * np.exp(1j * phases), waves, grid) * passes, waves, grid)
    return shown[: grid.height, : grid.width]


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "focus",
        help="look at a hologram, focused on a depth",
        description="Propagate a hologram to the plane of a depth, and write what is there.",
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("hologram", type=Path, metavar="HOLOGRAM", help="file of wave hologram")
    parser.add_argument("--depth", type=positive, required=True, metavar="Z", help="of the camera, world units")
    parser.add_argument("--out", type=Path, required=True, metavar="PNG", help="image to write")
    parser.add_argument(
        "--phase-only", action="store_true", help="of a display of phases alone, double-phase encoded, with an aperture"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read a hologram, propagate it, and write the image.

    Raises
    ------
    InputError
        The file is no hologram, or the depth is too far from it.
    """
    hologram = load_hologram(args.hologram)
    z = hologram.z_of(args.depth)
    least = finest_pitch(float(hologram.wavelengths.max()), abs(z), float(hologram.grid.size.min()))
    if hologram.pitch < least:
        near, far = hologram.depths
        raise InputError(
            f"--depth {args.depth:g} is {abs(z) * 1e3:.3g} mm from the display, where light wraps around: the scene is"
            f" between {near:.3g} and {far:.3g}"
        )
    write_image(args.out, reconstruct(hologram, z, is_phase_only=args.phase_only))
    print(f"focused on {args.depth:g}, {z * 1e3:+.3g} mm from the display: {args.out}")
    return 0


def reconstruct(hologram: Hologram, z: float, *, is_phase_only: bool = False) -> Floats:
    """Return the image [H, W, 3] in the plane z, metres: amplitudes, as an image stores them."""
    grid, image = hologram.grid, []
    for field, wavelength in zip(hologram.fields, hologram.wavelengths, strict=True):
        shown = decode_phases(*encode_phases(field), grid, float(wavelength)) if is_phase_only else field
        image.append(np.abs(propagate(shown, grid, float(wavelength), z)))
    return np.stack(image, axis=-1)
