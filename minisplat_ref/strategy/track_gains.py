"""The exposure of each photograph, from the tracks of structure from motion, before any training.

A sparse point q is seen by several photographs v. If they differ in their exposure alone, the logarithm of its colour
in channel k is the sum of one number of the photograph and one of the point::

    ln c_vqk = g_vk + a_qk + e_vqk,   sum_v g_vk = 0

g are the log gains of the photographs, a the log colours of the points, and e is what neither explains: view-dependent
colours, and points that lie beside their surface. Both are found by least squares over all pairs (v, q), repeated with
weights of the Cauchy distribution, ``w = 1 / (1 + (e / s)^2)`` with the scale s of the residuals, so that outliers do
not count. For given g the best a are means over photographs, which leaves one linear system for g, [V, V].

The points are divided into two halves. Gains of one half must also explain the other, to which they were not fitted;
how much the gains of both halves differ is their error.

Colours are those of the files, sRGB; a gain g of the light is about g^(1/2.2) there. Observations near black or white
are left out, where a gain is not visible, and so are views through a lens, whose pixels are not known here.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from minisplat_ref.reference.pinhole import project_into_image
from minisplat_ref.types import Bools, Floats, Ints, Scene, View

REACH = 1  # pixels around an observation over which its colour is averaged
DARK, BRIGHT = 8, 247  # of 255, ours: an observation with a pixel beyond them is left out
N_ROUNDS = 30  # of reweighting, at most
CONVERGED = 1e-5  # change of a log gain that ends the rounds
RIDGE = 1e-8  # of the mean diagonal entry of S, which is singular
SCALE_MIN = 1e-3  # of the residuals, as rounding to 8 bits leaves about this much
MAD_TO_SIGMA = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
OBSERVATIONS_MIN = 20  # ours: fewer do not determine the gain of a photograph
SPREAD_MIN = 0.02  # standard deviation of the log gains, ours: smaller ones are hardly visible
OUTLIER = 3.0  # robust standard deviations, ours
FALL_MIN = 0.01  # relative, of the residual of points that were not fitted; ours


class Observations(NamedTuple):
    """The colours of sparse points in photographs, one row for each pair of both."""

    view_ids: Ints
    """[M] photograph."""
    point_ids: Ints
    """[M] point."""
    log_colors: Floats
    """[M, 3] natural logarithm of the mean sRGB colour around the point, of 1."""


class TrackGains(NamedTuple):
    """The exposures of photographs, with their errors."""

    log_gains: Floats
    """[V, 3] g, with zero mean over the photographs that have one; 0 for the others."""
    is_known: Bools
    """[V] whether a photograph has enough observations."""
    log_colors: Floats
    """[P, 3] a of each point; NaN of a point without observations."""
    error: float
    """Standard deviation of the error of a photograph's mean log gain, from the gains of two halves of the points."""
    residual: float
    """Robust standard deviation of the log colours of a point, at points that were not fitted, without gains."""
    residual_with_gains: float
    """The same after division by the gains of the other half."""

    @property
    def spread(self) -> float:
        """Standard deviation of the photographs' mean log gains."""
        return float(np.std(self.log_gains[self.is_known].mean(axis=1))) if self.is_known.any() else 0.0

    @property
    def are_needed(self) -> bool:
        """Whether the gains differ, by more than their error, and explain points to which they were not fitted."""
        differs = self.spread > max(SPREAD_MIN, 3 * self.error)
        return differs and self.residual_with_gains < (1 - FALL_MIN) * self.residual

    @property
    def outliers(self) -> Ints:
        """Photographs whose mean log gain is more than ``OUTLIER`` robust standard deviations from the median."""
        rows = np.flatnonzero(self.is_known)
        g = self.log_gains[rows].mean(axis=1)
        distances = np.abs(g - np.median(g)) if len(g) else g
        return rows[distances > max(OUTLIER * _scale(distances), SPREAD_MIN)] if len(g) else rows

    def describe(self) -> str:
        """Return half a sentence that begins with a verb."""
        if not self.is_known.any():
            return "are not known: no photograph has enough tracks of sparse points"
        return (
            f"differ by {self.spread:.1%} (error {self.error:.1%}): a point's colour varies by {self.residual:.1%} from"
            f" photograph to photograph, and by {self.residual_with_gains:.1%} after division by them"
        )


def estimate_gains(scene: Scene) -> TrackGains:
    """Return the exposures of the training photographs.

    Parameters
    ----------
    scene : Scene
        Its training views have ``point_ids``; without them no gain is known.

    Returns
    -------
    TrackGains
        V training views, P sparse points.
    """
    n_views, n_points = len(scene.train_views), len(scene.points)
    observed = observe_points(scene.train_views, scene.points)
    counts = np.bincount(observed.view_ids, minlength=n_views)
    is_known = counts >= OBSERVATIONS_MIN
    observed = _take(observed, is_known[observed.view_ids])
    gains = fit_gains(observed, n_views)
    log_colors = np.full((n_points, 3), np.nan)
    ids, inverse, n = np.unique(observed.point_ids, return_inverse=True, return_counts=True)
    for k in range(3):
        rest = observed.log_colors[:, k] - gains[observed.view_ids, k]
        log_colors[ids, k] = np.bincount(inverse, rest) / n
    return TrackGains(gains, is_known, log_colors, *cross_validate(observed, n_views))


def store_gains(scene: Scene) -> Scene:
    """Return the scene with the log gains of its photographs, held-out ones included, if they are needed.

    A scene that has gains stays as it is; so does one whose photographs are not known to differ.
    """
    if any(view.log_gain is not None for view in scene.train_views):
        return scene
    gains = estimate_gains(scene)
    if not gains.are_needed:
        return scene
    level = np.log(np.exp(gains.log_gains[gains.is_known]).mean(axis=0))  # [3] so that the mean exposure is 1
    trained = [g - level if known else None for g, known in zip(gains.log_gains, gains.is_known, strict=True)]
    fitted = (fit_gain_of_view(view, gains, scene.points) for view in scene.test_views)
    held_out = [None if g is None else g - level for g in fitted]
    return scene._replace(
        train_views=tuple(v._replace(log_gain=g) for v, g in zip(scene.train_views, trained, strict=True)),
        test_views=tuple(v._replace(log_gain=g) for v, g in zip(scene.test_views, held_out, strict=True)),
    )


def spread_of_gains(views: Sequence[View]) -> float:
    """Return the standard deviation of the mean log gains that views have; 0 if none has one."""
    gains = [float(np.mean(view.log_gain)) for view in views if view.log_gain is not None]
    return float(np.std(gains)) if gains else 0.0


def cross_validate(observed: Observations, n_views: int) -> tuple[float, float, float]:
    """Return the three figures of :class:`TrackGains` by which gains are judged, from the means of three channels.

    Gains of points with even numbers are applied to those with odd numbers, and vice versa. If gains of half of the
    points have the standard deviation s sqrt(2), those of all have s, and the difference of two halves has 2 s.

    Parameters
    ----------
    observed : Observations
        Of photographs whose gains are known.
    n_views : int
        V.

    Returns
    -------
    error, residual, residual_with_gains : float
        All 0 if no photograph has a known gain.
    """
    if len(observed.view_ids) == 0:
        return 0.0, 0.0, 0.0
    gray = observed._replace(log_colors=observed.log_colors.mean(axis=1, keepdims=True))
    halves = [_take(gray, gray.point_ids % 2 == parity) for parity in (0, 1)]
    even, odd = (fit_gains(half, n_views) for half in halves)  # [V, 1]
    error = np.std((even - odd)[np.unique(observed.view_ids)]) / 2
    without = [_residual(half, np.zeros((n_views, 1))) for half in halves]
    with_gains = [_residual(half, other) for half, other in zip(halves, (odd, even), strict=True)]
    return float(error), float(np.mean(without)), float(np.mean(with_gains))


def observe_points(views: Sequence[View], points: Floats) -> Observations:
    """Return the colours of sparse points in the photographs in which structure from motion has found them.

    Parameters
    ----------
    views : sequence of View
        V pinhole views; those without ``point_ids``, or through a lens, have no observations.
    points : ndarray of shape (P, 3)
        World frame.
    """
    found = [_observe(index, view.load(), points) for index, view in enumerate(views) if _is_tracked(view)]
    nothing = Observations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    return Observations(*(np.concatenate(parts) for parts in zip(nothing, *found, strict=True)))


def fit_gains(observed: Observations, n_views: int) -> Floats:
    """Return the log gains g [V, K] of the photographs, robustly, with zero mean over those that are observed.

    With the weights w_vq, ``W_q = sum_v w_vq`` and the elimination of ``a_q = sum_v w_vq (ln c_vq - g_v) / W_q``::

        sum_u S_vu g_u = sum_q w_vq (ln c_vq - sum_u w_uq ln c_uq / W_q)
        S_vu = delta_vu sum_q w_vq - sum_q w_vq w_uq / W_q

    Parameters
    ----------
    observed : Observations
        Of K channels; each is fitted alone.
    n_views : int
        V.
    """
    gains = np.zeros((n_views, observed.log_colors.shape[1]))
    if len(observed.view_ids) == 0:
        return gains
    _, point = np.unique(observed.point_ids, return_inverse=True)
    for k, values in enumerate(observed.log_colors.T):
        weights = np.ones(len(values))
        for _ in range(N_ROUNDS):
            g, e = _solve(observed.view_ids, point, values, weights, n_views)
            is_converged = np.abs(g - gains[:, k]).max() < CONVERGED
            gains[:, k] = g
            if is_converged:
                break
            weights = 1 / (1 + (e / max(_scale(e), SCALE_MIN)) ** 2)
    return gains


def fit_gain_of_view(view: View, gains: TrackGains, points: Floats) -> Floats | None:
    """Return the log gain [3] of a photograph that was not among the fitted ones, from its own tracks.

    Parameters
    ----------
    view : View
        A held-out photograph.
    gains : TrackGains
        Of the training photographs; their log colours of the points stay.
    points : ndarray of shape (P, 3)
        World frame.

    Returns
    -------
    ndarray of shape (3,) or None
        Median of the differences from the points' log colours; None if there are too few of them.
    """
    observed = observe_points([view], points)
    differences = observed.log_colors - gains.log_colors[observed.point_ids]
    differences = differences[np.isfinite(differences[:, 0])]
    return np.median(differences, axis=0) if len(differences) >= OBSERVATIONS_MIN else None


def _is_tracked(view: View) -> bool:
    return view.point_ids is not None and len(view.point_ids) > 0 and view.camera.optics is None


def _observe(index: int, view: View, points: Floats) -> Observations:
    """Return the observations of one photograph; pixels outside its mask are none."""
    assert view.point_ids is not None
    rows, xy, _ = project_into_image(points[view.point_ids], view.camera)
    u, v = np.floor(xy).astype(int).T  # [M] pixel
    height, width = view.image.shape[:2]
    is_inside = (u >= REACH) & (u < width - REACH) & (v >= REACH) & (v < height - REACH)
    if view.mask is not None:
        is_inside[is_inside] = view.mask[v[is_inside], u[is_inside]]
    rows, u, v = rows[is_inside], u[is_inside], v[is_inside]
    around = np.arange(-REACH, REACH + 1)
    patches = view.image[v[:, None, None] + around[:, None], u[:, None, None] + around]  # [M, 3, 3, 3]
    is_exposed = (patches.min(axis=(1, 2, 3)) >= DARK) & (patches.max(axis=(1, 2, 3)) <= BRIGHT)
    colors = patches[is_exposed].mean(axis=(1, 2)) / 255.0
    ids = np.asarray(view.point_ids)[rows[is_exposed]]
    return Observations(np.full(len(ids), index), ids, np.log(colors))


def _solve(view: Ints, point: Ints, values: Floats, weights: Floats, n_views: int) -> tuple[Floats, Floats]:
    """Return the g [V] of weighted least squares, and the residuals e [M].

    Only differences of g are determined, between photographs that share points, directly or through others. In each
    such part of the scene the mean of g is 0.
    """
    n_points = int(point.max()) + 1
    W = sparse.csr_matrix((weights, (point, view)), shape=(n_points, n_views))  # [Q, V]
    totals, per_view = np.bincount(point, weights), np.bincount(view, weights, minlength=n_views)  # [Q] W_q, [V]
    means = np.bincount(point, weights * values) / totals  # [Q]
    wanted = np.bincount(view, weights * (values - means[point]), minlength=n_views)
    S = (sparse.diags(per_view) - W.T @ sparse.diags(1 / totals) @ W).tocsc()
    solve = splu(S + RIDGE * per_view.mean() * sparse.identity(n_views, format="csc")).solve
    g = solve(wanted)
    g += solve(wanted - S @ g)  # what the ridge has changed
    _, part = connected_components(S, directed=False)
    g -= (np.bincount(part, g) / np.bincount(part))[part]
    rest = values - g[view]
    return g, rest - (np.bincount(point, weights * rest) / totals)[point]


def _residual(observed: Observations, gains: Floats) -> float:
    """Return the robust standard deviation of a point's log colours [M, 1] around their mean, of points seen twice.

    The factor ``sqrt(n / (n - 1))`` makes up for the mean, which is that of the same n values.
    """
    _, point, n = np.unique(observed.point_ids, return_inverse=True, return_counts=True)
    rest = observed.log_colors[:, 0] - gains[observed.view_ids, 0]
    e = (rest - (np.bincount(point, rest) / n)[point]) * np.sqrt(n / np.maximum(n - 1, 1))[point]
    e = e[n[point] > 1]
    return _scale(e) if len(e) else 0.0


def _scale(e: Floats) -> float:
    return float(MAD_TO_SIGMA * np.median(np.abs(e)))


def _take(observed: Observations, rows: Bools) -> Observations:
    return Observations(observed.view_ids[rows], observed.point_ids[rows], observed.log_colors[rows])
