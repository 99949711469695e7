"""The surfaces of a synthetic world as triangles, for mesh programs and as the truth of meshes.

Every primitive is closed and complete, also where others hide it. Boxes and sheets are exact; the vertices of balls and
cylinders lie on them, so that a triangle is inside by at most ``r (1 - cos(pi / N_AROUND))``, a thousandth of r.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.datasets.synthetic.shapes import Box, Cylinder, Rectangle, Shape, Sphere
from minisplat_ref.datasets.synthetic.tracer import World
from minisplat_ref.io.srgb import encode_srgb
from minisplat_ref.types import Floats, Ints

N_AROUND = 64  # vertices of a circle


class Triangles(NamedTuple):
    """A mesh of several surfaces."""

    vertices: Floats
    """[P, 3] world frame."""
    faces: Ints
    """[T, 3] rows of the vertices, counter-clockwise seen from outside; a sheet's from where its z axis points."""
    colors: Floats
    """[P, 3] sRGB in [0, 1], the albedo without light."""
    ids: Ints
    """[T] index of the primitive."""


def triangulate_world(world: World) -> Triangles:
    """Return the triangles of all primitives of a world."""
    parts, n_vertices = [], 0
    for index, primitive in enumerate(world.primitives):
        local, faces = triangulate(primitive.shape)
        vertices = local @ primitive.world_from_local_R.T + primitive.centre
        colors = encode_srgb(np.clip(primitive.material.texture(local), 0, 1))
        parts.append(Triangles(vertices, faces + n_vertices, colors, np.full(len(faces), index)))
        n_vertices += len(vertices)
    return Triangles(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def triangulate(shape: Shape) -> tuple[Floats, Ints]:
    """Return vertices [P, 3] and faces [T, 3] of a shape in its own frame."""
    if isinstance(shape, Rectangle):
        corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        return corners * [shape.half_x, shape.half_y, 0], np.array([[0, 1, 2], [0, 2, 3]])
    if isinstance(shape, Box):
        corners = np.array([[x, y, z] for z in (-1.0, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        return corners * [shape.half_x, shape.half_y, shape.half_z], _closed_rings(4, 2, has_poles=False)
    if isinstance(shape, Sphere):
        polar = np.pi * (np.arange(1, N_AROUND // 2) / (N_AROUND // 2) - 1)  # from the south pole up
        rings = [_ring(-np.sin(angle), np.cos(angle)) for angle in polar]
        unit = np.concatenate([*rings, [[0, 0, -1.0], [0, 0, 1.0]]])
        return shape.radius * unit, _closed_rings(N_AROUND, len(rings), has_poles=True)
    if isinstance(shape, Cylinder):
        radius, z = shape.radius, shape.half_length
        vertices = np.concatenate([_ring(radius, -z), _ring(radius, z), [[0, 0, -z], [0, 0, z]]])
        return vertices, _closed_rings(N_AROUND, 2, has_poles=True)
    raise TypeError(f"no triangles of a {type(shape).__name__}")


def _ring(radius: float, z: float) -> Floats:
    """Return the vertices [N_AROUND, 3] of a horizontal circle."""
    angles = 2 * np.pi * np.arange(N_AROUND) / N_AROUND
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(N_AROUND, z)], axis=1)


def _closed_rings(n: int, n_rings: int, *, has_poles: bool) -> Ints:
    """Return the faces between rings of n vertices from below up, closed by a fan at either end.

    The fans meet in two poles, the last vertices, or else in the first vertex of the ring.
    """
    here = np.arange(n)
    there = (here + 1) % n
    faces = []
    for ring in range(n_rings - 1):
        low, high = n * ring, n * (ring + 1)
        faces += [np.stack([low + here, low + there, high + there], axis=1)]
        faces += [np.stack([low + here, high + there, high + here], axis=1)]
    top = n * (n_rings - 1)
    if has_poles:
        south = np.full(n, n * n_rings)
        faces += [np.stack([south, there, here], axis=1), np.stack([south + 1, top + here, top + there], axis=1)]
    else:
        fan = here[1:-1]
        faces += [
            np.stack([0 * fan, fan + 1, fan], axis=1),
            np.stack([0 * fan + top, top + fan, top + fan + 1], axis=1),
        ]
    return np.concatenate(faces)
