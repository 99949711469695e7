"""The formulas of G-Style in NumPy: matched colours, losses with their gradients, and splits; the gradient check.

A Gaussian that is split becomes a grid of children in the plane of its two longest axes. With two children per axis,
each at a distance d from the middle and with the standard deviation s', the variance stays where ``d^2 + s'^2 = s^2``;
in a row of four, at d and 3 d, where ``5 d^2 + s'^2 = s^2``. So the children leave no holes, and cover the same area as
the parent. The shortest axis stays.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.mechanisms.features import network
from minisplat_ref.mechanisms.features.bank import FeatureBank
from minisplat_ref.mechanisms.features.filters import CLASSICAL
from minisplat_ref.mechanisms.features.layers import max_pool_vjp
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.strategy.ops import Edit, concat, n_rows, take
from minisplat_ref.types import Floats, Gaussians, Ints

LENGTH_FLOOR = 1e-6  # added to a vector's squared length, in squares: a vector may be zero
BLOCK = 1 << 22  # cosines at a time
RANK_TOL = 1e-6  # of the largest variance: below, colours do not vary in that direction

SHRINK = 1.6
"""The divisor of a scale that two children share, as in 3DGS; a row of four divides it by the square."""
GRIDS = {4: (2, 2), 8: (4, 2)}
"""Children along the longest and the second axis, by their number."""

Part = tuple[slice, slice]
WHOLE: Part = (slice(None), slice(None))
PATCH: Part = (slice(14, 21), slice(13, 20))  # all pixels would take minutes; every scale sees these


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


# --- splits ---


def areas(gaussians: Any) -> Floats:
    """Return [N] the product of the two largest scales, squared world units."""
    return np.exp(np.sort(gaussians.log_scales.astype(np.float64), axis=1)[:, 1:].sum(axis=1))


def make_children(gaussians: Gaussians, parent_ids: Ints, n_children: int) -> Gaussians:
    """Return the children of each parent: ``n_children`` times P rows, the first child of every parent first.

    Parameters
    ----------
    gaussians : Gaussians
    parent_ids : ndarray of shape (P,)
    n_children : int
        4 or 8.
    """
    parents = take(gaussians, parent_ids)
    order = np.argsort(-parents.log_scales, axis=1, kind="stable")  # [P, 3] longest axis first
    rows = np.arange(len(parent_ids))
    log_scales, offsets = parents.log_scales.copy(), [np.zeros((1, len(rows), 3))]
    for axis, n in zip(order.T[:2], GRIDS[n_children], strict=True):
        shrink = SHRINK if n == 2 else SHRINK**2
        log_scales[rows, axis] -= log_scales.dtype.type(math.log(shrink))
        places = 2 * np.arange(n) - (n - 1)  # -1, 1, or -3, -1, 1, 3
        d = math.sqrt((1 - shrink**-2) / np.mean(places**2))  # mean (places d)^2 + shrink^-2 = 1
        steps = np.zeros((n, len(rows), 3))
        steps[:, rows, axis] = d * places[:, None] * np.exp(parents.log_scales[rows, axis].astype(np.float64))
        offsets.append(steps)
    grid = (offsets[1][:, None] + offsets[2][None]).reshape(n_children, len(rows), 3)  # in the parents' axes
    rotations = rotation_matrices(parents.quats.astype(np.float64))  # [P, 3, 3]
    moved = parents.means + np.einsum("pij,kpj->kpi", rotations, grid)  # [n, P, 3]
    children = take(parents, np.tile(rows, n_children))
    return children._replace(
        means=moved.reshape(-1, 3).astype(parents.means.dtype), log_scales=np.tile(log_scales, (n_children, 1))
    )


def split(gaussians: Gaussians, is_split: Any, n_children: int) -> Edit:
    """Return the edit that replaces the chosen rows [N] by their children, behind the others."""
    survivors, parents = np.flatnonzero(~is_split), np.flatnonzero(is_split)
    parent_ids = np.concatenate([survivors, np.tile(parents, n_children)])
    population = concat(take(gaussians, survivors), make_children(gaussians, parents, n_children))
    return Edit(population, parent_ids, np.arange(len(parent_ids)) >= len(survivors))


def largest(values: Floats, threshold: float, max_share: float) -> Any:
    """Return [N] whether a value is above the threshold, and among the largest ``max_share`` of all."""
    n_most = int(max_share * len(values))
    is_chosen = np.zeros(len(values), bool)
    is_chosen[np.argsort(-values, kind="stable")[:n_most]] = True
    return is_chosen & (values > threshold)


def split_large(gaussians: Gaussians, *, factor: float, max_share: float, n_children: int) -> Edit:
    """Split Gaussians whose area is above ``mean + factor std``, the largest first, at most ``max_share`` of all."""
    found = areas(gaussians)
    threshold = found.mean() + factor * found.std() if n_rows(gaussians) else 0.0
    return split(gaussians, largest(found, threshold, max_share), n_children)


def cut_stretch(log_scales: Floats, max_ratio: float) -> Floats:
    """Return log-scales [N, 3] whose longest axis is at most ``max_ratio`` times the second."""
    ordered = np.sort(log_scales, axis=1)
    limits = ordered[:, 1] + log_scales.dtype.type(math.log(max_ratio))
    return np.minimum(log_scales, limits[:, None])


# --- the gradient check ---


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the stages; there is one implementation, in NumPy, whatever the backend."""
    small, large = rng.uniform(size=(9, 8, 3)), rng.uniform(size=(37, 38, 3))
    return (
        feature_stage(CLASSICAL, large, PATCH, "classical features"),
        feature_stage(tiny_network(rng), small, WHOLE, "network features"),
        loss_stage(rng),
        Stage(
            "total_variation",
            {"image": small},
            ("loss",),
            lambda image: Point((np.asarray(total_variation(image)[0]),)),
            lambda v: (v * total_variation(small)[1],),
        ),
    )


def tiny_network(rng: np.random.Generator) -> FeatureBank:
    """Return a network of three random convolutions, two of one size and tapped, one of half the size."""
    sizes = ((4, 3, 3), (5, 4, 1), (6, 5, 3))
    arrays = {f"weight_{k}": rng.normal(size=(n, m, side, side)) for k, (n, m, side) in enumerate(sizes, 1)}
    arrays |= {f"bias_{k}": rng.normal(size=n) for k, (n, _, _) in enumerate(sizes, 1)}
    arrays |= {
        "pool_before": np.array([3]),
        "taps": np.array([1, 2, 3]),
        "mean": np.full(3, 0.45),
        "std": np.full(3, 0.3),
    }
    net = network.as_network(arrays, "a random network")
    return FeatureBank(
        "random",
        lambda image: network.features(net, image),
        lambda tape, v_maps: network.features_vjp(net, tape, v_maps),
        2,
    )


def feature_stage(bank: FeatureBank, image: Floats, moved: Part, name: str) -> Stage:
    """Return a bank's features as a stage, as a function of a part of the image.

    The sign of a ReLU's input is a threshold, and so is which of four pixels has the maximum.
    """

    def function(part: Floats) -> Point:
        copy = image.copy()
        copy[moved] = part
        maps, tape = bank.features(copy)
        if not isinstance(tape, network._Tape):
            return Point(tuple(maps))
        halved = ((y, x) for y, x in zip(tape.outputs, tape.inputs[1:], strict=False) if y.shape != x.shape)
        largest = (max_pool_vjp(y, 2, 2, np.ones_like(x)) for y, x in halved)
        return Point(tuple(maps), (*(y > 0 for y in tape.outputs), *largest))

    def vjp(*v_maps: Floats) -> tuple[Floats, ...]:
        return (bank.features_vjp(bank.features(image)[1], v_maps)[moved],)

    maps, _ = bank.features(image)
    return Stage(name, {"image": image[moved].copy()}, tuple(f"map {k}" for k in range(len(maps))), function, vjp)


def loss_stage(rng: np.random.Generator) -> Stage:
    """Return NNFM and content of two maps as a stage; where a nearest neighbour changes is a threshold."""
    shapes = ((4, 5, 6), (2, 3, 7))
    maps, content = ([rng.normal(size=shape) for shape in shapes] for _ in range(2))
    styles = [unit_rows(rng.normal(size=(9, shape[2])))[0] for shape in shapes]
    weights = FeatureWeights(1.3, 0.7)

    def function(*maps: Floats) -> Point:
        loss, _ = feature_loss(maps, content, styles, weights)
        near = (nearest_rows(m.reshape(-1, m.shape[2]), style) for m, style in zip(maps, styles, strict=True))
        return Point((np.asarray(loss),), tuple(near))

    def vjp(v: Floats) -> tuple[Floats, ...]:
        return tuple(v * v_map for v_map in feature_loss(maps, content, styles, weights)[1])

    return Stage("feature_loss", {f"map {k}": map_ for k, map_ in enumerate(maps)}, ("loss",), function, vjp)
