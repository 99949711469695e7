"""The predictor of initial centres, attraction to planes along their normals, and contraction or dispersion of regions.

The predictor is a network that maps noisy points to the points themselves. It is trained on the points of the scene
alone, which makes it in effect a denoising autoencoder: its output is smoother than its input, because a small network
cannot follow every point.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.mechanisms.networks.mlp import forward, make_network, train_step, zero_moments
from minisplat_ref.mechanisms.oriented.planes import LocalPlanes
from minisplat_ref.mechanisms.oriented.thin_axis import normals_of, normals_of_vjp
from minisplat_ref.types import Floats, Ints

HIDDEN = (64, 64)  # of the predictor, as are the next two lines
STEPS, BATCH, RATE = 600, 1024, 3e-3
NOISE = 0.01  # of the inputs, in units of the points' deviation
SIDE_MIN = 1e-30  # world units: of a region, where all points lie in one place
REACH = 3.0  # h: pairs further apart repel each other by less than a ninetieth
PAIRED_MAX = 2048  # primitives of a region whose pairs are computed: at most 2 million pairs, some 200 MB


def predict_centers(points: Floats, rng: np.random.Generator) -> Floats:
    """Train the predictor on points [P, 3], and return its centres for them."""
    middle, spread = points.mean(axis=0), float(points.std()) or 1.0
    x = (points - middle) / spread
    network = make_network((3, *HIDDEN, 3), rng)
    moments = zero_moments(network)
    for step in range(1, STEPS + 1):
        rows = rng.integers(0, len(x), min(BATCH, len(x)))
        noisy = x[rows] + NOISE * rng.normal(size=(len(rows), 3))
        train_step(network, noisy, x[rows], RATE * (1 - (step - 1) / STEPS), moments, step)
    return middle + spread * forward(network, x)[0]


class Weights(NamedTuple):
    """The weights of the three parts of the attraction."""

    distance: float
    """l_d."""
    angle: float
    """l_a."""
    spacing: float
    """l_s."""


class Attraction(NamedTuple):
    """The attraction of N primitives to a surface, and its derivatives."""

    value: float
    means: Floats
    """[N, 3]."""
    quats: Floats
    """[N, 4]."""


def attract(population: Any, planes: LocalPlanes, weights: Weights, offset: float, unit: float) -> Attraction:
    """Return the loss of primitives' distances from the planes of their nearest points, and of their tilt.

    With the nearest point's plane (m, N), the shortest axis U and the target ``mu*`` at the distance d from the plane::

        e_i = (mu_i - m) . N - d
        L   = l_d mean(e_i^2) + l_a mean(1 - |U . N|) + l_s mean(|mu_i - m|^2)         lengths in ``unit``

        v_mu = 2 (l_d e N + l_s (mu - m)) / n,   v_U = -l_a sign(U . N) N / n         of n primitives

    Because ``mu - mu*`` is along N, the gradient is the same with the target held constant. The paper's sum over
    neighbours is here over the mean m of the nearest point's neighbours, which has the same gradient up to a factor.

    Parameters
    ----------
    population : NamedTuple
        Has ``means``, ``quats`` and ``log_scales``.
    planes : LocalPlanes
        Of the points of the scene.
    weights : Weights
    offset : float
        d, in ``unit``.
    unit : float
        World units: the scene's extent.
    """
    means = population.means.astype(np.float64)
    _, nearest = cKDTree(planes.centers).query(means)
    m, N = planes.centers[nearest], planes.normals[nearest]
    apart = (means - m) / unit
    e = np.sum(apart * N, axis=1) - offset
    U = normals_of(population).astype(np.float64)
    cosines = np.sum(U * N, axis=1)
    n = max(len(means), 1)
    squares = weights.distance * e * e + weights.spacing * np.sum(apart * apart, axis=1)
    value = float(np.sum(squares + weights.angle * (1 - np.abs(cosines)))) / n
    v_means = 2 * (weights.distance * e[:, None] * N + weights.spacing * apart) / (n * unit)
    v_U = -weights.angle * np.sign(cosines)[:, None] * N / n
    dtype = population.means.dtype
    return Attraction(value, v_means.astype(dtype), normals_of_vjp(population, v_U.astype(dtype)))


class Regions(NamedTuple):
    """A grid of cubes over a scene."""

    low: Floats
    """[3] corner, world frame."""
    side: float
    """World units."""
    shape: tuple[int, int, int]

    def ids_of(self, means: Floats) -> Ints:
        """Return the cube [N] of each point; those outside belong to the nearest."""
        cells = np.clip(np.floor((means - self.low) / self.side), 0, np.array(self.shape) - 1).astype(np.int64)
        return np.ravel_multi_index(tuple(cells.T), self.shape)


def regions_of(points: Floats, n_cells: int) -> Regions:
    """Return ``n_cells`` cubes along the longest side of the points' box."""
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(float((high - low).max()) / n_cells, SIDE_MIN)
    counts = np.maximum(np.ceil((high - low) / side), 1).astype(int)
    return Regions(low, side, (int(counts[0]), int(counts[1]), int(counts[2])))


def unevenness(means: Floats, regions: Regions) -> Floats:
    """Return the variance of density [R] in each region: of the counts in its octants, over their mean squared.

    It is 0 where they are equal or the region is empty, and 7 where one octant holds all.
    """
    halves = Regions(regions.low, regions.side / 2, tuple(2 * n for n in regions.shape))  # type: ignore[arg-type]
    counts = np.bincount(halves.ids_of(means), minlength=int(np.prod(halves.shape))).reshape(halves.shape)
    a, b, c = regions.shape
    octants = counts.reshape(a, 2, b, 2, c, 2).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 8)
    mean = octants.mean(axis=1)
    return octants.var(axis=1) / np.where(mean > 0, mean, 1) ** 2


def densest(means: Floats, regions: Regions, n_top: int) -> list[Ints]:
    """Return the rows of the primitives in each of the ``n_top`` regions that hold the most, if at least two."""
    ids = regions.ids_of(means)
    counts = np.bincount(ids, minlength=int(np.prod(regions.shape)))
    top = np.argsort(-counts, kind="stable")[:n_top]
    return [np.flatnonzero(ids == region) for region in top if counts[region] > 1]


def contract(means: Floats, members: list[Ints], side: float) -> tuple[float, Floats]:
    """Return the printed term and its gradient: mean squared distance of pairs, which pulls them together.

    Over the n of each region ``sum_ij |x_i - x_j|^2 = 2 n sum_i |x_i - mean|^2``; divided by n^2 and the side squared::

        L = mean over regions of 2 sum_i |x_i - mean|^2 / (n side^2),   v_x_i = 4 (x_i - mean) / (n side^2)
    """
    v, value = np.zeros(means.shape), 0.0
    for rows in members:
        apart = (means[rows] - means[rows].mean(axis=0)) / side
        value += 2 * float(np.sum(apart * apart)) / len(rows) / len(members)
        v[rows] = 4 * apart / (len(rows) * side * len(members))
    return value, v


def disperse(means: Floats, members: list[Ints], h: float) -> tuple[float, Floats]:
    """Return a repulsive term and its gradient, which pushes near pairs apart.

    ::

        L     = mean over regions of (1 / n) sum_{i<j} E_ij,   E_ij = exp(-|x_i - x_j|^2 / (2 h^2)) - exp(-REACH^2 / 2)
        v_x_i = -(1 / n) sum_j (x_i - x_j) / h^2 exp(...)

    over the pairs within ``REACH`` h of each other, beyond which E would be negative. In a region of more than
    ``PAIRED_MAX`` every k-th represents the others: pairs grow with the square, and where a few points lie far away,
    one region holds almost everything.
    """
    v, value, floor = np.zeros(means.shape), 0.0, np.exp(-(REACH**2) / 2)
    for region in members:
        rows = region[:: -(-len(region) // PAIRED_MAX)]
        x = means[rows]
        pairs = cKDTree(x).query_pairs(REACH * h, output_type="ndarray")
        apart = x[pairs[:, 0]] - x[pairs[:, 1]]
        E = np.exp(-np.sum(apart * apart, axis=1) / (2 * h * h))
        share = 1 / (len(rows) * len(members))
        value += share * float(np.sum(E - floor))
        push = -share * E[:, None] * apart / (h * h)
        np.add.at(v, rows[pairs[:, 0]], push)
        np.add.at(v, rows[pairs[:, 1]], -push)
    return value, v
