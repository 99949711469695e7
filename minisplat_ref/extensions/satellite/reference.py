"""Light per pixel: the sun's shadow map, and the radiometry of each photograph; formulas beside their VJPs (EOGS).

A pixel (u, v) whose rendered altitude is h lies in the sun's image at ``(u, v) - g h``: g is the shift, in pixels per
unit of altitude, along the sun's rays: the paper's ``M = [[1, 0, -g_u], [0, 1, -g_v], [0, 0, 1]]``. There the
sun sees altitude h_s. Higher than h, something is between::

    s = exp(0.4 min(h - h_s, 0))
    I = (s + (1 - s) k) (C a + c)

a is the albedo that splatting renders, C [3, 3] and c [3] the radiometry of the photograph, and k [3] the light of the
sky in the shadow.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Bools, Floats, Ints

DARKENING = 0.4  # per unit of altitude, a metre
MIN_ALPHA = 0.05  # fainter pixels have no altitude; they count as if they were as opaque


class AltitudeGradient(NamedTuple):
    """Gradient of :func:`altitudes`."""

    sums: Floats  # [H, W]
    alpha: Floats  # [H, W]


def altitudes(sums: Floats, alpha: Floats) -> Floats:
    """Return the altitude of each pixel, ``h = -D / max(alpha, 0.05)``; a depth is a negative altitude.

    Parameters
    ----------
    sums : ndarray of shape (H, W)
        D, ``sum w z``.
    alpha : ndarray of shape (H, W)
    """
    return -sums / np.maximum(alpha, alpha.dtype.type(MIN_ALPHA))


def altitudes_vjp(sums: Floats, alpha: Floats, v_altitudes: Floats) -> AltitudeGradient:
    """Gradient of :func:`altitudes`: ``v_D = -v_h / a``, ``v_a = -v_h h / a`` where a is above its minimum."""
    a = np.maximum(alpha, alpha.dtype.type(MIN_ALPHA))
    v_sums = -v_altitudes / a
    return AltitudeGradient(v_sums, np.where(alpha > MIN_ALPHA, v_sums * altitudes(sums, alpha), 0))


class Sample(NamedTuple):
    """The places between the pixels of an image that are read, with the values there."""

    values: Floats  # [H, W, D]
    corners: Ints  # [4, H, W] flat indices
    weights: Floats  # [4, H, W]
    slopes: Floats  # [2, H, W, D] d values / d x and / d y; 0 beyond the border


def sample(image: Floats, x: Floats, y: Floats) -> Sample:
    """Return an image [H', W', D] at places x, y [H, W], bilinear between pixel centres at 0.5, constant outside."""
    height, width, _ = image.shape
    places, lows, inside = [], [], []
    for place, size in ((x, width), (y, height)):
        at = place - 0.5
        kept = np.clip(at, 0, size - 1)
        low = np.clip(np.floor(kept).astype(np.int64), 0, max(size - 2, 0))
        places.append(kept - low)
        lows.append(low)
        inside.append((at > 0) & (at < size - 1))
    (fx, fy), (x0, y0) = places, lows
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    corners = np.stack([y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1])
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]).astype(image.dtype)
    at = image.reshape(-1, image.shape[2])[corners]  # [4, H, W, D]
    fx, fy = fx[..., None], fy[..., None]
    by_x = ((at[1] - at[0]) * (1 - fy) + (at[3] - at[2]) * fy) * inside[0][..., None]
    by_y = ((at[2] - at[0]) * (1 - fx) + (at[3] - at[1]) * fx) * inside[1][..., None]
    values = np.einsum("khw,khwd->hwd", weights, at)
    return Sample(values, corners, weights, np.stack([by_x, by_y]).astype(image.dtype))


def sample_vjp(sampled: Sample, shape: tuple[int, ...], v_values: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`sample`: of the image, to whose corners ``v`` goes by their weights, and [2, H, W] of x and y.

    Parameters
    ----------
    sampled : Sample
    shape : (H', W', D)
        Of the image.
    v_values : ndarray of shape (H, W, D)
    """
    parts = sampled.weights[..., None] * v_values  # [4, H, W, D]
    size = shape[0] * shape[1]
    flat = [np.bincount(sampled.corners.ravel(), parts[..., d].ravel(), size) for d in range(shape[2])]
    v_image = np.stack(flat, axis=-1).reshape(shape).astype(v_values.dtype)
    return v_image, np.sum(sampled.slopes * v_values, axis=3)


class ShadowTape(NamedTuple):
    """The values that :func:`shadows` keeps."""

    shadows: Floats  # [H, W] s
    is_shaded: Bools  # [H, W] whether h < h_s
    sampled: Sample
    shift: tuple[float, float]
    shape: tuple[int, ...]  # of the sun's image


def shadows(altitude: Floats, of_sun: Floats, shift: tuple[float, float], margin: tuple[int, int]) -> ShadowTape:
    """Return s of each pixel.

    Parameters
    ----------
    altitude : ndarray of shape (H, W)
        h.
    of_sun : ndarray of shape (H', W')
        h_s, in the sun's image.
    shift : (g_u, g_v)
        Pixels per unit of altitude.
    margin : (m_u, m_v)
        By how many pixels the sun's image is larger at each side.
    """
    dtype = altitude.dtype
    height, width = altitude.shape
    x = np.arange(width) + 0.5 + margin[0] - shift[0] * altitude
    y = np.arange(height)[:, None] + 0.5 + margin[1] - shift[1] * altitude
    sampled = sample(of_sun[..., None], x, y)
    below = altitude - sampled.values[..., 0]
    s = np.exp(DARKENING * np.minimum(below, 0)).astype(dtype)
    return ShadowTape(s, below < 0, sampled, shift, (*of_sun.shape, 1))


def shadows_vjp(tape: ShadowTape, v_shadows: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`shadows` with respect to h and h_s.

    With ``v = 0.4 s v_s`` where ``h < h_s``, and ``p = (u, v) - g h``::

        v_hs = -v at the corners of p,   v_h = v + g . v dh_s/dp
    """
    v = np.where(tape.is_shaded, DARKENING * tape.shadows * v_shadows, 0).astype(v_shadows.dtype)
    v_of_sun, v_places = sample_vjp(tape.sampled, tape.shape, -v[..., None])
    return v - tape.shift[0] * v_places[0] - tape.shift[1] * v_places[1], v_of_sun[..., 0]


class LightGradient(NamedTuple):
    """Gradient of :func:`light`."""

    albedo: Floats  # [H, W, 3]
    shadows: Floats  # [H, W]
    radiometry: Floats  # [3, 4]
    in_shadow: Floats  # [3]


def light(albedo: Floats, shadow: Floats, radiometry: Floats, in_shadow: Floats) -> Floats:
    """Return the photograph [H, W, 3], ``I = (s + (1 - s) k) (C a + c)``.

    Parameters
    ----------
    albedo : ndarray of shape (H, W, 3)
        a.
    shadow : ndarray of shape (H, W)
        s.
    radiometry : ndarray of shape (3, 4)
        C, then c.
    in_shadow : ndarray of shape (3,)
        k.
    """
    s = shadow[..., None]
    return (s + (1 - s) * in_shadow) * (albedo @ radiometry[:, :3].T + radiometry[:, 3])


def light_vjp(albedo: Floats, shadow: Floats, radiometry: Floats, in_shadow: Floats, v_image: Floats) -> LightGradient:
    """Gradient of :func:`light`.

    With ``f = s + (1 - s) k`` and ``l = C a + c``::

        v_l = f v,   v_C = sum v_l a^T,   v_c = sum v_l,   v_a = C^T v_l
        v_f = l v,   v_s = sum (1 - k) v_f,   v_k = sum (1 - s) v_f
    """
    s, C = shadow[..., None], radiometry[:, :3]
    v_l = (s + (1 - s) * in_shadow) * v_image
    v_f = (albedo @ C.T + radiometry[:, 3]) * v_image
    v_C = np.einsum("hwi,hwj->ij", v_l, albedo)
    v_c = v_l.sum(axis=(0, 1))
    return LightGradient(
        v_l @ C, np.sum((1 - in_shadow) * v_f, axis=2), np.column_stack([v_C, v_c]), np.sum((1 - s) * v_f, axis=(0, 1))
    )
