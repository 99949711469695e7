"""Fields on a grid of pixels: their waves, their propagation, and limits of the pixels' size.

A hologram of w x h pixels of the pitch p is computed on twice as many, so that light which leaves it at one side does
not come back at the other. The angular spectrum method multiplies the spectrum by the transfer function

    H = exp(i 2 pi fz dz)   where |fx| and |fy| are below  1 / (lambda sqrt(1 + (dz / W)^2)),   W = w p or h p

The bound is that of Matsushima and Shimobaba 2009 for a padded grid: steeper light would cross the margin W.

Two conditions follow. A Gaussian whose image has a standard deviation below 0.53 p keeps more than a quarter of its
amplitude at the highest frequency 1 / (2 p), so the pitch is too coarse for it. And light at the steepest angle that
the pitch allows, ``sin(theta) = lambda / (2 p)``, must not cross the margin on its way from the farthest plane,
``|z| tan(theta) <= W``, or the pitch is too fine:

    p >= lambda / 2 sqrt(1 + (z / W)^2)
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.fft

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.wave.reference import Complexes, Flats, Waves, waves_of
from minisplat_ref.types import Floats

PIXELS_MIN = math.sqrt(2 * math.log(4)) / math.pi  # 0.530 pixels: exp(-pi^2 s^2 / (2 p^2)) = 1/4
WORKERS = -1  # of scipy.fft: all processors


class Grid(NamedTuple):
    """Pixels of a hologram, around x = y = 0."""

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    pitch: float
    """Metres."""

    @property
    def x(self) -> Floats:
        """[W] centres of the columns, metres."""
        return (np.arange(self.width) + 0.5 - self.width / 2) * self.pitch

    @property
    def y(self) -> Floats:
        """[H] centres of the rows, metres."""
        return (np.arange(self.height) + 0.5 - self.height / 2) * self.pitch

    @property
    def size(self) -> Floats:
        """[2] width and height, metres."""
        return np.array([self.width, self.height]) * self.pitch


def grid_waves(grid: Grid, wavelength: float) -> Waves:
    """Return the waves [2 H, 2 W] of a padded grid."""
    fy, fx = (scipy.fft.fftfreq(2 * n, grid.pitch) for n in (grid.height, grid.width))
    return waves_of(fx[None, :], fy[:, None], wavelength)


def field_from(spectrum: Complexes, waves: Waves, grid: Grid) -> Complexes:
    """Return the field [2 H, 2 W] of a spectrum that refers to x = y = 0; the hologram is its corner [H, W]."""
    return scipy.fft.ifft2(spectrum * _shift(waves, grid), workers=WORKERS) / grid.pitch**2


def spectrum_from(field: Complexes, waves: Waves, grid: Grid) -> Complexes:
    """Return the spectrum [2 H, 2 W] of a field [2 H, 2 W], or of [H, W] with nothing around it."""
    padded = scipy.fft.fft2(field, (2 * grid.height, 2 * grid.width), workers=WORKERS)
    return padded * np.conj(_shift(waves, grid)) * grid.pitch**2


def _shift(waves: Waves, grid: Grid) -> Complexes:
    phases = 2j * np.pi * np.array([grid.x[0], grid.y[0]])
    return np.exp(phases[0] * waves.k[:1, :, 0]) * np.exp(phases[1] * waves.k[:, :1, 1])


def transfer(waves: Waves, grid: Grid, dz: float) -> Complexes:
    """Return H [2 H, 2 W] over a distance dz, metres, which may be negative; 0 outside of the band."""
    fx, fy, fz = np.moveaxis(waves.k, -1, 0)
    limits = 1 / (waves.wavelength * np.sqrt(1 + (dz / grid.size) ** 2))
    is_inside = (fz > 0) & (np.abs(fx) <= limits[0]) & (np.abs(fy) <= limits[1])
    return np.where(is_inside, np.exp(2j * np.pi * dz * fz), 0)


def propagate(field: Complexes, grid: Grid, wavelength: float, dz: float) -> Complexes:
    """Return the field [H, W] at the distance dz from a field [H, W] with nothing around it."""
    waves = grid_waves(grid, wavelength)
    moved = field_from(spectrum_from(field, waves, grid) * transfer(waves, grid, dz), waves, grid)
    return moved[: grid.height, : grid.width]


def finest_pitch(wavelength: float, distance: float, width: float) -> float:
    """Return the least pitch that keeps light within the margin, ``lambda / 2 sqrt(1 + (z / W)^2)``, metres."""
    return wavelength / 2 * math.sqrt(1 + (distance / width) ** 2)


def check_sampling(flats: Flats, grid: Grid, wavelengths: Floats, distance: float) -> None:
    """Refuse a pitch that aliases, before anything is computed.

    Parameters
    ----------
    flats : Flats
        At least one.
    grid : Grid
    wavelengths : sequence of float
        Metres.
    distance : float
        Of the farthest plane from the hologram, metres.

    Raises
    ------
    InputError
        Names a pitch that fits.
    """
    pitch, longest, width = grid.pitch, float(np.max(wavelengths)), float(grid.size.min())
    least = finest_pitch(longest, distance, width)
    if pitch < least:
        raise InputError(
            f"a pitch of {_um(pitch)} um lets light of {longest * 1e9:.0f} nm leave so steeply that within"
            f" {distance * 1e3:.3g} mm it crosses the {_um(width)} um of the hologram and wraps around: a pitch of"
            f" {_um_up(least)} um fits"
        )
    narrowest = math.sqrt(max(float(np.linalg.eigvalsh(flats.lateral_covariances)[:, 0].min()), 0))
    if narrowest < PIXELS_MIN * pitch:
        raise InputError(
            f"a pitch of {_um(pitch)} um is too coarse for the narrowest or steepest Gaussian, whose image has a"
            f" standard deviation of {_um(narrowest)} um: a pitch of {_um_down(narrowest / PIXELS_MIN)} um fits"
        )


def _um(metres: float) -> str:
    return f"{metres * 1e6:.3g}"


def _um_up(metres: float) -> str:
    return _um(metres * 1.006)  # three digits round by half a per cent at most


def _um_down(metres: float) -> str:
    return _um(metres * 0.994)
