"""One ray and one triangle of a fan as kernels read them, and the tree of all triangles.

The ray ``O + t d`` meets the triangle of the centre c and the corners ``c + e_1``, ``c + e_2`` where
``c + b_1 e_1 + b_2 e_2`` with barycentric coordinates ``b_1, b_2 >= 0``, ``b_1 + b_2 <= 1``. With ``s = O - c``,
``p = s x d`` and ``n = e_1 x e_2``, by Cramer's rule:

    D = -d . n,   b_1 = p . e_2 / D,   b_2 = -p . e_1 / D,   t = s . n / D

In standard deviations both corners are r from the centre, at an angle of ``2 pi / n`` to each other, so that at the hit

    u^2 + v^2 = r^2 (b_1^2 + b_2^2 + 2 b_1 b_2 cos(2 pi / n))

There is no plane of the whole polygon here, and no axes: these kernels render the fans of an edited mesh, which has
neither; whole polygons are traced by :mod:`.ray_kernels`. Of a spoke, the triangle before it has the points; of the
centre, the first triangle. Neighbours take the same product ``p . e``, and so no ray slips through between them.

The loops are those of ``mechanisms.rays.traversal`` and ``mechanisms.rays.kernels``. An edited mesh is not trained, so
there is no gradient.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import broadcast, select
from minisplat_ref.mechanisms.rays.bvh import build
from minisplat_ref.mechanisms.rays.traversal import OPACITY, RayTree
from minisplat_ref.scalar.projection import cross, dot
from minisplat_ref.types import Floats

SQUARE, COSINE, OWN, CENTRE, E1, E2 = 1, 2, 3, 4, 7, 10  # columns of a record beside the opacity: r^2, cos(2 pi / n)
N_COLUMNS = 13
OWNS_CENTRE, OWNS_NONE = 0.0, -1.0  # most b_1 + b_2 of the points on a triangle's first spoke that are its own


class Fans(NamedTuple):
    """Centres with the corners around them; any corners, also of polygons that were bent."""

    centres: Floats
    """[N, 3] world frame."""
    spokes: Floats
    """[N, n, 3] from the centre to each corner."""
    radii: Floats
    """[N] of the corners, in standard deviations."""
    opacities: Floats
    """[N] in [0, 1]."""


def build_tree(fans: Fans, conventions: Conventions) -> RayTree:
    """Return the triangles of fans with their tree; fans that are too faint, empty or not finite are left out."""
    n, n_sides = fans.spokes.shape[:2]
    corners = fans.centres[:, None] + fans.spokes
    is_seen = (fans.radii > 0) & (fans.opacities >= max(conventions.alpha_min, np.finfo(np.float64).tiny))
    seen = np.flatnonzero(is_seen & np.isfinite(corners).all(axis=(1, 2)))
    corners = corners[seen]
    following = np.roll(corners, -1, axis=1)  # [N', n, 3]
    bounds = [
        reduce(reduce(corners, following), fans.centres[seen, None]).reshape(-1, 3)
        for reduce in (np.minimum, np.maximum)
    ]
    tree = build(*bounds)
    fan, parts = np.divmod(tree.rows, n_sides)
    ids = seen[fan]
    records = np.empty((len(ids), N_COLUMNS))
    records[:, OPACITY] = fans.opacities[ids]
    records[:, SQUARE] = fans.radii[ids] ** 2
    records[:, COSINE] = np.cos(2 * np.pi / n_sides)
    records[:, OWN] = np.where(parts == 0, OWNS_CENTRE, OWNS_NONE)
    records[:, CENTRE:E1] = fans.centres[ids]
    records[:, E1:E2] = fans.spokes[ids, parts]
    records[:, E2:] = fans.spokes[ids, (parts + 1) % n_sides]
    return RayTree(records, ids.astype(np.int32), tree.boxes, tree.children, n)


@scalar
def edges(records, row):
    """Return e_1, e_2 and their cross product."""
    e1 = records[row, E1], records[row, E1 + 1], records[row, E1 + 2]
    e2 = records[row, E2], records[row, E2 + 1], records[row, E2 + 2]
    return e1, e2, cross(e1, e2)


@scalar
def intersect(records, row, ray):
    """Return t, b_1, b_2 and D of one ray or of eight."""
    s = ray[0] - records[row, CENTRE], ray[1] - records[row, CENTRE + 1], ray[2] - records[row, CENTRE + 2]
    d = ray[3], ray[4], ray[5]
    e1, e2, n = edges(records, row)
    p, D = cross(s, d), -dot(d, n)
    return dot(s, n) / D, dot(p, e2) / D, -(dot(p, e1) / D), D


@scalar
def meet(records, row, ray):
    """Return t and ``q = u^2 + v^2`` of eight rays; q is infinite beside the triangle."""
    t, b1, b2, _ = intersect(records, row, ray)
    q = records[row, SQUARE] * (b1 * b1 + b2 * b2 + 2.0 * records[row, COSINE] * b1 * b2)
    most = select(b2 > 0.0, broadcast(1.0), records[row, OWN])
    return t, select((b1 >= 0.0) & (b2 >= 0.0) & (b1 + b2 <= most), q, np.inf)
