"""The population of ellipses, lines and triangles, and its start: near points of similar colour become one.

MP-GS clusters points hierarchically into groups of one, two or three, and makes each an ellipse, a line or a triangle.
Here two points may join if one is among the three nearest neighbours of the other, no further than twice as far as the
nearest of either, and their colours differ by less than 5 in CIE Lab; pairs join in the order of their distance, as
long as a group has at most three points and any two of them are similar. A group's plane is that of its first two axes.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from minisplat_ref.constants import SH_C0
from minisplat_ref.strategy.ops import take
from minisplat_ref.types import Floats, Gaussians, Ints

COLOR_DISTANCE = 5.0  # in Lab, the paper's
N_NEIGHBOURS = 3
REACH = 2.0  # of a pair, in distances of the nearest neighbours
SHRINK = 0.5  # of a group's deviations: its hull spans the space between its points
SRGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
LAB_KNEE = 6 / 29


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


def as_ellipses(gaussians: Gaussians) -> MixedGaussians:
    """Return Gaussians as a population of ellipses, which is rendered as 3DGS renders them."""
    n, dtype = len(gaussians.means), gaussians.means.dtype
    six = {name: getattr(gaussians, name) for name in Gaussians._fields}
    return MixedGaussians(**six, vertices=np.zeros((n, 4), dtype), n_vertices=np.ones(n, dtype))


def group_gaussians(gaussians: Gaussians, rng: np.random.Generator) -> MixedGaussians:
    """Return fewer primitives: each group of near Gaussians of like colour as an ellipse, a line or a triangle.

    A group has the mean opacity and colour of its members, and is as thick in all directions as they are on average,
    but for ``SHRINK``.
    """
    members = groups(gaussians.means, to_lab(0.5 + SH_C0 * gaussians.sh_dc))
    is_hull, dtype = (members >= 0).sum(axis=1) > 1, gaussians.means.dtype
    population = as_ellipses(take(gaussians, members[:, 0]))
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
        Their colours, by :func:`to_lab`.
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


def to_lab(rgb: Floats) -> Floats:
    """Return CIE Lab colours of sRGB ones, [N, 3], of D65, after clipping to [0, 1]."""
    rgb = np.clip(rgb.astype(np.float64), 0, 1)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
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
