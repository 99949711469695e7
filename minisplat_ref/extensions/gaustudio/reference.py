"""The formulas of the background and of the loss on the sky: a ball of Gaussians, a map of directions, light behind.

There is no kernel: the ball is rendered by the renderer of 3DGS, and the rest is done once for each pixel.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Bools, Floats, Gaussians, Ints

GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))  # radians
BALL_COLUMNS = 5  # of the ball's parameter: three of colour, the logit of the opacity, the logarithm of the size
NEAR_POLE = 1e-12  # of the sine of the polar angle, where longitude is not defined


# --- the ball ---


def fibonacci_directions(n: int) -> Floats:
    """Return n unit directions [n, 3], float64, evenly spread: a Fibonacci lattice.

    ::

        y_k = 1 - 2 k / (n - 1),   r_k = sqrt(1 - y_k^2),   theta_k = k pi (3 - sqrt 5)
        d_k = (r_k cos theta_k, y_k, r_k sin theta_k)        k = 0 ... n - 1
    """
    k = np.arange(n)
    y = 1 - 2 * k / max(n - 1, 1)
    r = np.sqrt(np.maximum(1 - y * y, 0))
    return np.column_stack([r * np.cos(k * GOLDEN_ANGLE), y, r * np.sin(k * GOLDEN_ANGLE)])


def ball_gaussians(ball: Floats) -> Gaussians:
    """Return the Gaussians of a ball of radius 1 around the origin: round, in the directions of the lattice.

    Parameters
    ----------
    ball : ndarray of shape (K, 5)
        Of each Gaussian the coefficients of its colour, the logit of its opacity, and the logarithm of its standard
        deviation, radians.

    Returns
    -------
    Gaussians
        In the dtype of ``ball``, without view-dependent colour.
    """
    n, dtype = len(ball), ball.dtype
    return Gaussians(
        means=fibonacci_directions(n).astype(dtype),
        quats=np.tile(np.array([1, 0, 0, 0], dtype), (n, 1)),
        log_scales=np.repeat(ball[:, 4:], 3, axis=1),
        opacity_logits=ball[:, 3].copy(),
        sh_dc=ball[:, :3].copy(),
        sh_rest=np.zeros((n, 0, 3), dtype),
    )


def ball_gaussians_vjp(v: Gaussians) -> Floats:
    """Gradient [K, 5] of :func:`ball_gaussians`: a size is that of three axes, so ``v_size = sum_j v_log_s_j``."""
    return np.column_stack([v.sh_dc, v.opacity_logits, v.log_scales.sum(axis=1)])


# --- the map ---


class Lookup(NamedTuple):
    """The places at which a map is read: four texels and two weights for each direction."""

    rows: tuple[Ints, Ints]
    """[P] the upper and the lower row."""
    columns: tuple[Ints, Ints]
    """[P] the left and the right column."""
    a: Floats
    """[P] weight of the right column."""
    b: Floats
    """[P] weight of the lower row."""


def find_texels(directions: Floats, shape: tuple[int, int]) -> Lookup:
    """Return the texels around unit directions [P, 3] in a map of latitudes and longitudes, ``shape`` rows and columns.

    ::

        phi = atan2(d_y, d_x),  theta = arccos d_z
        x = (phi / 2 pi + 1 / 2) W - 1 / 2,   y = theta / pi H - 1 / 2

    Columns continue around the circle; the first and the last row reach to the poles.
    """
    height, width = shape
    x = (np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) + 0.5) * width - 0.5
    theta = np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), directions[:, 2])
    y = np.clip(theta / np.pi * height - 0.5, 0, height - 1)
    left, top = np.floor(x).astype(np.int64), np.minimum(np.floor(y).astype(np.int64), max(height - 2, 0))
    dtype = directions.dtype
    rows = top, np.minimum(top + 1, height - 1)
    return Lookup(rows, (left % width, (left + 1) % width), (x - left).astype(dtype), (y - top).astype(dtype))


def look_up(sky_map: Floats, found: Lookup) -> Floats:
    """Return the colours [P, 3] of a map [H, W, 3] at directions, interpolated.

    ::

        s = (1 - b) ((1 - a) m_00 + a m_01) + b ((1 - a) m_10 + a m_11)
    """
    (upper, lower), (left, right) = found.rows, found.columns
    a, b = found.a[:, None], found.b[:, None]
    above = (1 - a) * sky_map[upper, left] + a * sky_map[upper, right]
    return (1 - b) * above + b * ((1 - a) * sky_map[lower, left] + a * sky_map[lower, right])


def look_up_vjp(sky_map: Floats, directions: Floats, found: Lookup, v_colors: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`look_up` with respect to the map, and of it after :func:`find_texels` to the directions.

    ::

        v_m_ij = sum_p (weight of texel ij in p) v_s
        v_a = v_s . ((1 - b) (m_01 - m_00) + b (m_11 - m_10)),   v_b likewise,   v_x = v_a,  v_y = v_b
        v_d = v_x W / 2 pi dphi/dd + v_y H / pi dtheta/dd
        dphi/dd = (-d_y, d_x, 0) / r^2,   dtheta/dd = (d_x d_z / r, d_y d_z / r, -r),   r^2 = d_x^2 + d_y^2

    for unit d. Beyond the middle of the first and the last row the map does not change with theta, and v_y is 0.

    Parameters
    ----------
    sky_map : ndarray of shape (H, W, 3)
    directions : ndarray of shape (P, 3)
        Unit vectors, world frame.
    found : Lookup
        Of them.
    v_colors : ndarray of shape (P, 3)

    Returns
    -------
    v_map : ndarray of shape (H, W, 3)
        float64, because it sums over many pixels.
    v_directions : ndarray of shape (P, 3)
        float64.
    """
    height, width = sky_map.shape[:2]
    (upper, lower), (left, right) = found.rows, found.columns
    a, b = found.a[:, None].astype(np.float64), found.b[:, None].astype(np.float64)
    v = v_colors.astype(np.float64)
    v_map = np.zeros(sky_map.shape)
    corners = ((upper, left, (1 - a) * (1 - b)), (upper, right, a * (1 - b)), (lower, left, (1 - a) * b))
    for row, column, weight in (*corners, (lower, right, a * b)):
        np.add.at(v_map, (row, column), weight * v)
    m_00, m_01, m_10, m_11 = (sky_map[i, j].astype(np.float64) for i in found.rows for j in found.columns)
    v_x = np.sum(v * ((1 - b) * (m_01 - m_00) + b * (m_11 - m_10)), axis=1)
    v_y = np.sum(v * ((1 - a) * (m_10 - m_00) + a * (m_11 - m_01)), axis=1)
    d_x, d_y, d_z = directions.astype(np.float64).T
    r = np.maximum(np.hypot(d_x, d_y), NEAR_POLE)
    is_between = np.abs(np.arctan2(r, d_z) / np.pi * height - height / 2) < (height - 1) / 2
    v_phi, v_theta = v_x * width / (2 * np.pi), np.where(is_between, v_y * height / np.pi, 0)
    zero = np.zeros_like(d_x)
    v_directions = v_phi[:, None] * np.column_stack([-d_y, d_x, zero]) / (r * r)[:, None]
    return v_map, v_directions + v_theta[:, None] * np.column_stack([d_x * d_z / r, d_y * d_z / r, -r])


# --- behind the scene ---


def put_behind(image: Floats, alpha: Floats, light: Floats) -> Floats:
    """Return an image [H, W, 3] over black with light [H, W, 3] behind it: ``c' = c + (1 - alpha) s``."""
    return image + (1 - alpha[..., None]) * light


def put_behind_vjp(alpha: Floats, light: Floats, v_image: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`put_behind` with respect to alpha and the light; that of the image is v itself.

    ::

        v_alpha = -s . v_c',   v_s = (1 - alpha) v_c'
    """
    return -np.sum(light * v_image, axis=2), (1 - alpha[..., None]) * v_image


# --- the loss ---


def opacity_in(alpha: Floats, is_sky: Bools) -> tuple[float, Floats]:
    """Return the mean opacity of the scene in a mask [H, W], and its derivative [H, W]: 0 where the mask is empty.

    ::

        L = 1 / |M| sum_{p in M} alpha_p,   v_alpha_p = 1 / |M| within M
    """
    n = max(int(np.count_nonzero(is_sky)), 1)
    return float(np.sum(alpha[is_sky], dtype=np.float64)) / n, (is_sky / n).astype(alpha.dtype)
