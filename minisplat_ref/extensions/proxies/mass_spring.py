"""A falling sheet of masses and springs: springs of a triangle mesh, forces, energies, and velocity Verlet.

A sheet of masses and springs (Provot 1995) has springs of three kinds, which here follow from the triangles:

- *structural*: along every edge;
- *shear*: between the two corners opposite an edge that is the longest side of both its triangles. Two such triangles
  are a quadrilateral cut along a diagonal, and this is the other diagonal;
- *bend*: between the corners opposite any other inner edge. Folding the sheet along the edge brings them closer.

A mass is the density times a third of the area of the triangles around a vertex.

Vertices have masses m, springs pull with ``k (l - l0)`` along themselves, gravity g pulls everything, a floor pushes
vertices below it back with ``k_f`` times their depth, and drag slows everything down, ``dv/dt = -c v``. Pinned vertices
do not move. The forces other than drag are minus the gradient of

    elastic + floor + gravity = sum_s k (l - l0)^2 / 2  +  sum_v k_f depth^2 / 2  -  sum_v m g . x

A step of length h is symmetric. It takes half a step of drag, half a kick, a drift, half a kick, half a step of drag:

    v <- e^(-c h/2) v;   v <- v + h/2 f(x)/m;   x <- x + h v;   v <- v + h/2 f(x)/m;   v <- e^(-c h/2) v

The middle is velocity Verlet. It is of second order, exact in free fall, and symplectic, so that its error of the
energy is of order h^2 and does not grow with time. Drag is solved exactly, so the energy that it takes away is known
exactly: kinetic, elastic, floor and gravitational energy and the dissipated energy add up to the energy at the start,
to within that error. This sum checks a simulation. Verlet is stable for ``h < 2 / omega`` with the highest frequency
omega of the sheet, which :func:`longest_step` bounds.

Most cloth simulations use implicit Euler instead. It can take long steps because it damps, but by an amount that
depends on the step and that nothing accounts for. Left out are collisions of the sheet with itself and with other
objects, friction except for the drag on the floor, and strain limits.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from minisplat_ref.mechanisms.meshes.mesh import Mesh
from minisplat_ref.types import Bools, Floats, Ints

LONGEST_RATIO = 1 - 1e-9  # rounding: a side of at least this part of the longest one counts as the longest


class Stiffness(NamedTuple):
    """Spring constants of the three kinds, force per length; 0 omits a kind."""

    structural: float
    shear: float
    bend: float


class Springs(NamedTuple):
    """Springs between vertices."""

    incidence: csr_array
    """[S, P] sparse; row s has 1 at one end of spring s and -1 at the other, so ``incidence @ x`` is ``x_a - x_b``."""
    rest_lengths: Floats
    """[S] world units."""
    stiffness: Floats
    """[S] force per length."""


def connect(ends: Ints, vertices: Floats, stiffness: Floats) -> Springs:
    """Return springs that are at rest where the vertices are.

    Parameters
    ----------
    ends : ndarray of shape (S, 2)
        Rows of the vertices that each spring connects.
    vertices : ndarray of shape (P, 3)
        World frame.
    stiffness : ndarray of shape (S,)
        Force per length.
    """
    n = len(ends)
    signs = np.tile([1.0, -1.0], n)
    incidence = csr_array((signs, (np.repeat(np.arange(n), 2), ends.ravel())), shape=(n, len(vertices)))
    lengths = np.linalg.norm(incidence @ vertices, axis=1)  # [S]
    return Springs(incidence, lengths, np.asarray(stiffness, np.float64))


def make_springs(mesh: Mesh, stiffness: Stiffness) -> Springs:
    """Return the structural, shear and bend springs of a mesh that is at rest.

    Parameters
    ----------
    mesh : Mesh
        At rest.
    stiffness : Stiffness
        Constants of the three kinds, force per length.
    """
    edges, shear, bend = find_springs(mesh)
    kinds = [(ends, k) for ends, k in zip((edges, shear, bend), stiffness, strict=True) if k > 0]
    ends = np.concatenate([ends for ends, _ in kinds])
    return connect(ends, mesh.vertices, np.repeat([k for _, k in kinds], [len(ends) for ends, _ in kinds]))


def find_springs(mesh: Mesh) -> tuple[Ints, Ints, Ints]:
    """Return the vertices [S, 2] that structural, shear and bend springs connect.

    Of an edge that more than two triangles share, only the first two have a shear or bend spring.
    """
    sides = np.concatenate([mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]], mesh.faces[:, [0, 1]]])  # [3 T, 2]
    opposite = mesh.faces.T.ravel()  # [3 T] the corner that a side lies opposite to
    corners = mesh.corners
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2)  # [T, 3] opposite k
    is_longest = (lengths >= LONGEST_RATIO * lengths.max(axis=1, keepdims=True)).T.ravel()  # [3 T]

    edges, edge_of = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    order = np.argsort(edge_of.ravel(), kind="stable")  # sides grouped by their edge
    starts = np.searchsorted(edge_of.ravel()[order], np.arange(len(edges)))
    is_inner = np.bincount(edge_of.ravel(), minlength=len(edges)) > 1
    first, second = order[starts[is_inner]], order[starts[is_inner] + 1]
    across = np.column_stack([opposite[first], opposite[second]])  # [inner edges, 2]
    is_diagonal = is_longest[first] & is_longest[second]
    is_other = across[:, 0] != across[:, 1]  # not two copies of one triangle
    return edges, across[is_diagonal & is_other], across[~is_diagonal & is_other]


def vertex_masses(mesh: Mesh, density: float) -> Floats:
    """Return the masses [P] of the vertices, which get a third of the mass of each of their triangles.

    A vertex without a triangle gets the mean mass; it falls, but no Gaussian is bound to it.

    Parameters
    ----------
    mesh : Mesh
        At rest.
    density : float
        Mass per area.
    """
    corners = mesh.corners
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2  # [T]
    masses = density / 3 * np.bincount(mesh.faces.ravel(), np.repeat(areas, 3), minlength=len(mesh.vertices))
    return np.where(masses > 0, masses, masses.mean())


def choose_stiffness(mesh: Mesh, weight: float, stretch: float) -> Stiffness:
    """Return spring constants with which a square sheet that hangs from one side stretches by about a given fraction.

    In a column of n springs of constant k and length e, each spring carries the weights w below it, so the column
    stretches by ``w n^2 / 2 k``, which over its length n e is ``n w / 2 k e``. So

        k = L w / (2 e^2 f),   L the mesh's longest extent, e its mean edge, f the fraction.

    Shear springs are as stiff as structural ones, bend springs a hundredth of that, since cloth folds easily.

    Parameters
    ----------
    mesh : Mesh
        At rest.
    weight : float
        Weight of the whole sheet, mass times gravity.
    stretch : float
        f, above 0.
    """
    edges, _, _ = find_springs(mesh)
    e = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1).mean()
    extent = np.ptp(mesh.vertices, axis=0).max()
    k = float(extent * weight / len(mesh.vertices) / (2 * e * e * stretch))
    return Stiffness(k, k, k / 100)


class Floor(NamedTuple):
    """A plane perpendicular to gravity, which pushes up vertices below it."""

    height: float
    """Along the direction opposite to gravity, world units."""
    stiffness: float
    """k_f, force per depth on each vertex."""
    drag: float
    """1 / time, on vertices below the floor, besides the drag on all; it models friction and inelastic loss."""


class Sheet(NamedTuple):
    """Masses and springs, and the forces and constraints on them."""

    masses: Floats
    """[P] m."""
    springs: Springs
    """Between the P vertices."""
    is_pinned: Bools
    """[P] True where a vertex does not move."""
    gravity: Floats
    """[3] acceleration, world frame; not zero if there is a floor."""
    drag: float = 0.0
    """c, 1 / time."""
    floor: Floor | None = None
    """None for no floor."""


class State(NamedTuple):
    """Positions and velocities of a sheet at one time."""

    positions: Floats
    """[P, 3] world frame."""
    velocities: Floats
    """[P, 3] world units per unit of time."""
    dissipated: float = 0.0
    """Energy that drag has taken away since the start."""


class Energies(NamedTuple):
    """The energy of a sheet, by kind."""

    kinetic: float
    elastic: float
    floor: float
    gravity: float
    dissipated: float

    @property
    def total(self) -> float:
        """Sum of all kinds, which is conserved."""
        return sum(self)


def depths(positions: Floats, sheet: Sheet) -> Floats:
    """Return the depth of each vertex [P] below the floor; 0 above it, and where there is no floor."""
    if sheet.floor is None:
        return np.zeros(len(positions))
    return np.maximum(0, sheet.floor.height + positions @ _down(sheet))


def energies(state: State, sheet: Sheet) -> Energies:
    """Return the energies of a sheet in a state."""
    stretched = np.linalg.norm(sheet.springs.incidence @ state.positions, axis=1) - sheet.springs.rest_lengths  # [S]
    floor = sheet.floor.stiffness if sheet.floor else 0.0
    return Energies(
        kinetic=float(np.sum(sheet.masses[:, None] * state.velocities**2) / 2),
        elastic=float(np.sum(sheet.springs.stiffness * stretched**2) / 2),
        floor=float(floor * np.sum(depths(state.positions, sheet) ** 2) / 2),
        gravity=float(-np.sum(sheet.masses * (state.positions @ sheet.gravity))),
        dissipated=state.dissipated,
    )


def forces(positions: Floats, sheet: Sheet) -> Floats:
    """Return minus the gradient of the potential energies with respect to the positions; zero at pinned vertices.

    A spring with ``d = x_a - x_b`` and ``l = |d|`` pulls with ``f_a = -k (1 - l0 / l) d = -f_b``. A spring of length
    zero has no direction, and exerts no force.

    Parameters
    ----------
    positions : ndarray of shape (P, 3)
        x, world frame.
    sheet : Sheet
        Masses, springs, gravity and floor; drag is no part of this.

    Returns
    -------
    ndarray of shape (P, 3)
        f, mass times world units per squared unit of time.
    """
    springs = sheet.springs
    d = springs.incidence @ positions  # [S, 3]
    lengths = np.linalg.norm(d, axis=1)  # [S]
    ratios = np.divide(springs.rest_lengths, lengths, out=np.ones_like(lengths), where=lengths > 0)
    f = sheet.masses[:, None] * sheet.gravity - springs.incidence.T @ ((springs.stiffness * (1 - ratios))[:, None] * d)
    if sheet.floor is not None:
        f -= sheet.floor.stiffness * depths(positions, sheet)[:, None] * _down(sheet)
    f[sheet.is_pinned] = 0
    return f


def longest_step(sheet: Sheet) -> float:
    """Return a step below which Verlet is stable, ``2 / omega``; infinite if nothing vibrates.

    A row of ``M^-1 K`` holds k / m for each spring of a vertex, once on the diagonal and once off it, so Gershgorin's
    circles give ``omega^2 <= max_v (2 sum_s k_s + k_f) / m_v``. This holds as long as no spring is compressed to less
    than half its length.
    """
    around = abs(sheet.springs.incidence).T @ sheet.springs.stiffness  # [P]
    floor = sheet.floor.stiffness if sheet.floor else 0.0
    squared = ((2 * around + floor) / sheet.masses)[~sheet.is_pinned]
    return 2 / float(np.sqrt(squared.max())) if len(squared) and squared.max() > 0 else np.inf


def integrate(state: State, sheet: Sheet, step: float, n_steps: int) -> State:
    """Return the state of a sheet after a number of steps of velocity Verlet; the top of this file states the step.

    Parameters
    ----------
    state : State
        The state at the start, in which pinned vertices have the velocity 0.
    sheet : Sheet
        Masses, springs, and all that acts on them.
    step : float
        h, below :func:`longest_step`; units of time.
    n_steps : int
        Number of steps, 0 or more.
    """
    half, inverse_masses = step / 2, 1 / sheet.masses[:, None]
    x, v, dissipated = state.positions.copy(), state.velocities.copy(), state.dissipated
    acceleration = inverse_masses * forces(x, sheet)
    for _ in range(n_steps):
        dissipated += _slow_down(x, v, sheet, half)
        v += half * acceleration
        x += step * v
        acceleration = inverse_masses * forces(x, sheet)
        v += half * acceleration
        dissipated += _slow_down(x, v, sheet, half)
    return State(x, v, dissipated)


def _slow_down(positions: Floats, velocities: Floats, sheet: Sheet, time: float) -> float:
    """Multiply velocities by ``e^(-c time)``, in place, and return the kinetic energy that this takes away."""
    if sheet.drag == 0 and (sheet.floor is None or sheet.floor.drag == 0):
        return 0.0
    rates = np.full(len(positions), sheet.drag)
    if sheet.floor is not None:
        rates += np.where(depths(positions, sheet) > 0, sheet.floor.drag, 0.0)
    decay = np.exp(-rates * time)[:, None]  # [P, 1]
    lost = float(np.sum(sheet.masses[:, None] * (1 - decay * decay) * velocities**2) / 2)
    velocities *= decay
    return lost


def _down(sheet: Sheet) -> Floats:
    return sheet.gravity / np.linalg.norm(sheet.gravity)
