"""Double-phase encoding: a complex field as phases alone, for a display that changes nothing else.

With the amplitude A in [0, 1] and the phase p, ``A exp(i p)`` is the mean of two waves of amplitude 1,

    (exp(i (p + arccos A)) + exp(i (p - arccos A))) / 2

which neighbouring pixels show on a checkerboard. An aperture in the focal plane of the display, here of half the band
on either axis, blurs them to their mean and holds back the copies that the checkerboard makes.

The mean is right as far as neighbours have the same phase. Where the field is nearly black its phase is noise, which
would light up; it is taken as 0 there, that of the wave along z in the display's plane.
"""

import numpy as np

from minisplat_ref.extensions.wave.reference import Complexes
from minisplat_ref.extensions.wave.sampling import Grid, field_from, grid_waves, spectrum_from
from minisplat_ref.types import Floats

APERTURE = 0.5  # of the band
BLACK = 1 / 255  # of the largest amplitude


def encode(field: Complexes) -> tuple[Floats, float]:
    """Return the phases [H, W] in [0, 2 pi) of a field, and the amplitude that 1 represents."""
    peak = float(np.abs(field).max()) or 1.0
    amplitudes = np.minimum(np.abs(field) / peak, 1)
    half = np.arccos(amplitudes)
    rows, columns = np.indices(field.shape)
    signs = 1 - 2 * ((rows + columns) % 2)
    phases: Floats = np.where(amplitudes < BLACK, 0, np.angle(field)) + signs * half
    return np.mod(phases, 2 * np.pi), peak


def decode(phases: Floats, peak: float, grid: Grid, wavelength: float) -> Complexes:
    """Return the field [H, W] that phases show behind the aperture."""
    waves = grid_waves(grid, wavelength)
    bound = APERTURE / (2 * grid.pitch)
    passes = (np.abs(waves.k[..., 0]) < bound) & (np.abs(waves.k[..., 1]) < bound)
    shown = field_from(spectrum_from(peak * np.exp(1j * phases), waves, grid) * passes, waves, grid)
    return shown[: grid.height, : grid.width]
