"""An environment filtered for rough and for matte surfaces: averages of its texels.

A rough surface seen from straight above (normal, view and reflection n = v = r, as the split sum of Karis 2013 assumes)
averages the environment over the lobe of GGX, alpha = roughness^2, half vector h of l and r::

    D = alpha^2 / (pi ((n.h)^2 (alpha^2 - 1) + 1)^2),   L(r) = sum_l D (n.l) L_l w_l / sum_l D (n.l) w_l

with the solid angles w of texels, each divided into ``SPLIT`` x ``SPLIT`` parts so that a narrow lobe is not missed.
There is a map for each of the roughnesses ``KNOTS``, read linearly in between; the first is the environment itself. A
lobe depends on the difference of two azimuths. Averages are correlations along the rows of texels, therefore, and
products of matrices for each frequency f: ``L^(f) = conj(K^(f)) I^(f)``, backward ``v_I^(f) = K^(f)^T v_L^(f)``.

A matte surface averages over the cosine, which a few spherical harmonics hold (Ramamoorthi and Hanrahan 2001)::

    E(n) = sum_k a_l(k) L_k Y_k(n),   L_k = sum_l Y_k(l) L_l w_l,   a = 1, 2/3, 1/4

E is the irradiance over pi: a constant environment of 1 gives 1, exactly. The harmonics beyond degree 2 are left out;
they add at most a few per cent of the light of a single lamp.
"""

import functools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.gbuffer.environment import locate, read, read_vjp, texel_directions
from minisplat_ref.reference.spherical_harmonics import sh_basis, sh_basis_jacobian
from minisplat_ref.types import Floats, Ints

Spectrum = npt.NDArray[np.complex128]

KNOTS = (0.0, 0.3, 0.5, 0.7, 1.0)
STEPS: Floats = np.array(KNOTS[1:]) - np.array(KNOTS[:-1])
COARSER = (1, 1, 2, 4, 4)  # by how much the map of a knot has fewer rows and columns
SPLIT = 3
ROWS_MAX = 32  # of an environment whose averages are computed texel by texel
COSINE = np.repeat((1.0, 2 / 3, 1 / 4), (1, 3, 5))  # a_l of nine coefficients


class Filtered(NamedTuple):
    """An environment as surfaces of all roughnesses see it."""

    maps: tuple[Floats, ...]
    """[h, w, 3] for each of ``KNOTS``."""
    irradiance: Floats
    """[9, 3] a_l L_k."""


def _lobe(height: int, width: int, roughness: float, coarser: int) -> Floats:
    """Return the weights [h, H, W] of the texels for the directions of the first column of a map that is ``coarser``.

    The lobe of another column is turned by the difference of their azimuths.
    """
    fine, solid = texel_directions(height * SPLIT, width * SPLIT)
    first = texel_directions(height // coarser, width // coarser)[0][:, 0]  # [h, 3]
    cosines, alpha2 = first @ fine.reshape(-1, 3).T, roughness**4
    lobe = alpha2 / (np.pi * ((1 + cosines) / 2 * (alpha2 - 1) + 1) ** 2)  # (n.h)^2 = (1 + r.l) / 2
    parts = (lobe * np.maximum(cosines, 0) * solid.ravel()).reshape(-1, height, SPLIT, width, SPLIT)
    weights: Floats = parts.sum(axis=(2, 4))  # [h, H, W]
    return weights / weights.sum(axis=(1, 2), keepdims=True)


@functools.lru_cache(4)
def _filters(height: int, width: int) -> tuple[tuple[Spectrum, ...], Floats]:
    """Return K^ [W/2 + 1, h, H] of the knots but the first, and the matrix of the irradiance [9, H W]."""
    knots = zip(KNOTS[1:], COARSER[1:], strict=True)
    lobes = (_lobe(height, width, roughness, coarser) for roughness, coarser in knots)
    spectra = tuple(_spectrum(np.moveaxis(lobe, 2, 0)) for lobe in lobes)
    directions, solid = texel_directions(height, width)
    moments: Floats = COSINE[:, None] * sh_basis(directions.reshape(-1, 3), 2).T * solid.ravel()
    moments[1:] -= moments[1:].sum(axis=1, keepdims=True) * solid.ravel() / (4 * np.pi)  # of a constant, exactly 0
    return spectra, moments


def _spectrum(columns: Floats) -> Spectrum:
    """Return the spectrum [W/2 + 1, ...] of the columns [W, ...] of a map."""
    return np.ascontiguousarray(np.fft.rfft(columns.astype(np.float64), axis=0))


def check_size(height: int, width: int) -> None:
    """Refuse a size that does not divide into coarser maps.

    Raises
    ------
    InputError
        The height is no multiple of 4 up to ``ROWS_MAX`` or of ``ROWS_MAX``, or the width is not twice the height.
    """
    step = COARSER[-1] if height <= ROWS_MAX else ROWS_MAX
    if height < step or height % step or width != 2 * height:
        raise InputError(
            f"an environment of {width} x {height} texels: its height must be a multiple of {step}, its width twice the"
            " height"
        )


def prefilter(image: Floats) -> Filtered:
    """Return an environment as surfaces see it.

    Parameters
    ----------
    image : ndarray of shape (H, 2 H, 3)
        Linear RGB, in latitude and longitude. If it has more than ``ROWS_MAX`` rows, all maps but the first are those
        of its averages over squares.

    Raises
    ------
    InputError
        As :func:`check_size`.
    """
    check_size(*image.shape[:2])
    finer = max(1, len(image) // ROWS_MAX)
    height, width = image.shape[0] // finer, image.shape[1] // finer
    lobes, moments = _filters(height, width)
    texels = image.reshape(height, finer, width, finer, 3).mean(axis=(1, 3))
    spectrum, maps = _spectrum(np.swapaxes(texels, 0, 1)), []
    for lobe, coarser in zip(lobes, COARSER[1:], strict=True):
        columns = np.fft.irfft(np.conj(lobe) @ spectrum, width, axis=0)[::coarser]
        maps.append(np.ascontiguousarray(np.swapaxes(columns, 0, 1), image.dtype))
    return Filtered((image, *maps), (moments @ texels.reshape(-1, 3)).astype(image.dtype))


def prefilter_vjp(image: Floats, v: Filtered) -> Floats:
    """Gradient of :func:`prefilter` with respect to the texels [H, W, 3], float64."""
    finer = max(1, len(image) // ROWS_MAX)
    height, width = image.shape[0] // finer, image.shape[1] // finer
    lobes, moments = _filters(height, width)
    v_spectrum = np.zeros((width // 2 + 1, height, 3), complex)
    for lobe, coarser, v_map in zip(lobes, COARSER[1:], v.maps[1:], strict=True):
        v_columns = np.zeros((width, height // coarser, 3))
        v_columns[::coarser] = np.swapaxes(v_map, 0, 1)
        v_spectrum += np.swapaxes(lobe, 1, 2) @ _spectrum(v_columns)
    v_texels = np.swapaxes(np.fft.irfft(v_spectrum, width, axis=0), 0, 1)
    shared = (v_texels + (moments.T @ v.irradiance).reshape(height, width, 3)) / finer**2
    return v.maps[0] + np.repeat(np.repeat(shared, finer, axis=0), finer, axis=1)


def _find_knots(roughness: Floats) -> tuple[Ints, Floats]:
    """Return the index [P] of the knot below, and the share [P] of the knot above."""
    below = np.clip(np.searchsorted(KNOTS, roughness, side="right") - 1, 0, len(KNOTS) - 2)
    low, step = np.array(KNOTS)[below], STEPS[below]
    return below, (roughness - low) / step


def reflected(light: Filtered, directions: Floats, roughness: Floats) -> Floats:
    """Return the light [P, 3] that surfaces of a roughness [P] in [0, 1] see around unit directions [P, 3]."""
    below, share = _find_knots(roughness)
    colors = np.zeros_like(directions)
    for k, image in enumerate(light.maps):
        weights = np.where(below == k, 1 - share, np.where(below == k - 1, share, 0)).astype(directions.dtype)
        rows = np.flatnonzero(weights)
        colors[rows] += weights[rows, None] * read(image, locate(directions[rows], *image.shape[:2]))
    return colors


def reflected_vjp(
    light: Filtered, directions: Floats, roughness: Floats, v_colors: Floats
) -> tuple[tuple[Floats, ...], Floats, Floats]:
    """Gradient of :func:`reflected` with respect to the maps, the directions [P, 3] and the roughness [P].

    ::

        c = (1 - f) c_k + f c_k+1,   v_f = v_c . (c_k+1 - c_k),   v_roughness = v_f / (knot_k+1 - knot_k)
    """
    below, share = _find_knots(roughness)
    v_directions, v_share, v_maps = np.zeros_like(directions), np.zeros(len(directions)), []
    for k, image in enumerate(light.maps):
        is_upper = below == k - 1
        rows = np.flatnonzero((below == k) | is_upper)
        weights = np.where(is_upper, share, 1 - share)[rows].astype(directions.dtype)
        places = locate(directions[rows], *image.shape[:2])
        v_map, v_places = read_vjp(image, places, weights[:, None] * v_colors[rows])
        v_maps.append(v_map)
        v_directions[rows] += v_places
        products = np.sum(v_colors[rows] * read(image, places), axis=1)
        v_share[rows] += np.where(is_upper[rows], products, -products)
    v_roughness: Floats = (v_share / STEPS[below]).astype(roughness.dtype)
    return tuple(v_maps), v_directions, v_roughness


def matte(light: Filtered, normals: Floats) -> Floats:
    """Return E(n) [P, 3] of unit normals [P, 3]."""
    return sh_basis(normals, 2).astype(normals.dtype) @ light.irradiance


def matte_vjp(light: Filtered, normals: Floats, v_colors: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`matte` with respect to the coefficients [9, 3], in float64, and the normals [P, 3]."""
    basis = np.ascontiguousarray(sh_basis(normals, 2).T, np.float64)
    v_irradiance = np.einsum("kp,cp->kc", basis, np.ascontiguousarray(v_colors.T, np.float64))
    v_basis = v_colors @ light.irradiance.T
    return v_irradiance, np.einsum("pk,pki->pi", v_basis, sh_basis_jacobian(normals, 2).astype(normals.dtype))
