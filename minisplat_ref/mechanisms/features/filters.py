"""The classical bank: Gabor filters of four orientations, their energies, and mean colours, at three scales.

Nothing in it is learned, and it is not VGG. At each scale, an octave above the one before, the luminance Y is filtered
by waves under a Gaussian window, of wavelength l, at the angles t_k = k pi / 4::

    even_k = Y * g(x) (cos(2 pi a_k / l) - m),   odd_k = Y * g(x) sin(2 pi a_k / l),   a_k = x cos t_k + y sin t_k
    energy_k = sqrt(even_k^2 + odd_k^2 + eps^2)

m makes the even filter blind to brightness; each filter is scaled so that the wave it is made for, between black and
white, has a response of about 1. The signed responses give the position of a pixel in a stripe, the energies only the
stripe's strength. Three channels are the mean colour under the window, from -1 to 1. The last is constant: between
vectors without it, the cosine would not see how strong a response is, and grey would have no direction.

Filters are applied only where they are inside the image, at the finest scale at every second pixel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import LUMA
from minisplat_ref.mechanisms.features.bank import FeatureBank
from minisplat_ref.mechanisms.features.layers import HALVING_SIDE, convolve_vjp, halve, halve_vjp
from minisplat_ref.metrics.lpips import convolve
from minisplat_ref.types import Floats

N_ORIENTATIONS, N_SCALES = 4, 3
SIDE, SIGMA, WAVELENGTH = 7, 1.6, 4.5  # pixels, of a filter
STRIDES = (2, 1, 1)  # by scale
ENERGY_FLOOR = 0.02  # eps, where the square root would have no derivative
CONSTANT = 0.5
N_LINEAR = 3 + 2 * N_ORIENTATIONS  # channels that are convolutions: colours, even, odd
EVEN, ODD = slice(3, 3 + N_ORIENTATIONS), slice(3 + N_ORIENTATIONS, N_LINEAR)
ENERGY = slice(N_LINEAR, N_LINEAR + N_ORIENTATIONS)
N_CHANNELS = ENERGY.stop + 1


def gabor_filters() -> Floats:
    """Return the filters [N_LINEAR, 3, SIDE, SIDE] on colours: three window means, then even and odd ones."""
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE // 2
    window = np.exp(-(x**2 + y**2) / (2 * SIGMA**2))
    window /= window.sum()
    filters = np.zeros((N_LINEAR, 3, SIDE, SIDE))
    filters[[0, 1, 2], [0, 1, 2]] = 2 * window
    for k in range(N_ORIENTATIONS):
        angle = k * np.pi / N_ORIENTATIONS
        phase = 2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / WAVELENGTH
        even = window * (np.cos(phase) - np.sum(window * np.cos(phase)))
        odd = window * np.sin(phase)
        for row, wave, filter_ in ((EVEN.start + k, np.cos(phase), even), (ODD.start + k, np.sin(phase), odd)):
            filters[row] = np.array(LUMA)[:, None, None] * filter_ / np.sum(filter_ * wave / 2)
    return filters


FILTERS = gabor_filters()


class _Tape(NamedTuple):
    shapes: list[tuple[int, int]]
    """Of the image at each scale."""
    maps: list[Floats]


def features(image: Floats) -> tuple[list[Floats], _Tape]:
    """Return the maps [h, w, N_CHANNELS] of an image [H, W, 3] from fine to coarse, and a tape."""
    filters, bias = FILTERS.astype(image.dtype), np.zeros(N_LINEAR, image.dtype)
    bias[:3] = -1  # colours from 0 to 1 become -1 to 1
    shapes, maps = [], []
    for scale, stride in enumerate(STRIDES):
        image = halve(image) if scale else image
        linear = convolve(image, filters, bias, stride, 0)  # [h, w, N_LINEAR]
        energy = np.sqrt(linear[..., EVEN] ** 2 + linear[..., ODD] ** 2 + image.dtype.type(ENERGY_FLOOR**2))
        constant = np.full((*linear.shape[:2], 1), CONSTANT, image.dtype)
        shapes.append((image.shape[0], image.shape[1]))
        maps.append(np.concatenate([linear, energy, constant], axis=2))
    return maps, _Tape(shapes, maps)


def features_vjp(tape: _Tape, v_maps: Sequence[Floats]) -> Floats:
    """Gradient of :func:`features`, from coarse to fine.

    ``v_even += v_energy even / energy``, likewise odd; through the filters (:func:`.layers.convolve_vjp`); and the
    gradient of a halved image passes to the image that it was made of.

    Parameters
    ----------
    tape : of :func:`features`
    v_maps : sequence of ndarray of shape (h, w, N_CHANNELS)

    Returns
    -------
    v_image : ndarray of shape (H, W, 3)
    """
    filters = FILTERS.astype(v_maps[0].dtype)
    v_image = None
    for shape, map_, v_map, stride in reversed(list(zip(tape.shapes, tape.maps, v_maps, STRIDES, strict=True))):
        v_linear = v_map[..., :N_LINEAR].copy()
        for part in (EVEN, ODD):
            v_linear[..., part] += v_map[..., ENERGY] * map_[..., part] / map_[..., ENERGY]
        v_here = convolve_vjp(shape, filters, stride, 0, v_linear)
        v_image = v_here if v_image is None else v_here + halve_vjp(shape, v_image)
    assert v_image is not None, "there are scales"
    return v_image


def _min_side() -> int:
    side = SIDE
    for _ in range(N_SCALES - 1):
        side = 2 * (side - 1) + HALVING_SIDE
    return side


CLASSICAL = FeatureBank("classical: Gabor filters and colours", features, features_vjp, _min_side())
"""The classical bank."""
