"""View dependence where it pays: each Gaussian of ``adaptive`` has an individual degree of the spherical harmonics.

Colours of degree d have (d + 1)^2 coefficients, and every photograph that shows a Gaussian is one observation of its
colour. With about as many coefficients as photographs, the harmonics pass through all of them and are wrong between:
seen from a new side, they are worse than no view dependence at all. So

*Grow.* Everything begins at degree 0. A Gaussian has degree d once it has been seen in ``views_per_coefficient``
(d + 1)^2 training views. Those that are halved pass their degree and their views on.

*Cut.* When the cool-down begins, a degree whose part of the colour varies by less than ``min_variation`` over the
directions from which the Gaussian has been seen is removed, from the highest down. With its part of the colour,
``c_l(d) = sum_m k_lm Y_lm(d)``, and the V directions d_v from the cameras that have seen it,

    variation_l = sqrt( mean over v and colours of (c_l(d_v) - mean c_l)^2 )

and the mean, which does not depend on the view, goes to the coefficient of degree 0: ``k_00 += mean c_l / Y_00``. A
degree that is hardly visible in photographs is not worth its parameters.

Absent degrees are zeros in ``sh_rest``, which every viewer of PLY files understands; neither colours nor Adam compute
with them (``stats["sh_degree"]`` is the degree of each Gaussian).
"""

import numpy as np

from minisplat_ref.constants import SH_C0, SH_DEGREE_MAX
from minisplat_ref.errors import InputError
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.pace import Decision
from minisplat_ref.training.rates import n_coefficients, present_degrees
from minisplat_ref.training.state import DEGREES, Iteration, TrainState
from minisplat_ref.types import Bools, Floats, Gaussians, Ints, View

SEEN = "is_seen"  # name of the statistic


def highest_degree(n_views: Ints, views_per_coefficient: float, most: int = SH_DEGREE_MAX) -> Ints:
    """Return the highest degree that this many views determine: the largest with n >= views_per_coefficient (d + 1)^2.

    Parameters
    ----------
    n_views : ndarray of shape (N,) of int
        Training views in which each Gaussian has been seen.
    views_per_coefficient : float
        At least zero.
    most : int
        Highest degree that there is.

    Returns
    -------
    ndarray of shape (N,) of uint8
        0 also where there are fewer views than one coefficient needs.

    Raises
    ------
    InputError
        ``views_per_coefficient`` is negative.
    """
    if not views_per_coefficient >= 0:
        raise InputError(f"views_per_coefficient is {views_per_coefficient}: give a number of at least 0")
    least = views_per_coefficient * np.arange(2, most + 2) ** 2  # [most] views of degrees 1, 2, ...
    return np.searchsorted(least, n_views, side="right").astype(np.uint8)


def raise_degrees(state: TrainState, iteration: Iteration, *, views_per_coefficient: float) -> None:
    """Note which Gaussians the view has shown, and raise the degrees of those that enough views have.

    Parameters
    ----------
    state, iteration
        As for every action.
    views_per_coefficient : float
        Training views that a Gaussian must have been seen in for each coefficient of a channel of its colour.
    """
    n, n_views = n_rows(state.gaussians), len(iteration.scene.train_views)
    if state.pace.cooling_from is not None:
        return
    if DEGREES not in state.stats:
        iteration.fetch()
        state.stats |= {DEGREES: present_degrees(state.gaussians.sh_rest), SEEN: np.zeros((n, n_views), bool)}
    is_seen, view = state.stats[SEEN], iteration.view.view_id
    ids = iteration.visible_ids[iteration.v_means2d[iteration.visible_ids].any(axis=1)]  # those in front of others
    ids = ids[~is_seen[ids, view]]
    is_seen[ids, view] = True
    stored = round((state.gaussians.sh_rest.shape[1] + 1) ** 0.5) - 1
    determined = highest_degree(is_seen[ids].sum(axis=1), views_per_coefficient, stored)
    state.stats[DEGREES][ids] = np.maximum(state.stats[DEGREES][ids], determined)


def cut_degrees_when_cooling(state: TrainState, iteration: Iteration, *, min_variation: float) -> None:
    """Remove the degrees that vary too little over the seen directions, in the first iteration of the cool-down.

    Parameters
    ----------
    state, iteration
        As for every action.
    min_variation : float
        Standard deviation of a degree's part of the colour, out of 1.
    """
    if state.pace.cooling_from is None or iteration.step != state.pace.cooling_from + 1:
        return
    iteration.fetch()
    degrees, is_seen = state.stats[DEGREES], state.stats.pop(SEEN)
    state.gaussians, state.stats[DEGREES] = drop_idle_degrees(
        state.gaussians, degrees, iteration.scene.train_views, is_seen, min_variation
    )
    is_absent = np.arange(state.gaussians.sh_rest.shape[1]) >= n_coefficients(state.stats[DEGREES])[:, None]
    for moments in (state.adam.first, state.adam.second):
        moments.sh_rest[is_absent] = 0
    state.pace = state.pace.with_decision(Decision(iteration.step, "bands", describe_degrees(state), None, None))


def describe_degrees(state: TrainState) -> str:
    """Return the number of Gaussians of each degree, and the mean number of colour coefficients."""
    degrees = state.stats[DEGREES]
    shares = np.bincount(degrees, minlength=SH_DEGREE_MAX + 1) / max(len(degrees), 1)
    mean = 3 * (1 + n_coefficients(degrees)).sum() / max(len(degrees), 1)
    flat, *others = (f"{share:.0%}" for share in shares)
    return (
        f"{flat} of the Gaussians have one colour from all sides, {', '.join(others)} harmonics of degree 1, 2, 3:"
        f" {mean:.1f} numbers for a colour on average, not 48"
    )


def drop_idle_degrees(
    gaussians: Gaussians, degrees: Ints, views: tuple[View, ...], is_seen: Bools, min_variation: float
) -> tuple[Gaussians, Ints]:
    """Remove the highest degrees of each Gaussian while they vary by less than ``min_variation``.

    Parameters
    ----------
    gaussians : Gaussians
        N rows.
    degrees : ndarray of shape (N,) of uint8
        Degrees of their colours.
    views : sequence of View
        V training views.
    is_seen : ndarray of shape (N, V) of bool
        Which views show which Gaussians.
    min_variation : float
        Of a degree's part of the colour, out of 1.

    Returns
    -------
    gaussians : Gaussians
        New coefficients of colour, the other fields as they were. The mean of what was removed, over the seen
        directions, is in ``sh_dc``.
    degrees : ndarray of shape (N,) of uint8
        The remaining degrees.
    """
    sh_dc, sh_rest, degrees = gaussians.sh_dc.copy(), gaussians.sh_rest.copy(), degrees.copy()
    means, deviations = _variations(gaussians, int(degrees.max(initial=0)), views, is_seen)
    for degree in range(int(degrees.max(initial=0)), 0, -1):
        rows = np.flatnonzero((degrees == degree) & (deviations[degree - 1] < min_variation))
        sh_dc[rows] += (means[degree - 1, rows] / SH_C0).astype(sh_dc.dtype)
        sh_rest[rows, degree**2 - 1 :] = 0
        degrees[rows] = degree - 1
    return gaussians._replace(sh_dc=sh_dc, sh_rest=sh_rest), degrees


def _variations(gaussians: Gaussians, most: int, views: tuple[View, ...], is_seen: Bools) -> tuple[Floats, Floats]:
    """Return for degrees 1 to ``most`` the mean [L, N, 3] and the standard deviation [L, N] over the seen directions.

    Views are added up one by one, so that memory does not depend on their number.
    """
    n = len(gaussians.means)
    sums, squares = np.zeros((most, n, 3)), np.zeros((most, n))
    for v, view in enumerate(views):
        rows = np.flatnonzero(is_seen[:, v])
        offsets = (gaussians.means[rows] - view.camera.center).astype(np.float64)
        basis = sh_basis(offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-300), most)
        for degree in range(1, most + 1):
            own = slice(degree**2, (degree + 1) ** 2)
            rest = gaussians.sh_rest[rows, degree**2 - 1 : (degree + 1) ** 2 - 1]
            colors = np.einsum("nk,nkc->nc", basis[:, own], rest)  # the degree's part
            sums[degree - 1, rows] += colors
            squares[degree - 1, rows] += (colors**2).mean(axis=1)
    count = np.maximum(is_seen.sum(axis=1), 1)
    means = sums / count[:, None]
    return means, np.sqrt(np.maximum(squares / count - (means**2).mean(axis=2), 0.0))
