"""Synthetic scenes, stage 6: the furniture. Metres, z up.

Every piece is a list of primitives, described in its own frame on the floor.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.datasets.synthetic.geometry import Primitive
from minisplat_ref.datasets.synthetic.materials import Checker, Material, Noise, Plain, Stripes, Texture
from minisplat_ref.datasets.synthetic.shapes import Box, Cylinder, Rectangle, Shape, Sphere
from minisplat_ref.types import Floats

ROOM_HALF = 2.6  # from the middle of a room to each wall
ROOM_HEIGHT = 2.6


def room_shell(floor: Texture, walls: tuple[Texture, ...]) -> list[Primitive]:
    """Floor, ceiling and four walls; on a wall the texture's x runs along it and its y is up."""
    shell = [
        sheet(ROOM_HALF, ROOM_HALF, floor, [0.0, 0.0, 0.0]),
        sheet(ROOM_HALF, ROOM_HALF, Plain("#efe9df"), [0.0, 0.0, ROOM_HEIGHT]),
    ]
    for index, texture in enumerate(walls):
        upright = rotate_z(90.0 * index) @ _STANDING
        centre = upright @ np.array([0.0, 0.0, -ROOM_HALF]) + np.array([0.0, 0.0, 0.5 * ROOM_HEIGHT])
        shell.append(sheet(ROOM_HALF, 0.5 * ROOM_HEIGHT, texture, centre, upright))
    return shell


def painting(centre: Floats, angle: float, lattice: Floats, low: str, high: str) -> list[Primitive]:
    """A framed abstract painting, flat on a wall."""
    upright = rotate_z(angle) @ _STANDING
    front = upright[:, 2]
    painting = Noise(low, high, np.array([0.35, 0.25, 1.0]), lattice, contrast=2.5)
    return [
        place(Box(0.5, 0.36, 0.02), Plain("#f3ede2"), centre, upright),
        place(Box(0.42, 0.28, 0.02), painting, centre + 0.005 * front, upright),
    ]


def chair(foot: Floats, angle: float) -> list[Primitive]:
    """Four legs, a seat and a barred back, all rods of 1 to 2 cm radius."""
    wood = Plain("#c9793b")
    half, seat, top = 0.21, 0.45, 0.95
    at = _Placement(foot, rotate_z(angle))
    corners = [(sx * half, sy * half) for sx in (-1, 1) for sy in (-1, 1)]
    legs = [at.rod([x, y, 0.0], [x, y, top if y > 0 else seat], 0.018, wood) for x, y in corners]
    bars = [at.thin_rod([x, half, seat], [x, half, top], 0.009, wood) for x in np.linspace(-half, half, 7)[1:-1]]
    rails = [at.rod([-half, half, z], [half, half, z], 0.014, wood) for z in (0.62, top)]
    cushion = at.place(Box(0.24, 0.24, 0.025), Checker("#e9d8b0", "#4f7d6f", 0.12), [0.0, 0.0, seat])
    return [*legs, *bars, *rails, cushion]


def table(foot: Floats, lattice: Floats) -> list[Primitive]:
    """A round table with a marble ball and a striped vase on it."""
    at = _Placement(foot, np.eye(3))
    wood = Noise("#7a4a2a", "#b9804e", np.array([0.08, 0.6, 0.3]), lattice, contrast=1.6)
    marble = Noise("#31516b", "#eef1ee", np.full(3, 0.13), lattice, contrast=2.4)
    return [
        at.place(Cylinder(0.38, 0.02), wood, [0.0, 0.0, 0.58]),
        at.rod([0.0, 0.0, 0.0], [0.0, 0.0, 0.58], 0.035, Plain("#4a4540")),
        at.place(Cylinder(0.22, 0.015), Plain("#4a4540"), [0.0, 0.0, 0.015]),
        at.place(Sphere(0.13), marble, [0.12, 0.1, 0.73]),
        at.place(Cylinder(0.065, 0.14), Stripes("#f4ead6", "#c2553f", 0.08, axis=2), [-0.14, -0.1, 0.74]),
    ]


def rack(foot: Floats, angle: float) -> list[Primitive]:
    """A clothes rack: a lattice of rods of 6 to 10 mm radius, the thinnest things in the room."""
    at = _Placement(foot, rotate_z(angle))
    steel = Material(Plain("#3c4650"), highlight=0.25, shininess=40.0)
    height, half = 0.85, 0.34
    posts = [at.thin_rod([x, 0.0, 0.0], [x, 0.0, height], 0.01, steel) for x in np.linspace(-half, half, 5)]
    bars = [at.thin_rod([-half, 0.0, z], [half, 0.0, z], 0.006, steel) for z in np.linspace(0.2, height, 4)]
    return [*posts, *bars]


def tree(foot: Floats, leaves: Texture) -> list[Primitive]:
    """A trunk with a crown of overlapping balls."""
    at = _Placement(foot, np.eye(3))
    crown = [((0.0, 0.0, 1.65), 0.55), ((0.4, 0.1, 1.4), 0.36), ((-0.38, 0.15, 1.45), 0.38), ((0.0, -0.35, 1.4), 0.35)]
    return [
        at.rod([0.0, 0.0, 0.0], [0.0, 0.0, 1.4], 0.1, Stripes("#5d4330", "#775a41", 0.09, axis=2)),
        *(at.place(Sphere(radius), leaves, list(centre)) for centre, radius in crown),
    ]


def fence(foot: Floats) -> list[Primitive]:
    """Thin posts with two rails."""
    at = _Placement(foot, rotate_z(-40.0))
    white = Plain("#efe9dd")
    posts = [at.rod([x, 0.0, 0.0], [x, 0.0, 0.7], 0.025, white) for x in np.linspace(-0.9, 0.9, 10)]
    rails = [at.rod([-0.95, 0.0, z], [0.95, 0.0, z], 0.02, white) for z in (0.25, 0.55)]
    return [*posts, *rails]


class _Placement(NamedTuple):
    """The local frame of a piece of furniture, in which its parts are described."""

    origin: Floats
    rotation: Floats

    def place(self, shape: Shape, look: Texture | Material, centre: list[float]) -> Primitive:
        return place(shape, look, self.origin + self.rotation @ np.array(centre), self.rotation)

    def rod(self, start: list[float], end: list[float], radius: float, look: Texture | Material) -> Primitive:
        """A cylinder from one point to another."""
        axis = np.array(end) - np.array(start)
        length = float(np.linalg.norm(axis))
        middle = self.rotation @ (0.5 * (np.array(start) + np.array(end))) + self.origin
        return place(Cylinder(radius, 0.5 * length), look, middle, self.rotation @ _frame_along(axis / length))

    def thin_rod(self, start: list[float], end: list[float], radius: float, look: Texture | Material) -> Primitive:
        """A rod without a shadow: under a lamp this wide it is too faint to see, but four samples would leave lines."""
        return self.rod(start, end, radius, look)._replace(casts_shadow=False)


def place(
    shape: Shape, look: Texture | Material, centre: list[float] | Floats, rotation: Floats | None = None
) -> Primitive:
    """Place a primitive; a texture alone is a matte material."""
    material = look if isinstance(look, Material) else Material(look)
    return Primitive(shape, material, np.array(centre, float), np.eye(3) if rotation is None else rotation)


def sheet(
    half_x: float, half_y: float, look: Texture, centre: list[float] | Floats, rotation: Floats | None = None
) -> Primitive:
    """Place a wall, floor or ceiling, behind which the world ends."""
    return place(Rectangle(half_x, half_y), look, centre, rotation)._replace(casts_shadow=False)


_STANDING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""[3, 3] rotation of a sheet from lying to standing: its y becomes the world's z, and it faces -y."""


def rotate_z(degrees: float) -> Floats:
    """[3, 3] rotation about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _frame_along(axis: Floats) -> Floats:
    """[3, 3] rotation whose third column is the axis."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis], axis=1)
