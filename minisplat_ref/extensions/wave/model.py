"""The light of flat Gaussians: the spectrum in closed form with its gradient, fields on a grid, and their propagation.

Gaussian Wave Splatting, arXiv 2505.06582. Light of wavelength lambda travels towards larger z. A plane wave has the
frequencies (fx, fy), cycles per metre, and

    fz = sqrt(1 / lambda^2 - fx^2 - fy^2);   it carries nothing where that is not real

A flat Gaussian with centre c, axes e_1, e_2, normal n and standard deviations s_1, s_2 is lit from behind by the wave
along z. So its plane holds the field ``exp(-(a^2 / s_1^2 + b^2 / s_2^2) / 2) exp(i 2 pi z / lambda)``, a and b along
the axes. The field that it sends to the plane z has the spectrum

    k = (fx, fy, fz),  q = k - (0, 0, 1 / lambda),  u = e_1 . q,  v = e_2 . q
    G = 2 pi s_1 s_2 exp(-2 pi^2 (u^2 s_1^2 + v^2 s_2^2)) |n . k| / fz
        exp(i 2 pi (cz / lambda - fx cx - fy cy + fz (z - cz)))

The peak is at fx = fy = 0 however the Gaussian is tilted, because the wave that lights it travels along z: a tilt makes
the spectrum wider, not oblique.

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
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats

Complexes = NDArray[np.complexfloating]
PIXELS_MIN = math.sqrt(2 * math.log(4)) / math.pi  # 0.530 pixels: exp(-pi^2 s^2 / (2 p^2)) = 1/4
WORKERS = -1  # of scipy.fft: all processors
WAVELENGTH, Z = 1.0, 0.4  # lengths are in wavelengths, so that differences find no numbers of very different sizes
N = 3


class Flats(NamedTuple):
    """Flat Gaussians before the hologram's plane z = 0: x right, y down, z towards the viewer, metres."""

    centers: Floats
    """[N, 3]."""
    axes: Floats
    """[N, 3, 3] orthonormal columns e_1, e_2, n; of either hand, as only ``|n . k|`` counts."""
    scales: Floats
    """[N, 2] standard deviations along e_1 and e_2."""

    @property
    def lateral_covariances(self) -> Floats:
        """[N, 2, 2] of their images along z."""
        spans = self.axes[:, :2, :2] * self.scales[:, None, :]
        return spans @ np.swapaxes(spans, 1, 2)

    def one(self, i: int) -> "Flats":
        """Return one of them."""
        return Flats(*(field[i : i + 1] for field in self))


class FlatsGradient(NamedTuple):
    """Gradient of the loss with respect to flat Gaussians and their amplitudes."""

    centers: Floats
    """[N, 3]."""
    axes: Floats
    """[N, 3, 3] with respect to the nine entries."""
    scales: Floats
    """[N, 2]."""
    amplitudes: Floats
    """[N]."""


class Waves(NamedTuple):
    """Plane waves of one wavelength."""

    k: Floats
    """[..., 3] frequencies fx, fy, fz, 1/m; fz is 0 where the wave is evanescent."""
    wavelength: float
    """Metres."""


def make_waves(fx: Floats, fy: Floats, wavelength: float) -> Waves:
    """Return the waves of frequencies that broadcast, 1/m."""
    square = 1 / wavelength**2 - fx**2 - fy**2
    return Waves(np.stack(np.broadcast_arrays(fx, fy, np.sqrt(np.maximum(square, 0))), axis=-1), wavelength)


def spectra(flats: Flats, waves: Waves, z: float | Floats = 0.0) -> Complexes:
    """Return the spectrum of each flat Gaussian of amplitude 1, m^2.

    Parameters
    ----------
    flats : Flats
        N of them.
    waves : Waves
        P waves, ``k`` of shape (P, 3).
    z : float or ndarray of shape (N,)
        Plane of the field, metres.

    Returns
    -------
    ndarray of shape (N, P)
        G; 0 where a wave is evanescent.
    """
    k, wavelength = waves
    q = k - [0, 0, 1 / wavelength]
    u, v, nk = _along_axes(flats, q, k)  # [N, P] each
    s_1, s_2 = flats.scales.T[:, :, None]
    cx, cy, cz = flats.centers.T[:, :, None]
    z = np.reshape(z, (-1, 1))
    size = 2 * np.pi * s_1 * s_2 * np.exp(-2 * np.pi**2 * ((u * s_1) ** 2 + (v * s_2) ** 2))
    turns = cz / wavelength - k[:, 0] * cx - k[:, 1] * cy + k[:, 2] * (z - cz)
    with np.errstate(divide="ignore", invalid="ignore"):
        obliquity = np.where(k[:, 2] > 0, np.abs(nk) / k[:, 2], 0)
    return size * obliquity * np.exp(2j * np.pi * turns)


def spectrum(flats: Flats, amplitudes: Floats, waves: Waves, z: float = 0.0) -> Complexes:
    """Return the spectrum [P] of all flat Gaussians with amplitudes [N]; nothing hides anything."""
    total: Complexes = amplitudes @ spectra(flats, waves, z)
    return total


def spectrum_vjp(flats: Flats, amplitudes: Floats, waves: Waves, z: float, v_spectrum: Complexes) -> FlatsGradient:
    """Gradient of :func:`spectrum`.

    ``v = dL / d Re + i dL / d Im``. With ``g = Re(conj(v) A G)`` and ``h = Im(conj(v) A G)``, a phase of t turns has
    ``d/dt = -2 pi h``, and::

        v_A  = g / A
        v_s1 = sum g (1 / s_1 - 4 pi^2 u^2 s_1),   v_s2 likewise
        v_e1 = -4 pi^2 s_1^2 sum g u q,            v_e2 likewise
        v_n  = sum g k / (n . k)
        v_cx = 2 pi sum h fx,   v_cy = 2 pi sum h fy,   v_cz = 2 pi sum h (fz - 1 / lambda)

    Parameters
    ----------
    flats, amplitudes, waves, z
        As for the forward function.
    v_spectrum : ndarray of shape (P,)
        Complex.
    """
    k, wavelength = waves
    q = k - [0, 0, 1 / wavelength]
    u, v, nk = _along_axes(flats, q, k)
    weighted = np.conj(v_spectrum) * spectra(flats, waves, z)  # [N, P] for amplitude 1
    g, h = amplitudes[:, None] * weighted.real, amplitudes[:, None] * weighted.imag
    s_1, s_2 = flats.scales.T
    pi_2 = 4 * np.pi**2
    v_s1 = g.sum(axis=1) / s_1 - pi_2 * s_1 * np.sum(g * u**2, axis=1)
    v_s2 = g.sum(axis=1) / s_2 - pi_2 * s_2 * np.sum(g * v**2, axis=1)
    v_e1 = -pi_2 * s_1[:, None] ** 2 * ((g * u) @ q)
    v_e2 = -pi_2 * s_2[:, None] ** 2 * ((g * v) @ q)
    with np.errstate(divide="ignore", invalid="ignore"):
        v_n = np.where(g != 0, g / nk, 0) @ k
    return FlatsGradient(
        centers=2 * np.pi * (h @ q),
        axes=np.stack([v_e1, v_e2, v_n], axis=2),
        scales=np.column_stack([v_s1, v_s2]),
        amplitudes=weighted.real.sum(axis=1),
    )


def _along_axes(flats: Flats, q: Floats, k: Floats) -> Floats:
    """Return u, v and ``n . k`` [3, N, P]."""
    e_1, e_2, n = np.moveaxis(flats.axes, 2, 0)  # [N, 3] each
    return np.stack([e_1 @ q.T, e_2 @ q.T, n @ k.T])


def rayleigh_sommerfeld(flats: Flats, places: Floats, wavelength: float, n: int = 240, reach: float = 5.0) -> Complexes:
    """Return the field of one flat Gaussian at places, by brute force: the sum over spherical waves from its plane.

    The first Rayleigh-Sommerfeld integral over the plane of the Gaussian, with ``r`` from a point of it to a place::

        U = sum exp(-(a^2 / s_1^2 + b^2 / s_2^2) / 2 + i 2 pi z / lambda) |n . r| / r^2 (1 / r - i 2 pi / lambda)
            exp(i 2 pi r / lambda) / (2 pi) da db

    It shares nothing with the closed form but the field on the plane, and has the cost of a point cloud.

    Parameters
    ----------
    flats : Flats
        The first counts.
    places : ndarray of shape (Q, 3)
        Where, metres.
    wavelength : float
        Metres.
    n : int
        Points on a side of the square of points.
    reach : float
        Half of that side, standard deviations.
    """
    t = (np.arange(n) + 0.5) / n * 2 * reach - reach  # in standard deviations
    a, b = np.meshgrid(t, t, indexing="ij")
    e_1, e_2, normal = flats.axes[0].T
    s_1, s_2 = flats.scales[0]
    points = flats.centers[0] + s_1 * a[..., None] * e_1 + s_2 * b[..., None] * e_2  # [n, n, 3]
    source = np.exp(-(a**2 + b**2) / 2 + 2j * np.pi * points[..., 2] / wavelength) * s_1 * s_2 * (2 * reach / n) ** 2
    field = np.zeros(len(places), np.complex128)
    for i, place in enumerate(places):
        offset = place - points
        r = np.linalg.norm(offset, axis=-1)
        wave = np.exp(2j * np.pi * r / wavelength) * (1 / r - 2j * np.pi / wavelength) / (2 * np.pi)
        field[i] = np.sum(source * wave * np.abs(offset @ normal) / r**2)
    return field


# --- fields on a grid ---


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
    return make_waves(fx[None, :], fy[:, None], wavelength)


def compute_field(spectrum: Complexes, waves: Waves, grid: Grid) -> Complexes:
    """Return the field [2 H, 2 W] of a spectrum that refers to x = y = 0; the hologram is its corner [H, W]."""
    return scipy.fft.ifft2(spectrum * _shift(waves, grid), workers=WORKERS) / grid.pitch**2


def compute_spectrum(field: Complexes, waves: Waves, grid: Grid) -> Complexes:
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
    moved = compute_field(compute_spectrum(field, waves, grid) * transfer(waves, grid, dz), waves, grid)
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


# --- the gradient check ---


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the spectrum of tilted Gaussians in the plane z; it is NumPy on every backend."""
    fx, fy = rng.uniform(-0.4, 0.4, size=(2, 12))
    waves = make_waves(fx, fy, WAVELENGTH)
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
