"""Alpha blending of waves, and its alternatives: three ways to a hologram, each Gaussian on the whole grid.

*Exact* blending goes front to back like 3DGS, with waves instead of colours. u is the field of a Gaussian in the
plane of its own centre, with its peak at 1; o its opacity, c its amplitude; P propagates to the hologram:

    U = sum_i P[T_i o_i c_i u_i],   T_(i+1) = T_i (1 - o_i |u_i|)

T is a mask: it hides everything straight behind, and does not diffract. *Fast* blending takes for T one number per
Gaussian, the transmittance at its centre, so that everything is one sum of closed forms over Gaussians:

    U = sum_i t_i o_i c_i G_i,   t_i = prod_(j before i) (1 - o_j exp(-d^T C_j^-1 d / 2)),   d = (c_i - c_j)_xy

with C the covariance of the image along z. The *silhouette* method goes back to front: the light that arrives from
behind passes through each Gaussian and its own is added,

    U <- P[U] (1 - o_i |u_i|) + o_i c_i u_i

so that light also bends around edges. :mod:`.windows` has the exact and the silhouette method for many Gaussians.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.wave.reference import Complexes, Flats, Waves, spectra
from minisplat_ref.extensions.wave.sampling import Grid, field_from, grid_waves, spectrum_from, transfer
from minisplat_ref.types import Floats


class Scene(NamedTuple):
    """Flat Gaussians with opacities and amplitudes, from front to back."""

    flats: Flats
    opacities: Floats
    """[N]."""
    amplitudes: Floats
    """[N, 3] of red, green and blue light, as images store it; its square is the intensity."""


def front_to_back(scene: Scene) -> Scene:
    """Return the Gaussians in the order of their distances from the viewer, who is at large z."""
    order = np.argsort(-scene.flats.centers[:, 2], kind="stable")
    return Scene(Flats(*(field[order] for field in scene.flats)), scene.opacities[order], scene.amplitudes[order])


def alphas_of(opacity: float, u: Complexes) -> Floats:
    """Return ``o |u|``, at most 1: diffraction within a tilted Gaussian may take u slightly above its peak of 1."""
    return np.minimum(opacity * np.abs(u), 1)


def blend(scene: Scene, grid: Grid, wavelength: float, channel: int) -> Complexes:
    """Return the hologram [H, W] of one channel by exact blending."""
    waves, T = grid_waves(grid, wavelength), np.ones((2 * grid.height, 2 * grid.width))
    total = np.zeros(T.shape, np.complex128)
    for i, z in enumerate(scene.flats.centers[:, 2]):
        u = _field_of(scene.flats, i, waves, grid)
        light = T * (scene.opacities[i] * scene.amplitudes[i, channel]) * u
        total += spectrum_from(light, waves, grid) * transfer(waves, grid, -z)
        T *= 1 - alphas_of(scene.opacities[i], u)
    return field_from(total, waves, grid)[: grid.height, : grid.width]


def blend_silhouettes(scene: Scene, grid: Grid, wavelength: float, channel: int) -> Complexes:
    """Return the hologram [H, W] of one channel by the silhouette method."""
    waves = grid_waves(grid, wavelength)
    total: Complexes = np.zeros((2 * grid.height, 2 * grid.width), np.complex128)
    at = 0.0
    for i, z in reversed(list(enumerate(scene.flats.centers[:, 2]))):
        u = _field_of(scene.flats, i, waves, grid)
        arriving = field_from(total * transfer(waves, grid, z - at), waves, grid)
        leaving = arriving * (1 - alphas_of(scene.opacities[i], u))
        total, at = spectrum_from(leaving + scene.opacities[i] * scene.amplitudes[i, channel] * u, waves, grid), z
    return field_from(total * transfer(waves, grid, -at), waves, grid)[: grid.height, : grid.width]


def blend_fast(scene: Scene, grid: Grid, wavelength: float, channel: int) -> Complexes:
    """Return the hologram [H, W] of one channel by fast blending; :mod:`.kernels` has it for many Gaussians."""
    waves = grid_waves(grid, wavelength)
    weights = center_transmittances(scene) * scene.opacities * scene.amplitudes[:, channel]
    total = sum(weights[i] * _spectrum_of(scene.flats, i, waves, 0.0) for i in range(len(weights)))
    return field_from(total, waves, grid)[: grid.height, : grid.width]


def center_transmittances(scene: Scene) -> Floats:
    """Return t [N], the transmittance in front of the centre of each Gaussian."""
    centers, precisions = scene.flats.centers[:, :2], np.linalg.inv(scene.flats.lateral_covariances)
    t = np.ones(len(centers))
    for j in range(len(centers)):  # on all that are behind
        d = centers[j + 1 :] - centers[j]
        t[j + 1 :] *= 1 - scene.opacities[j] * np.exp(-0.5 * np.einsum("ni,ij,nj->n", d, precisions[j], d))
    return t


def _field_of(flats: Flats, i: int, waves: Waves, grid: Grid) -> Complexes:
    """Return u [2 H, 2 W] in the plane of the centre of a Gaussian."""
    return field_from(_spectrum_of(flats, i, waves, float(flats.centers[i, 2])), waves, grid)


def _spectrum_of(flats: Flats, i: int, waves: Waves, z: float) -> Complexes:
    listed = waves._replace(k=waves.k.reshape(-1, 3))
    return spectra(flats.one(i), listed, z).reshape(waves.k.shape[:-1])
