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

Rays that have hit ``BOUNCES_MAX`` surfaces ignore further ones, and those that carry less than ``LEAST`` end.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.extensions.rays.surfaces import (
    AWAY,
    DIFFUSE,
    GLASS,
    MIRROR,
    continue_rays,
    nearest_triangles,
    reflect,
    refract,
)
from minisplat_ref.extensions.rays.surroundings import Surroundings
from minisplat_ref.mechanisms.rays.pixel_rays import Hits, Rays, Tracer
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.types import Floats, Gaussians, Ints

BOUNCES_MAX = 3
LEAST = 1e-4  # of the light that a ray carries, in the brightest channel
HITS_AT_ONCE = 1 << 17


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
