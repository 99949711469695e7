"""The losses of G-Style with their gradients, and the match of colours; in NumPy."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Floats, Ints

LENGTH_FLOOR = 1e-6  # added to a vector's squared length, in squares: a vector may be zero
BLOCK = 1 << 22  # cosines at a time
RANK_TOL = 1e-6  # of the largest variance: below, colours do not vary in that direction

# --- colours ---


class ColorMap(NamedTuple):
    """An affine map of colours: ``x' = M (x - source) + target``."""

    M: Floats
    """[3, 3]."""
    source: Floats
    """[3] mean of the mapped colours."""
    target: Floats
    """[3] mean of the result."""

    def __call__(self, colors: Floats) -> Floats:
        """Return colours [..., 3] in [0, 1] as they become; they may leave [0, 1]."""
        return (colors - self.source) @ self.M.T + self.target


def match_colors(content: Floats, style: Floats) -> ColorMap:
    """Return the map that gives the content the mean and covariance of the style: ``M = C_s^(1/2) C_c^(-1/2)``.

    Both roots are symmetric. In a direction in which the content does not vary, M is zero: photographs in grey stay on
    a line.

    Parameters
    ----------
    content, style : ndarray of shape (P, 3), (Q, 3)
        Colours in [0, 1].
    """
    M = _root(np.cov(style.T, bias=True), 0.5) @ _root(np.cov(content.T, bias=True), -0.5)
    return ColorMap(M, content.mean(axis=0), style.mean(axis=0))


def _root(covariance: Floats, power: float) -> Floats:
    values, axes = np.linalg.eigh(covariance)
    is_kept = values > RANK_TOL * max(values[-1], np.finfo(float).tiny)
    roots = np.where(is_kept, np.where(is_kept, values, 1.0) ** power, 0.0)
    return (axes * roots) @ axes.T


# --- features ---


def unit_rows(vectors: Floats) -> tuple[Floats, Floats]:
    """Return ``u = F / n`` and the lengths ``n = sqrt(|F|^2 + floor)`` of vectors [..., C]; n is [..., 1]."""
    lengths = np.sqrt(np.sum(vectors * vectors, axis=-1, keepdims=True) + vectors.dtype.type(LENGTH_FLOOR**2))
    return vectors / lengths, lengths


def nearest_rows(units: Floats, style: Floats) -> Ints:
    """Return [P] the row of ``style`` [Q, C] with the largest cosine for each row of ``units`` [P, C]."""
    n_rows = max(1, BLOCK // len(style))
    ids = [np.argmax(units[start : start + n_rows] @ style.T, axis=1) for start in range(0, len(units), n_rows)]
    return np.concatenate(ids)


def nnfm(map_: Floats, style: Floats, ids: Ints) -> tuple[float, Floats]:
    """Return the loss of nearest neighbours, ``mean_p (1 - u_p . s_id(p))``, and its gradient.

    With u = F / n and n = sqrt(|F|^2 + floor), ``dL/du_p = -s_id(p) / P``, and from ``du = dF / n - u (u . dF) / n``::

        dL/dF = (dL/du - u (u . dL/du)) / n

    The neighbours are held constant: where they change, two are equally near.

    Parameters
    ----------
    map_ : ndarray of shape (h, w, C)
        Features F.
    style : ndarray of shape (Q, C)
        Units s, of :func:`unit_rows`.
    ids : ndarray of shape (h w,)
        Of :func:`nearest_rows`.
    """
    u, n = unit_rows(map_.reshape(-1, map_.shape[2]))  # [P, C], [P, 1]
    v_u = -style[ids] / map_.dtype.type(len(u))
    value = 1 + float(np.sum(v_u * u))
    v = (v_u - u * np.sum(u * v_u, axis=1, keepdims=True)) / n
    return value, v.reshape(map_.shape)


def mean_square(map_: Floats, target: Floats) -> tuple[float, Floats]:
    """Return the content loss ``mean (F - T)^2`` of features [h, w, C], and its gradient ``2 (F - T) / (h w C)``."""
    difference = map_ - target
    return float(np.mean(difference * difference)), difference * map_.dtype.type(2 / map_.size)


def total_variation(image: Floats) -> tuple[float, Floats]:
    """Return ``mean (x(i+1, j) - x(i, j))^2 + mean (x(i, j+1) - x(i, j))^2`` of an image [H, W, 3], and its gradient.

    Each difference d adds ``2 d / count`` to the later pixel and takes it from the earlier one.
    """
    value, v_image = 0.0, np.zeros_like(image)
    for axis in (0, 1):
        later, earlier = [slice(None)] * 2, [slice(None)] * 2
        later[axis], earlier[axis] = slice(1, None), slice(None, -1)
        differences = np.diff(image, axis=axis)
        value += float(np.mean(differences * differences))
        v = differences * image.dtype.type(2 / differences.size)
        v_image[tuple(later)] += v
        v_image[tuple(earlier)] -= v
    return value, v_image


class FeatureWeights(NamedTuple):
    """Factors of the two losses on features."""

    nnfm: float
    content: float


def feature_loss(
    maps: Sequence[Floats], content: Sequence[Floats], styles: Sequence[Floats], weights: FeatureWeights
) -> tuple[float, list[Floats]]:
    """Return the mean over the maps of ``w_n NNFM + w_c content``, and its gradient with respect to each map.

    Parameters
    ----------
    maps, content : sequence of ndarray of shape (h, w, C)
        Features of the rendered image, and of the photograph that it should show.
    styles : sequence of ndarray of shape (Q, C)
        Units of the style's features, of :func:`unit_rows`.
    weights : FeatureWeights
    """
    total = 0.0
    v_maps: list[Floats] = []
    for map_, target, style in zip(maps, content, styles, strict=True):
        dtype = map_.dtype.type
        units, _ = unit_rows(map_.reshape(-1, map_.shape[2]))
        near, v_near = nnfm(map_, style, nearest_rows(units, style))
        same, v_same = mean_square(map_, target)
        total += (weights.nnfm * near + weights.content * same) / len(maps)
        v_maps.append(dtype(weights.nnfm / len(maps)) * v_near + dtype(weights.content / len(maps)) * v_same)
    return total, v_maps
