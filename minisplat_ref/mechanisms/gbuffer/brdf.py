"""The share of the light that a surface of GGX microfacets reflects: the second factor of the split sum.

For a viewing direction v with mu = n.v, over directions h that are drawn from the lobe (Karis 2013)::

    l = 2 (v.h) h - v,   G_1(x) = x / (x (1 - k) + k),   k = roughness^2 / 2
    w = G_1(n.l) G_1(mu) (v.h) / ((n.h) mu),   F = (1 - v.h)^5        for n.l > 0

    S = mean (1 - F) w,   B = mean F w

and a surface whose reflectance from straight above is F_0 reflects F_0 S + B. Both are tabulated, for ``SIZE`` values
of mu and of the roughness, by ``N_SAMPLES`` points of Hammersley's sequence, and read bilinearly.
"""

import functools

import numpy as np

from minisplat_ref.types import Floats

SIZE = 32
N_SAMPLES = 1024
MU_MIN = 1e-3  # of the table's first row: mu is divided by
ALPHA_MIN = 1e-4


def hammersley(n: int) -> Floats:
    """Return n points [n, 2] of the unit square, evenly spread: i / n, and the binary digits of i reversed."""
    reversed_bits, digits = np.zeros(n), np.arange(n)
    place = 0.5
    while digits.any():
        reversed_bits += place * (digits & 1)
        digits, place = digits >> 1, place / 2
    return np.column_stack([(np.arange(n) + 0.5) / n, reversed_bits])


def integrate(mu: Floats, roughness: float, n_samples: int = N_SAMPLES) -> Floats:
    """Return S and B, [M, 2], for viewing cosines [M] above 0 and one roughness."""
    points = hammersley(n_samples)
    alpha = max(roughness * roughness, ALPHA_MIN)
    phi = 2 * np.pi * points[:, 0]
    cosine = np.sqrt((1 - points[:, 1]) / (1 + (alpha * alpha - 1) * points[:, 1]))  # n.h
    sine = np.sqrt(1 - cosine * cosine)
    v_h = np.sqrt(1 - mu * mu)[:, None] * sine * np.cos(phi) + mu[:, None] * cosine  # [M, n]
    n_l = 2 * v_h * cosine - mu[:, None]
    is_lit = (n_l > 0) & (v_h > 0)
    k = roughness * roughness / 2
    lit = np.where(is_lit, n_l, 1)
    shadowing = lit / (lit * (1 - k) + k) * (mu / (mu * (1 - k) + k))[:, None]
    w = np.where(is_lit, shadowing * v_h / (cosine * mu[:, None]), 0)
    fresnel = (1 - np.clip(v_h, 0, 1)) ** 5
    return np.stack([np.mean((1 - fresnel) * w, axis=1), np.mean(fresnel * w, axis=1)], axis=1)


@functools.cache
def table() -> Floats:
    """Return S and B, [SIZE, SIZE, 2], by mu and by roughness, both from 0 to 1."""
    mu = np.maximum(np.linspace(0, 1, SIZE), MU_MIN)
    return np.stack([integrate(mu, roughness) for roughness in np.linspace(0, 1, SIZE)], axis=1)


def reflectance(mu: Floats, roughness: Floats) -> tuple[Floats, Floats, Floats]:
    """Return S and B, [P, 2], for mu [P] and roughness [P] in [0, 1], with their derivatives [P, 2] by each of them."""
    values = table()
    cells, shares = [], []
    for x in (mu, roughness):
        scaled = np.clip(x, 0, 1) * (SIZE - 1)
        cells.append(np.minimum(scaled.astype(np.int64), SIZE - 2))
        shares.append((scaled - cells[-1])[:, None])
    (i, j), (a, b) = cells, shares
    corners = values[i, j], values[i + 1, j], values[i, j + 1], values[i + 1, j + 1]
    low, high = (1 - a) * corners[0] + a * corners[1], (1 - a) * corners[2] + a * corners[3]
    by_mu = (SIZE - 1) * ((1 - b) * (corners[1] - corners[0]) + b * (corners[3] - corners[2]))
    dtype = mu.dtype
    return ((1 - b) * low + b * high).astype(dtype), by_mu.astype(dtype), ((SIZE - 1) * (high - low)).astype(dtype)
