"""Changes between ellipses, lines and triangles during training: to fewer vertices and to more.

To fewer, as in MP-GS: of a hull whose vertices all lie within half a deviation of each other, an ellipse is left, and
of a triangle that is nearly a line, a line. The paper takes Pearson's correlation of the vertices above 0.9 for the
latter; it depends on the axes, and of points along one of them it is 0 or undefined. Here a triangle is a line when its
smallest altitude is below a share of a deviation.

To more, which the paper does not have: a needle becomes a line along it, and a large disc a triangle in its plane.
The area of a hull, the integral of its response over o, is by Steiner's formula::

    integral = s_1 s_2 (A + P sqrt(pi / 2) + 2 pi)

with area A and perimeter P of the whitened hull. The new hull keeps it. A needle s_1 > s_2 with the deviation s_2 all
round becomes a line of the half length ``sqrt(pi / 2) (s_1 - s_2)``. A disc of deviation s, the geometric mean of its
two, with half of it becomes an equilateral triangle of the whitened edge l, where
``sqrt(3) / 4 l^2 + 3 sqrt(pi / 2) l = 6 pi``.
"""

import math

import numpy as np

from minisplat_ref.extensions.mixed.population import MixedGaussians, counts, quaternions
from minisplat_ref.extensions.mixed.projection import in_plane
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Bools, Floats, Ints

ROOT_HALF_PI = math.sqrt(math.pi / 2)
DISC_SHRINK = 2.0  # of the deviation of a disc that becomes a triangle
EDGE = (-3 * ROOT_HALF_PI + math.sqrt(9 * math.pi / 2 + math.sqrt(3) * 2 * math.pi * (DISC_SHRINK**2 - 1))) / (
    math.sqrt(3) / 2
)
CORNERS = EDGE * np.array([-1 / math.sqrt(12), 0.5, -1 / math.sqrt(12), -0.5])  # the second and the third, whitened


def whiten_vertices(population: MixedGaussians) -> Floats:
    """Return the vertices [N, 3, 2] in deviations, in their plane."""
    return in_plane(population.vertices, counts(population)) * np.exp(-population.log_scales[:, None, :2])


def coverage(whitened_vertices: Floats, n_vertices: Ints) -> Floats:
    """Return ``A + P sqrt(pi / 2) + 2 pi`` of whitened hulls [N, 3, 2]: the integral of their response over o."""
    v = np.where((np.arange(3) < n_vertices[:, None])[:, :, None], whitened_vertices, whitened_vertices[:, :1])
    edges = np.roll(v, -1, axis=1) - v
    area = np.abs(edges[:, 0, 0] * edges[:, 2, 1] - edges[:, 0, 1] * edges[:, 2, 0]) / 2
    covered: Floats = area + ROOT_HALF_PI * np.linalg.norm(edges, axis=2).sum(axis=1) + 2 * np.pi
    return covered


def simplify_kinds(population: MixedGaussians, *, least: float, min_height: float) -> tuple[MixedGaussians, Bools]:
    """Return a population with fewer vertices where they make no difference, and which rows have changed, [N].

    Parameters
    ----------
    population : MixedGaussians
    least : float
        Deviations: a hull whose vertices are all nearer to each other becomes an ellipse.
    min_height : float
        Deviations: a triangle of a smaller altitude becomes the line of its longest edge.
    """
    n, y = counts(population), whiten_vertices(population)
    places = in_plane(population.vertices, n)
    # Edges from k to k + 1, [N, 3]; the third vertex of a line is its mean, so its first edge is the longest.
    lengths = np.linalg.norm(np.roll(y, -1, axis=1) - y, axis=2)
    longest = lengths.max(axis=1)
    is_point = (n > 1) & (longest < least)
    double = 3 * np.abs(y[:, 1, 0] * y[:, 2, 1] - y[:, 1, 1] * y[:, 2, 0])  # the area: y is from the mean
    is_line = (n == 3) & ~is_point & (double < min_height * longest)

    rows = np.arange(len(n))
    start = np.where(is_line, np.argmax(lengths, axis=1), 0)
    first, second = places[rows, start], places[rows, (start + 1) % 3]
    changed = is_point | is_line
    half = np.where(is_line[:, None], (second - first) / 2, 0)
    vertices = np.where(changed[:, None], np.column_stack([half, np.zeros_like(half)]), population.vertices)
    moved = np.where(is_line[:, None], (first + second) / 2, 0)
    R = rotation_matrices(population.quats)
    means = population.means + np.einsum("nij,nj->ni", R[:, :, :2], moved)
    left = np.where(is_point, 1, np.where(is_line, 2, population.n_vertices))
    dtype = population.means.dtype
    simpler = population._replace(
        means=means.astype(dtype), vertices=vertices.astype(dtype), n_vertices=left.astype(dtype)
    )
    return simpler, changed


def promote_kinds(population: MixedGaussians, *, ratio: float, size_limit: float) -> tuple[MixedGaussians, Bools]:
    """Return a population in which needles have become lines and discs triangles, and which rows have changed, [N].

    Parameters
    ----------
    population : MixedGaussians
    ratio : float
        A needle's longest deviation over its second; of a disc, the second over the least, with the first two within
        a factor of two.
    size_limit : float
        Least deviation of a primitive that changes, world units: the first of a needle, the second of a disc.
    """
    order = np.argsort(-population.log_scales, axis=1, kind="stable")
    log_s = np.take_along_axis(population.log_scales, order, axis=1).astype(np.float64)  # descending
    steps, is_ellipse = -np.diff(log_s, axis=1), counts(population) == 1
    is_needle = is_ellipse & (steps[:, 0] > np.log(ratio)) & (log_s[:, 0] > np.log(size_limit))
    is_disc = (
        is_ellipse & (steps[:, 0] < np.log(2)) & (steps[:, 1] > np.log(ratio)) & (log_s[:, 1] > np.log(size_limit))
    )
    changed = is_needle | is_disc
    rows = np.flatnonzero(changed)
    if not len(rows):
        return population, changed
    needle, log_s = is_needle[rows, None], log_s[rows]
    R = np.take_along_axis(rotation_matrices(population.quats[rows].astype(np.float64)), order[rows, None], axis=2)
    R[:, :, 2] *= np.sign(np.linalg.det(R))[:, None]
    flat = (log_s[:, 0] + log_s[:, 1]) / 2 - np.log(DISC_SHRINK)  # of a disc
    new_log_s = np.where(needle, log_s[:, [1, 1, 2]], np.column_stack([flat, flat, log_s[:, 2]]))
    half = ROOT_HALF_PI * (np.exp(log_s[:, 0]) - np.exp(log_s[:, 1]))
    along = np.outer(half, [1.0, 0.0, 0.0, 0.0])
    fields = {
        "quats": quaternions(R),
        "log_scales": new_log_s,
        "vertices": np.where(needle, along, np.exp(flat)[:, None] * CORNERS),
        "n_vertices": np.where(needle[:, 0], 2, 3),
    }
    whole = {name: getattr(population, name).copy() for name in fields}
    for name, values in fields.items():
        whole[name][rows] = values
    return population._replace(**whole), changed
