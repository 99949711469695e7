"""Secondary rays: shadows of point lights, mirrors, glass, and triangles among the Gaussians, without gradients.

This is section 3.3 of RaySplats. A ray blends the Gaussians in front of the first triangle, and the triangle gets the
transmittance that they leave:

    C = sum_i w_i c_i V_i + T_end * { albedo * E(x)       diffuse
                                      tint * C'           mirror, C' along d - 2 (d . n) n
                                      F C' + (1 - F) tint C''   glass, C'' along Snell's d'
                                      background          no triangle }

The light that reaches x is ``E = a + (1 - a) mean_l |n . l| V_l``, with the ambient fraction a; for a Gaussian, whose
normal is unknown, it is ``a + (1 - a) mean_l V_l``. V_l is the transmittance between x and lamp l, 0 behind a triangle
that is not glass. A Gaussian's colour includes the light under which it was photographed; shadows multiply it.

The intersection of the ray ``O + t d`` with the triangle p0, p1, p2 follows from Cramer's rule (Moeller and Trumbore
1997), with ``e1 = p1 - p0``, ``e2 = p2 - p0``, ``s = O - p0`` and ``D = e1 . (d x e2)``:

    u = s . (d x e2) / D,   v = d . (s x e1) / D,   t = e2 . (s x e1) / D;    hit if u, v >= 0 and u + v <= 1

A ray that continues from x = O + t d in the direction d' keeps its t; its origin becomes ``x - t d'``, the apparent
position of the eye. Behind a mirror this is exactly the mirrored camera. Rays that have hit ``BOUNCES_MAX`` surfaces
ignore further ones, and those that carry less than ``LEAST`` end.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.mechanisms.meshes.mesh import Mesh
from minisplat_ref.mechanisms.rays.pixel_rays import Hits, Rays, Tracer
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.types import Bools, Floats, Gaussians, Ints

PAIRS_AT_ONCE = 1 << 18  # of rays and triangles: some ten arrays of 3 float64, 60 MB
NONE = -1
AWAY = 1e-7  # fraction of t by which a ray starts off the surface that it leaves
DIFFUSE, MIRROR, GLASS = range(3)
INDEX = 1.5  # of window glass
BOUNCES_MAX = 3
LEAST = 1e-4  # of the light that a ray carries, in the brightest channel
HITS_AT_ONCE = 1 << 17


class Surfaces(NamedTuple):
    """Triangles and their materials."""

    corners: Floats
    """[F, 3, 3] triangle, corner, axis; world frame."""
    normals: Floats
    """[F, 3] unit normals, which point out of glass."""
    kinds: Ints
    """[F] ``DIFFUSE``, ``MIRROR`` or ``GLASS``."""
    colors: Floats
    """[F, 3] fraction of the light that is reflected or transmitted."""
    indices: Floats
    """[F] index of refraction."""


def find_normals(corners: Floats) -> Floats:
    """Return the unit normals [F, 3] of triangles [F, 3, 3] that have an area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit: Floats = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit


def nearest_triangles(corners: Floats, rays: Rays) -> tuple[Floats, Ints]:
    """Return the first triangle on each ray between its limits.

    Parameters
    ----------
    corners : ndarray of shape (F, 3, 3)
        Triangles; F may be 0.
    rays : Rays
        P rays.

    Returns
    -------
    depths : ndarray of shape (P,)
        t; infinite where there is none.
    faces : ndarray of shape (P,)
        Rows of the triangles; ``NONE`` where there is none.
    """
    n_rays = len(rays.near)
    depths, faces = np.full(n_rays, np.inf), np.full(n_rays, NONE)
    if len(corners) == 0:
        return depths, faces
    p0, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    step = max(1, PAIRS_AT_ONCE // len(corners))
    for first in range(0, n_rays, step):
        part = slice(first, first + step)
        d, s = rays.directions[part, None], rays.origins[part, None] - p0  # [P', 1, 3], [P', F, 3]
        across, around = np.cross(d, e2), np.cross(s, e1)  # [P', F, 3]
        with np.errstate(divide="ignore", invalid="ignore"):  # D = 0: the ray is parallel to the triangle
            inverse = 1 / np.sum(e1 * across, axis=2)  # [P', F]
            u, v = np.sum(s * across, axis=2) * inverse, np.sum(d * around, axis=2) * inverse
            t = np.sum(e2 * around, axis=2) * inverse
            is_hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > rays.near[part, None]) & (t < rays.far[part, None])
        t = np.where(is_hit, t, np.inf)
        nearest = np.argmin(t, axis=1)
        depths[part] = t[np.arange(len(t)), nearest]
        faces[part] = np.where(np.isfinite(depths[part]), nearest, NONE)
    return depths, faces


def continue_rays(rays: Rays, depths: Floats, directions: Floats) -> Rays:
    """Return rays [P] that leave ``O + t d`` in new directions [P, 3] of the same lengths and keep counting t."""
    points = rays.origins + depths[:, None] * rays.directions
    return Rays(points - depths[:, None] * directions, directions, depths, rays.far)


def reflect(directions: Floats, normals: Floats) -> Floats:
    """Return ``d' = d - 2 (d . n) n`` [P, 3]."""
    return directions - 2 * np.sum(directions * normals, axis=1, keepdims=True) * normals


def refract(directions: Floats, normals: Floats, indices: Floats) -> tuple[Floats, Floats, Bools]:
    """Return the refracted directions at the boundary of glass by Snell's law, and the reflected fraction by Schlick's.

    With the ratio r of the indices before and behind the boundary, c = |d . n| / |d| and n against the ray::

        d' = r d + (r c - c') |d| n,   c' = sqrt(1 - r^2 (1 - c^2))
        F  = F0 + (1 - F0) (1 - c_air)^5,   F0 = ((1 - r) / (1 + r))^2

    with the cosine on the side of the air, c or c'. Where ``r^2 (1 - c^2) > 1`` all is reflected.

    Parameters
    ----------
    directions : ndarray of shape (P, 3)
        d, of any length.
    normals : ndarray of shape (P, 3)
        Unit normals that point out of the glass; a ray along them leaves it.
    indices : ndarray of shape (P,)
        Indices of refraction of the glass.

    Returns
    -------
    directions : ndarray of shape (P, 3)
        d', of the same lengths; d where all is reflected.
    shares : ndarray of shape (P,)
        F in [0, 1]; 1 where all is reflected.
    is_total : ndarray of shape (P,) of booleans
        Where all is reflected.
    """
    lengths = np.linalg.norm(directions, axis=1)
    along = np.sum(directions * normals, axis=1) / lengths
    is_leaving = along > 0
    r = np.where(is_leaving, indices, 1 / indices)
    facing = np.where(is_leaving[:, None], -normals, normals)
    c = np.abs(along)
    squared = 1 - r**2 * (1 - c**2)
    is_total = squared < 0
    behind = np.sqrt(np.maximum(squared, 0))
    bent = r[:, None] * directions + ((r * c - behind) * lengths)[:, None] * facing
    F0 = ((1 - r) / (1 + r)) ** 2
    shares = F0 + (1 - F0) * (1 - np.where(is_leaving, behind, c)) ** 5
    return np.where(is_total[:, None], directions, bent), np.where(is_total, 1.0, shares), is_total


class Surroundings(NamedTuple):
    """Lights and surfaces."""

    lights: Floats
    """[L, 3] world frame; all of the same brightness."""
    ambient: float
    """Fraction in [0, 1] of light that casts no shadow."""
    bias: float
    """Fraction in [0, 1) of the way from a Gaussian to a lamp on which no Gaussian counts."""
    surfaces: Surfaces


def make_surfaces(mesh: Mesh, kind: int, color: Floats | None = None, index: float = INDEX) -> Surfaces:
    """Return the triangles of a mesh as surfaces of one kind; ``color`` is white by default."""
    n = len(mesh.faces)
    colors = np.tile(np.ones(3) if color is None else color, (n, 1))
    return Surfaces(mesh.corners, find_normals(mesh.corners), np.full(n, kind), colors, np.full(n, index))


def concatenate_surfaces(surfaces: list[Surfaces]) -> Surfaces:
    """Return several surfaces as one, which is empty if there are none."""
    nothing = Surfaces(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0))
    return Surfaces(*(np.concatenate(fields) for fields in zip(nothing, *surfaces, strict=True)))


def parallelogram(corner: Floats, sides: Floats) -> Mesh:
    """Return two triangles; the normal is along the cross product of the sides [2, 3]."""
    vertices = corner + np.array([np.zeros(3), sides[0], sides[0] + sides[1], sides[1]])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))


class World(NamedTuple):
    """Everything that a ray can hit."""

    gaussians: Gaussians
    tracer: Tracer
    surroundings: Surroundings
    background: Floats
    """[3]."""
    conventions: Conventions


class _Bundle(NamedTuple):
    """Rays, with the pixels to which they contribute and their throughput."""

    rays: Rays
    pixels: Ints  # [R]
    throughput: Floats  # [R, 3]

    def some(self, rows: Ints, rays: Rays, factors: Floats) -> "_Bundle":
        """Return ``rays`` that continue from rows [R'] with factors [R', 3], without those that carry no light."""
        throughput = self.throughput[rows] * factors
        kept = throughput.max(axis=1, initial=0.0) >= LEAST
        return _Bundle(_rows(rays, kept), self.pixels[rows][kept], throughput[kept])


def shade(world: World, rays: Rays) -> Floats:
    """Return the colours [P, 3] that rays see.

    Parameters
    ----------
    world : World
        What they can hit.
    rays : Rays
        P rays from the eye.
    """
    n_rays = len(rays.near)
    image = np.zeros((n_rays, 3))
    waiting = [_Bundle(rays, np.arange(n_rays), np.ones((n_rays, 3)))]
    for bounce in range(BOUNCES_MAX + 1):
        following: list[_Bundle] = []
        for bundle in waiting:
            following += _advance(world, bundle, image, sees_surfaces=bounce < BOUNCES_MAX)
        waiting = following
    return image


def _advance(world: World, bundle: _Bundle, image: Floats, *, sees_surfaces: bool) -> list[_Bundle]:
    """Add the light of one segment of each ray to the image, and return the secondary rays."""
    rays, surfaces = bundle.rays, world.surroundings.surfaces
    leaving = rays._replace(near=rays.near * (1 + AWAY))
    corners = surfaces.corners if sees_surfaces else surfaces.corners[:0]
    depths, faces = nearest_triangles(corners, leaving)
    hits = world.tracer.list_hits(rays._replace(far=np.minimum(rays.far, depths)), world.conventions)
    light, rest = gaussian_light(world, rays, hits), hits.transmittances[:, None]  # [R, 3], [R, 1]
    kinds = np.where(faces >= 0, surfaces.kinds[faces] if len(corners) else -1, -1)  # [R]
    missed, diffuse, mirror, glass = (np.flatnonzero(kinds == kind) for kind in (-1, DIFFUSE, MIRROR, GLASS))
    light[missed] += rest[missed] * world.background
    points = rays.origins[diffuse] + depths[diffuse, None] * rays.directions[diffuse]
    lit = irradiance(world, points, surfaces.normals[faces[diffuse]])
    light[diffuse] += rest[diffuse] * surfaces.colors[faces[diffuse]] * lit[:, None]
    np.add.at(image, bundle.pixels, bundle.throughput * light)

    following = []
    for rows in (mirror, glass):
        arriving, normals = _rows(rays, rows), surfaces.normals[faces[rows]]
        colors = rest[rows] * surfaces.colors[faces[rows]]
        back = continue_rays(arriving, depths[rows], reflect(arriving.directions, normals))
        if rows is mirror:
            following.append(bundle.some(rows, back, colors))
            continue
        bent, shares, _ = refract(arriving.directions, normals, surfaces.indices[faces[rows]])
        through = continue_rays(arriving, depths[rows], bent)
        following.append(bundle.some(rows, back, rest[rows] * shares[:, None]))
        following.append(bundle.some(rows, through, colors * (1 - shares)[:, None]))
    return [some for some in following if len(some.pixels)]


def gaussian_light(world: World, rays: Rays, hits: Hits) -> Floats:
    """Return ``sum_i w_i c_i E_i`` [R, 3] over the hits of R rays, with colours towards each ray's own origin."""
    light = np.zeros((len(rays.near), 3))
    g = world.gaussians
    coefficients = np.concatenate([g.sh_dc[:, None], g.sh_rest], axis=1)  # [N, K, 3]
    degree = int(np.sqrt(coefficients.shape[1])) - 1
    for first in range(0, len(hits.ray_ids), HITS_AT_ONCE):
        part = slice(first, first + HITS_AT_ONCE)
        ids, ray_ids = hits.gaussian_ids[part], hits.ray_ids[part]
        towards = g.means[ids] - rays.origins[ray_ids]
        basis = sh_basis(towards / np.linalg.norm(towards, axis=1, keepdims=True), degree)
        colors = np.maximum(0, 0.5 + np.einsum("hk,hkc->hc", basis, coefficients[ids]))
        points = rays.origins[ray_ids] + hits.depths[part, None] * rays.directions[ray_ids]
        factors = hits.weights[part] * irradiance(world, points, None)
        np.add.at(light, ray_ids, factors[:, None] * colors)
    return light


def irradiance(world: World, points: Floats, normals: Floats | None) -> Floats:
    """Return E [Q] at points [Q, 3] with normals [Q, 3], or at points of Gaussians; 1 where there is no lamp."""
    lights, ambient = world.surroundings.lights, world.surroundings.ambient
    if len(lights) == 0 or len(points) == 0:
        return np.ones(len(points))
    direct = np.zeros(len(points))
    for light in lights:
        to_light = light - points
        facing = np.ones(len(points))
        if normals is not None:
            facing = np.abs(np.sum(normals * to_light, axis=1)) / np.linalg.norm(to_light, axis=1)
        start = world.surroundings.bias if normals is None else AWAY
        direct += facing * visibility(world, points, to_light, start) / len(lights)
    return ambient + (1 - ambient) * direct


def visibility(world: World, points: Floats, to_light: Floats, start: float) -> Floats:
    """Return the transmittance ``V = prod (1 - alpha)`` between a lamp and each point.

    Parameters
    ----------
    world : World
        What may lie between.
    points, to_light : ndarray of shape (Q, 3)
        The points, and the vector from each to the lamp, world units.
    start : float
        Fraction of that vector along which no Gaussian counts.

    Returns
    -------
    ndarray of shape (Q,)
    """
    n = len(points)
    rays = Rays(points, to_light, np.full(n, start), np.ones(n))
    surfaces = world.surroundings.surfaces
    _, faces = nearest_triangles(surfaces.corners[surfaces.kinds != GLASS], rays._replace(near=np.full(n, AWAY)))
    lit = np.flatnonzero(faces < 0)
    V = np.zeros(n)
    nothing = np.zeros((len(world.gaussians.means), 3))
    V[lit] = world.tracer.blend(nothing, _rows(rays, lit), np.zeros(3), world.conventions).transmittances
    return V


def _rows(rays: Rays, rows: Floats | Ints) -> Rays:
    """Return some of the rays."""
    return Rays(*(np.ascontiguousarray(field[rows]) for field in rays))
