"""The formulas of MVG-Splatting: near, middle and far depths by a smoothed histogram, and the loss on depth steps."""

from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Bools, Floats, Ints

N_BINS = 512
BANDWIDTH = 0.9  # Silverman's factor
HALF = 0.5  # of the peak: denser depths are the middle
NEAR, MIDDLE, FAR = 0, 1, 2


class Density(NamedTuple):
    """The distribution of depths."""

    depths: Floats
    """[B] middles of the bins, world units."""
    values: Floats
    """[B] per world unit; their integral is 1."""


def depth_density(depths: Floats) -> Density:
    """Return the kernel density of depths, by convolution in the Fourier domain.

    With the histogram h, and the Gaussian kernel whose width is Silverman's::

        p = irfft(rfft(h) exp(-(2 pi f sigma)^2 / 2)),   sigma = 0.9 min(std, IQR / 1.34) P^(-1/5)

    Parameters
    ----------
    depths : ndarray of shape (P,)
        World units, not all equal.
    """
    low, high = float(depths.min()), float(depths.max())
    quartiles = np.quantile(depths, [0.25, 0.75])
    spread = min(float(depths.std()), float(quartiles[1] - quartiles[0]) / 1.34) or float(depths.std())
    sigma = BANDWIDTH * spread * len(depths) ** -0.2
    margin = 4 * sigma  # so that what wraps around is zero
    h, edges = np.histogram(depths, N_BINS, (low - margin, high + margin))
    width = edges[1] - edges[0]
    frequencies = np.fft.rfftfreq(N_BINS, width)  # per world unit
    smooth = np.fft.irfft(np.fft.rfft(h) * np.exp(-0.5 * (2 * np.pi * frequencies * sigma) ** 2), N_BINS)
    return Density((edges[:-1] + edges[1:]) / 2, np.maximum(smooth, 0) / (len(depths) * width))


def depth_cuts(depths: Floats) -> tuple[float, float]:
    """Return the depths between near and middle, and between middle and far.

    The middle is the interval around the highest peak of the density in which it is above half of it. The quantiles at
    which depths are cut adapt to the scene in this way: a wall behind an object has a narrow peak, and all of the
    object is near.

    Parameters
    ----------
    depths : ndarray of shape (P,)
        World units, at least one.
    """
    if np.ptp(depths) == 0:
        return float(depths[0]), float(depths[0])
    density = depth_density(depths)
    peak = int(np.argmax(density.values))
    is_low = density.values < HALF * density.values[peak]
    before, after = np.flatnonzero(is_low[:peak]), np.flatnonzero(is_low[peak:])
    first = before[-1] if len(before) else 0
    last = peak + after[0] if len(after) else N_BINS - 1
    return float(density.depths[first]), float(density.depths[last])


def levels_of(depths: Floats, cuts: tuple[float, float]) -> Ints:
    """Return 0, 1 or 2 for each depth: near, middle, far."""
    near, far = cuts
    return np.where(depths < near, NEAR, np.where(depths > far, FAR, MIDDLE))


def on_grid(shape: tuple[int, int], stride: int, corner: tuple[int, int]) -> Bools:
    """Return which pixels [H, W] are those of every ``stride``-th row and column, from a corner on; none for 0."""
    chosen = np.zeros(shape, bool)
    if stride:
        chosen[corner[0] % stride :: stride, corner[1] % stride :: stride] = True
    return chosen


def edge_aware_steps(depth: Floats, image: Floats, sharpness: float) -> float:
    """Return the mean size of depth steps between neighbours, where the photograph has no edge.

    ::

        L = 1 / P sum_pq |D_p - D_q| exp(-k |I_p - I_q|)

    over the pairs of a pixel and its right or lower neighbour that both have a depth; |I_p - I_q| is the mean over the
    channels, and P the number of pixels.

    Parameters
    ----------
    depth : ndarray of shape (H, W)
        0 where there is none.
    image : ndarray of shape (H, W, 3)
        RGB in [0, 1].
    sharpness : float
        k.
    """
    return sum(float(np.sum(w * np.abs(step))) for step, w in _steps(depth, image, sharpness)) / depth.size


def edge_aware_steps_vjp(depth: Floats, image: Floats, sharpness: float) -> Floats:
    """Gradient [H, W] of :func:`edge_aware_steps`: ``v_D_q = w sign(D_q - D_p) / P``, and the opposite for p."""
    v_right, v_down = (w * np.sign(step) / depth.size for step, w in _steps(depth, image, sharpness))
    v_depth = np.zeros_like(depth)
    v_depth[:, 1:] += v_right
    v_depth[:, :-1] -= v_right
    v_depth[1:] += v_down
    v_depth[:-1] -= v_down
    return v_depth


def _steps(depth: Floats, image: Floats, sharpness: float) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Return the depth steps and weights of pairs to the right, and of pairs down."""
    has_depth = depth > 0

    def pairs(axis: int) -> tuple[Floats, Floats]:
        apart = np.mean(np.abs(np.diff(image, axis=axis)), axis=2, dtype=depth.dtype)
        both = has_depth[:, 1:] & has_depth[:, :-1] if axis == 1 else has_depth[1:] & has_depth[:-1]
        return np.diff(depth, axis=axis), np.exp(-depth.dtype.type(sharpness) * apart) * both

    return pairs(1), pairs(0)
