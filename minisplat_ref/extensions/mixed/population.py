"""Ellipses, lines and triangles: the population, its start, and changes between the three during training.

MP-GS clusters points hierarchically into groups of one, two or three, and makes each an ellipse, a line or a triangle.
Here two points may join if one is among the three nearest neighbours of the other, no further than twice as far as the
nearest of either, and their colours differ by less than 5 in CIE Lab; pairs join in the order of their distance, as
long as a group has at most three points and any two of them are similar. A group's plane is that of its first two axes.

To fewer vertices, as in MP-GS: of a hull whose vertices all lie within half a deviation of each other, an ellipse is
left, and of a triangle that is nearly a line, a line. The paper takes Pearson's correlation of the vertices above 0.9
for the latter; it depends on the axes, and of points along one of them it is 0 or undefined. Here a triangle is a line
when its smallest altitude is below a share of a deviation.

To more, which the paper does not have: a needle becomes a line along it, and a large disc a triangle in its plane.
The area of a hull, the integral of its response over o, is by Steiner's formula::

    integral = s_1 s_2 (A + P sqrt(pi / 2) + 2 pi)

with area A and perimeter P of the whitened hull. The new hull keeps it. A needle s_1 > s_2 with the deviation s_2 all
round becomes a line of the half length ``sqrt(pi / 2) (s_1 - s_2)``. A disc of deviation s, the geometric mean of its
two, with half of it becomes an equilateral triangle of the whitened edge l, where
``sqrt(3) / 4 l^2 + 3 sqrt(pi / 2) l = 6 pi``.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.mixed.projection import place_vertices
from minisplat_ref.io.srgb import decode_srgb
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.strategy.ops import take
from minisplat_ref.types import Bools, Floats, Gaussians, Ints

COLOR_DISTANCE = 5.0  # in Lab, the paper's
N_NEIGHBOURS = 3
REACH = 2.0  # of a pair, in distances of the nearest neighbours
SHRINK = 0.5  # of a group's deviations: its hull spans the space between its points
SRGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
LAB_KNEE = 6 / 29
ROOT_HALF_PI = math.sqrt(math.pi / 2)
DISC_SHRINK = 2.0  # of the deviation of a disc that becomes a triangle
EDGE = (-3 * ROOT_HALF_PI + math.sqrt(9 * math.pi / 2 + math.sqrt(3) * 2 * math.pi * (DISC_SHRINK**2 - 1))) / (
    math.sqrt(3) / 2
)
CORNERS = EDGE * np.array([-1 / math.sqrt(12), 0.5, -1 / math.sqrt(12), -0.5])  # the second and the third, whitened


class MixedGaussians(NamedTuple):
    """Ellipses, lines and triangles; the other fields are those of :class:`Gaussians`."""

    means: Floats
    """[N, 3] the means of the vertices."""
    quats: Floats
    """[N, 4] as for Gaussians; vertices lie in the plane of the first two axes."""
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    vertices: Floats
    """[N, 4] a_2, b_2, a_3, b_3: the second and the third vertex from the mean, along the first two axes, world units.
    Vertices that a line or an ellipse lacks have no effect."""
    n_vertices: Floats
    """[N] 1 of an ellipse, 2 of a line, 3 of a triangle. Set by events, not learnt."""


def counts(population: MixedGaussians) -> Ints:
    """Return the numbers of vertices as integers, [N]."""
    return np.clip(np.rint(population.n_vertices), 1, 3).astype(np.int64)


def make_ellipses(gaussians: Gaussians) -> MixedGaussians:
    """Return Gaussians as a population of ellipses, which is rendered as 3DGS renders them."""
    n, dtype = len(gaussians.means), gaussians.means.dtype
    six = {name: getattr(gaussians, name) for name in Gaussians._fields}
    return MixedGaussians(**six, vertices=np.zeros((n, 4), dtype), n_vertices=np.ones(n, dtype))


def group_gaussians(gaussians: Gaussians, rng: np.random.Generator) -> MixedGaussians:
    """Return fewer primitives: each group of near Gaussians of like colour as an ellipse, a line or a triangle.

    A group has the mean opacity and colour of its members, and is as thick in all directions as they are on average,
    but for ``SHRINK``.
    """
    members = groups(gaussians.means, convert_to_lab(0.5 + SH_C0 * gaussians.sh_dc))
    is_hull, dtype = (members >= 0).sum(axis=1) > 1, gaussians.means.dtype
    population = make_ellipses(take(gaussians, members[:, 0]))
    of_hulls = members[is_hull]
    if not len(of_hulls):
        return population
    weights = (of_hulls >= 0) / (of_hulls >= 0).sum(axis=1, keepdims=True)  # [H, 3]; the row -1 counts 0
    blended = {
        name: np.einsum("hk,hk...->h...", weights, getattr(gaussians, name)[of_hulls]).astype(dtype)
        for name in ("means", "log_scales", "opacity_logits", "sh_dc", "sh_rest")
    }
    points = gaussians.means[np.where(of_hulls >= 0, of_hulls, of_hulls[:, :1])]
    R = plane_frames(points)
    in_plane = np.einsum("hij,hki->hkj", R[:, :, :2], points - blended["means"][:, None].astype(np.float64))
    scales = np.repeat(blended["log_scales"].mean(axis=1, keepdims=True) + np.log(SHRINK), 3, axis=1)
    changed = {**blended, "log_scales": scales, "quats": quaternions(R)}
    changed |= {"vertices": in_plane[:, 1:].reshape(-1, 4), "n_vertices": (of_hulls >= 0).sum(axis=1)}
    for name, values in changed.items():
        getattr(population, name)[is_hull] = values
    return population


def groups(points: Floats, lab: Floats) -> Ints:
    """Return the members of groups [M, 3], ascending, -1 where there are fewer; groups in the order of the first.

    Parameters
    ----------
    points : ndarray of shape (N, 3)
    lab : ndarray of shape (N, 3)
        Their colours, by :func:`convert_to_lab`.
    """
    n = len(points)
    group_of, members = list(range(n)), [[i] for i in range(n)]
    for i, j in _pairs(points, lab):
        a, b = sorted((group_of[i], group_of[j]))
        together = members[a] + members[b]
        if a == b or len(together) > 3 or _measure_spread(lab[together]) >= COLOR_DISTANCE:
            continue
        members[a], members[b] = sorted(together), []
        for k in together:
            group_of[k] = a
    return np.array([m + [-1] * (3 - len(m)) for m in members if m], np.int64).reshape(-1, 3)


def _pairs(points: Floats, lab: Floats) -> list[list[int]]:
    """Return pairs of neighbours of like colour, nearest first; of equals, those of lower numbers."""
    n = len(points)
    k = min(N_NEIGHBOURS + 1, n)
    if k < 2:
        return []
    distances, neighbours = cKDTree(points).query(points, k)
    first, second = np.repeat(np.arange(n), k), neighbours.ravel()
    low, high = np.minimum(first, second), np.maximum(first, second)
    apart, nearest = distances.ravel(), distances[:, 1]
    is_near = (low < high) & (apart <= REACH * np.minimum(nearest[low], nearest[high]))
    is_alike = np.linalg.norm(lab[low] - lab[high], axis=1) < COLOR_DISTANCE
    order = np.lexsort((high, low, apart))
    order = order[(is_near & is_alike)[order]]
    found: list[list[int]] = np.stack([low, high], axis=1)[order].tolist()
    return found


def _measure_spread(lab: Floats) -> float:
    """Return the largest distance between two colours of a few."""
    return float(np.max(np.linalg.norm(lab[:, None] - lab[None], axis=2)))


def convert_to_lab(rgb: Floats) -> Floats:
    """Return CIE Lab colours of sRGB ones, [N, 3], of D65, after clipping to [0, 1]."""
    linear = decode_srgb(np.clip(rgb.astype(np.float64), 0, 1))
    XYZ_FROM_SRGB = np.linalg.inv(SRGB_FROM_XYZ)
    relative = linear @ XYZ_FROM_SRGB.T / XYZ_FROM_SRGB.sum(axis=1)  # to white
    f = np.where(relative > LAB_KNEE**3, np.cbrt(relative), relative / (3 * LAB_KNEE**2) + 4 / 29)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def plane_frames(points: Floats) -> Floats:
    """Return rotations [H, 3, 3] whose first axis goes from the first point to the second, of H groups [H, 3, 3].

    The second axis lies in the plane of all three; where they are on a line, anywhere.
    """
    first = points[:, 1].astype(np.float64) - points[:, 0]
    length = np.linalg.norm(first, axis=1, keepdims=True)
    first = np.where(length > 0, first / np.where(length > 0, length, 1), [1.0, 0.0, 0.0])
    aside = points[:, 2].astype(np.float64) - points[:, 0]
    aside -= first * np.sum(first * aside, axis=1, keepdims=True)
    height = np.linalg.norm(aside, axis=1, keepdims=True)
    anywhere = np.cross(first, np.eye(3)[np.argmin(np.abs(first), axis=1)])
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    is_wide = height > 1e-6 * length
    second = np.where(is_wide, aside / np.where(is_wide, height, 1), anywhere)
    return np.stack([first, second, np.cross(first, second)], axis=2)


def quaternions(R: Floats) -> Floats:
    """Return quaternions wxyz of rotations [H, 3, 3]."""
    return np.roll(Rotation.from_matrix(R).as_quat(), 1, axis=1)


def whiten_vertices(population: MixedGaussians) -> Floats:
    """Return the vertices [N, 3, 2] in deviations, in their plane."""
    return place_vertices(population.vertices, counts(population)) * np.exp(-population.log_scales[:, None, :2])


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
    places = place_vertices(population.vertices, n)
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
