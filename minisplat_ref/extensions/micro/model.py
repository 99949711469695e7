"""The formulas of Micro-splatting: the trace penalty beside its gradient, the detail of a photograph, and likeness."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import sobel

from minisplat_ref.constants import LUMA
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Bools, Floats, Ints

SOBEL_SUM = 8.0  # a ramp of one unit per pixel gives this


def traces(log_scales: Floats) -> Floats:
    """Return ``tr(Sigma_k) = sum_j s_kj^2`` [N], world units squared, of scales ``s = exp(log_scales)`` [N, 3]."""
    with np.errstate(over="ignore"):
        return np.exp(2 * log_scales).sum(axis=1)


def trace_penalty(log_scales: Floats, limit: float) -> float:
    """Return ``mean_k max(tr(Sigma_k) / tau - 1, 0)``.

    The mean replaces the paper's sum, and the trace is in units of its limit, so one weight fits scenes of any size and
    any number of Gaussians.

    Parameters
    ----------
    log_scales : ndarray of shape (N, 3)
        Logarithms of the standard deviations, world units; N may be 0.
    limit : float
        tau, world units squared; above 0.
    """
    excess = np.maximum(traces(log_scales) / limit - 1, 0)  # [N]
    return float(np.mean(excess, dtype=np.float64)) if len(excess) else 0.0


def trace_penalty_vjp(log_scales: Floats, limit: float, v_penalty: float = 1.0) -> Floats:
    """Gradient of :func:`trace_penalty` with respect to the logarithms of the scales.

    With ``d tr / d log s_j = 2 s_j^2``::

        v_log_s_kj = 2 s_kj^2 / (tau N) v_P     where tr(Sigma_k) > tau, else 0

    Parameters
    ----------
    log_scales, limit
        As for the forward function.
    v_penalty : float
        v_P.

    Returns
    -------
    ndarray of shape (N, 3)
        In the dtype of ``log_scales``.
    """
    is_over = traces(log_scales) > limit  # [N]
    factor = log_scales.dtype.type(2 * v_penalty / (limit * max(len(log_scales), 1)))
    return np.where(is_over[:, None], factor * np.exp(2 * log_scales), log_scales.dtype.type(0))


def detail_map(photograph: NDArray) -> Floats:
    """Return the strength of the edges [H, W], relative to its mean over the photograph.

    ``g = |grad Y|`` of the luminance Y by Sobel's kernels, divided by its mean; 1 everywhere in a photograph without
    edges.

    Parameters
    ----------
    photograph : ndarray of shape (H, W, 3)
        RGB in any unit; gamma-encoded, as photographs are.
    """
    luminance = photograph @ np.array(LUMA)
    g = np.hypot(sobel(luminance, axis=0), sobel(luminance, axis=1)) / SOBEL_SUM  # [H, W] per pixel
    mean = g.mean()
    return g / mean if mean > 0 else np.ones_like(g)


def box_means(image: Floats, boxes: Ints) -> Floats:
    """Return the mean of an image over each box of pixels, 0 where a box is empty.

    A summed-area table S, whose entry ``S[y, x]`` is the sum of all pixels above and to the left, gives::

        mean = (S[y1, x1] - S[y0, x1] - S[y1, x0] + S[y0, x0]) / ((y1 - y0) (x1 - x0))

    Parameters
    ----------
    image : ndarray of shape (H, W)
        Any values.
    boxes : ndarray of shape (N, 4)
        Half-open x0, y0, x1, y1 inside the image, pixels.

    Returns
    -------
    ndarray of shape (N,), float64
    """
    S = np.pad(image.astype(np.float64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))  # [H + 1, W + 1]
    x0, y0, x1, y1 = boxes.T
    areas = np.maximum(x1 - x0, 0) * np.maximum(y1 - y0, 0)  # [N]
    sums = S[y1, x1] - S[y0, x1] - S[y1, x0] + S[y0, x0]
    return np.where(areas > 0, sums / np.maximum(areas, 1), 0.0)


def are_alike(distances: Floats, sizes: Floats, colors: Floats, *, reach: float, color_reach: float) -> Bools:
    """Return which pairs of Gaussians are near and similar enough to become one.

    They are near if they are closer than ``reach`` times the smaller of their sizes, and similar if their colours
    differ by less than ``color_reach`` in every channel and neither is more than twice as large as the other.

    Parameters
    ----------
    distances : ndarray of shape (P,)
        Distances between the centres, world units.
    sizes : ndarray of shape (P, 2)
        ``sqrt(tr(Sigma))`` of both, world units.
    colors : ndarray of shape (P, 2, 3)
        Colours of degree 0, from 0 to 1.
    reach, color_reach : float
        The limits above.

    Returns
    -------
    ndarray of shape (P,) of booleans
    """
    smaller, larger = sizes.min(axis=1), sizes.max(axis=1)
    differences = np.abs(colors[:, 0] - colors[:, 1]).max(axis=1)
    return (distances < reach * smaller) & (differences < color_reach) & (larger <= 2 * smaller)


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the penalty with a limit that half of the Gaussians exceed; all backends share it."""
    log_scales = setting.gaussians.log_scales
    ordered, middle = np.sort(traces(log_scales)), len(log_scales) // 2
    limit = float(ordered[middle - 1 : middle + 1].mean())  # between traces: no kink there

    def function(log_scales: Floats) -> Point:
        return Point((np.asarray(trace_penalty(log_scales, limit)),), (traces(log_scales) > limit,))

    def vjp(v_penalty: Floats) -> tuple[Floats, ...]:
        return (trace_penalty_vjp(log_scales, limit, float(v_penalty)),)

    return (Stage("trace_penalty", {"log_scales": log_scales}, ("penalty",), function, vjp),)
