"""Blending of many Gaussians: each in a window of its own size, in the nearest of some planes.

The exact method of :mod:`.blending` takes two transforms of the whole grid per Gaussian. But in the plane of its own
centre a Gaussian is small. So here its spectrum is evaluated on the few frequencies of a window around it, already
propagated to the nearest of ``N_PLANES`` planes, which the window's margin leaves room for. The transmittance T is one
array for all. Each plane is propagated to the hologram by the angular spectrum method, once.

Left out is the ringing of Gaussians about as narrow as a pixel, whose spectrum the pitch cuts off, beyond their
windows: less than a fiftieth for a standard deviation of 0.55 pixels, the least that the low-pass leaves, and less than
a thousandth from 1 pixel on.

The silhouette method does the same plane by plane from the back, with a transmittance for each plane.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.fft

from minisplat_ref.extensions.wave.blending import Scene, alphas_of
from minisplat_ref.extensions.wave.kernels import sum_spectra
from minisplat_ref.extensions.wave.reference import Complexes, Flats, waves_of
from minisplat_ref.extensions.wave.sampling import Grid, field_from, grid_waves, spectrum_from, transfer
from minisplat_ref.types import Floats, Ints

N_PLANES = 64
REACH = 4.5  # standard deviations from the centre of a window to its side: exp(-REACH^2 / 2) = 4e-5
MARGIN = 4  # pixels besides, for the spread by diffraction on the way to the nearest plane


class Window(NamedTuple):
    """Part of a grid, which may extend beyond it."""

    left: int
    top: int
    width: int
    height: int

    def inside(self, grid: Grid) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Return the part of the grid that the window covers, and the part of the window that is in the grid."""
        x0, x1 = np.clip([self.left, self.left + self.width], 0, grid.width)
        y0, y1 = np.clip([self.top, self.top + self.height], 0, grid.height)
        of_window = slice(y0 - self.top, y1 - self.top), slice(x0 - self.left, x1 - self.left)
        return (slice(y0, y1), slice(x0, x1)), of_window


class Planes(NamedTuple):
    """The windows in which Gaussians are blended."""

    z: Floats
    """[L] from front to back, metres."""
    of: Ints
    """[N] the nearest plane of each Gaussian, ascending as they go from front to back."""


def planes_of(z: Floats, n: int = N_PLANES) -> Planes:
    """Return planes for Gaussians at depths z [N], which descend."""
    planes = np.linspace(z[0], z[-1], n) if z[0] > z[-1] else z[:1]
    step = planes[0] - planes[1] if len(planes) > 1 else 1.0
    return Planes(planes, np.rint((planes[0] - z) / step).astype(np.int64))


def window_of(one: Flats, grid: Grid) -> Window:
    """Return the window of a Gaussian."""
    center, halves = one.centers[0, :2], REACH * np.sqrt(np.diag(one.lateral_covariances[0])) / grid.pitch + MARGIN
    width, height = (scipy.fft.next_fast_len(2 * math.ceil(half)) for half in halves)
    column, row = np.rint(center / grid.pitch + [grid.width / 2, grid.height / 2]).astype(int)
    return Window(int(column) - width // 2, int(row) - height // 2, width, height)


def field_in(window: Window, one: Flats, grid: Grid, wavelength: float, z: float) -> Complexes:
    """Return the field of a Gaussian in the plane z on its window."""
    fx, fy = (scipy.fft.fftfreq(n, grid.pitch) for n in (window.width, window.height))
    waves = waves_of(fx[None, :], fy[:, None], wavelength)
    first = np.array([window.left + 0.5 - grid.width / 2, window.top + 0.5 - grid.height / 2]) * grid.pitch
    seen = one._replace(centers=one.centers - [*first, 0])  # from the window's first pixel
    return scipy.fft.ifft2(sum_spectra(seen, np.ones(1), waves, z)) / grid.pitch**2


def blend_windows(scene: Scene, grid: Grid, wavelength: float, channel: int, n_planes: int = N_PLANES) -> Complexes:
    """Return the hologram [H, W] of one channel by exact blending.

    Parameters
    ----------
    scene : Scene
        From front to back.
    grid : Grid
    wavelength : float
        Metres.
    channel : int
        Of the amplitudes.
    n_planes : int
        As many as Gaussians at equal distances: then none is moved, and this is the exact method to the windows' edges.
    """
    planes = planes_of(scene.flats.centers[:, 2], n_planes)
    waves, T = grid_waves(grid, wavelength), np.ones((grid.height, grid.width))
    total = np.zeros((2 * grid.height, 2 * grid.width), np.complex128)
    for plane, z in enumerate(planes.z):
        light = _blend_plane(scene, planes, plane, grid, wavelength, channel, T)
        if light is not None:
            total += spectrum_from(light, waves, grid) * transfer(waves, grid, -z)
    return field_from(total, waves, grid)[: grid.height, : grid.width]


def blend_silhouette_windows(
    scene: Scene, grid: Grid, wavelength: float, channel: int, n_planes: int = N_PLANES
) -> Complexes:
    """Return the hologram [H, W] of one channel by the silhouette method; as :func:`blend_windows`."""
    planes = planes_of(scene.flats.centers[:, 2], n_planes)
    waves = grid_waves(grid, wavelength)
    total: Complexes = np.zeros((2 * grid.height, 2 * grid.width), np.complex128)
    at = 0.0
    for plane, z in reversed(list(enumerate(planes.z))):
        T = np.ones((grid.height, grid.width))
        light = _blend_plane(scene, planes, plane, grid, wavelength, channel, T)
        if light is not None:
            arriving = field_from(total * transfer(waves, grid, z - at), waves, grid)
            arriving[: grid.height, : grid.width] = arriving[: grid.height, : grid.width] * T + light
            total, at = spectrum_from(arriving, waves, grid), float(z)
    return field_from(total * transfer(waves, grid, -at), waves, grid)[: grid.height, : grid.width]


def _blend_plane(
    scene: Scene, planes: Planes, plane: int, grid: Grid, wavelength: float, channel: int, T: Floats
) -> Complexes | None:
    """Return the light [H, W] of the Gaussians of a plane, None without any; T is multiplied by their transmittance."""
    first, end = np.searchsorted(planes.of, [plane, plane + 1])
    if first == end:
        return None
    light = np.zeros(T.shape, np.complex128)
    for i in range(first, end):
        one = scene.flats.one(i)
        window = window_of(one, grid)
        there, here = window.inside(grid)
        u = field_in(window, one, grid, wavelength, float(planes.z[plane]))[here]
        light[there] += T[there] * (scene.opacities[i] * scene.amplitudes[i, channel]) * u
        T[there] *= 1 - alphas_of(scene.opacities[i], u)
    return light
