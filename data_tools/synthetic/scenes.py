"""Synthetic scenes, stage 5: the four worlds. Metres, z up, the floor at z = 0.

``room``: textured walls, furniture with thin rods, spheres and boxes. ``plain-wall``: walls without any texture fill
most of the picture. ``glossy``: polished things, whose look changes with the viewpoint. ``outdoor``: open ground with a
few objects under a sky that has no depth.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from data_tools.synthetic.cameras import Orbit
from data_tools.synthetic.geometry import Box, Cylinder, Primitive, Rectangle, Shape, Sphere
from data_tools.synthetic.materials import (
    Bricks,
    Checker,
    Material,
    Noise,
    Plain,
    Stripes,
    Texture,
    linear_rgb,
    random_lattice,
)
from data_tools.synthetic.tracer import World
from minisplat_ref.types import Floats

ROOM_HALF = 2.6  # m from the middle of the room to each wall
ROOM_HEIGHT = 2.6  # m


class Setting(NamedTuple):
    """A world and the way around it."""

    world: World
    """What is seen."""
    orbit: Orbit
    """From where."""


def room(rng: np.random.Generator) -> Setting:
    """A furnished room: every wall has a texture of its own, the chair and the clothes rack are thin rods."""
    lattice = random_lattice(rng)
    streaks = Noise("#000000", "#ffffff", np.array([0.9, 0.06, 1.0]), lattice)
    clouds = Noise("#6f8f86", "#a9bfae", np.array([0.5, 0.5, 0.5]), lattice, contrast=1.6)
    grain = Noise("#000000", "#ffffff", np.array([0.12, 0.12, 0.12]), lattice, n_octaves=2)
    walls: tuple[Texture, ...] = (
        Bricks("#d8c8b4", "#a4573f", "#cf8a63", 0.42, 0.16, 0.02, grain),
        Stripes("#e9dcc3", "#7fa3a8", 0.36, axis=0),
        clouds,
        Checker("#e8d9b8", "#d9a65c", 0.325),
    )
    primitives = [
        *_room_shell(Bricks("#5b3a24", "#8a5a34", "#c08a55", 1.3, 0.2, 0.012, streaks), walls),
        *_picture(np.array([2.58, 0.5, 1.45]), -90.0, lattice, "#274b7a", "#f2b84b"),
        *_picture(np.array([-2.58, -0.4, 1.4]), 90.0, lattice, "#7a2848", "#9fd3c7"),
        _place(Cylinder(1.25, 0.01), Checker("#efe4cf", "#35608c", 0.28), [0.0, 0.0, 0.01]),
        *_chair(np.array([0.55, 0.35, 0.02]), 35.0),
        *_table(np.array([-0.5, 0.35, 0.02]), lattice),
        *_rack(np.array([0.1, -0.95, 0.02]), 12.0),
        _place(
            Box(0.2, 0.2, 0.2), Stripes("#f1e6cf", "#3f8f6b", 0.13, axis=2, share=0.5), [0.75, -0.4, 0.22], _turn_z(25)
        ),
        _place(Sphere(0.18), Checker("#f5efe3", "#d2493f", 0.12), [0.05, -0.25, 0.2], _turn_z(20)),
        _place(Sphere(0.1), Plain("#f0b93a"), [-0.45, -0.6, 0.12]),
    ]
    return Setting(_lamp_world(primitives), Orbit(np.array([0.0, 0.0, 0.55]), (1.75, 2.2), (0.75, 1.75), 68.0))


def plain_wall(rng: np.random.Generator) -> Setting:
    """The same room with bare walls: a photograph says nothing about where such a wall stands."""
    lattice = random_lattice(rng)
    bare = Plain("#e4d8c6")
    streaks = Noise("#000000", "#ffffff", np.array([0.9, 0.06, 1.0]), lattice)
    primitives = [
        *_room_shell(Bricks("#5b3a24", "#8a5a34", "#c08a55", 1.3, 0.2, 0.012, streaks), (bare,) * 4),
        _place(Box(0.25, 0.25, 0.3), Checker("#f1e6cf", "#35608c", 0.16), [0.3, 0.25, 0.3], _turn_z(30)),
        _place(Sphere(0.24), Noise("#7a2848", "#f2c48d", np.full(3, 0.25), lattice, contrast=2.0), [-0.3, -0.15, 0.24]),
        _place(Cylinder(0.12, 0.35), Stripes("#f5efe3", "#3f8f6b", 0.16, axis=2), [-0.25, 0.45, 0.35]),
    ]
    return Setting(_lamp_world(primitives), Orbit(np.array([0.0, 0.0, 0.85]), (1.9, 2.3), (0.95, 1.45), 72.0))


def glossy(rng: np.random.Generator) -> Setting:
    """Polished objects on a table: highlights and reflections move when the camera does."""
    lattice = random_lattice(rng)
    marble = Noise("#2f4858", "#dfe7e4", np.full(3, 0.3), lattice, contrast=2.2)
    primitives = [
        _place(Cylinder(1.7, 0.05), Checker("#e9dfcb", "#8c6d52", 0.25), [0.0, 0.0, -0.05]),
        _place(Sphere(0.42), _polished(Plain("#a81e2b"), 0.06), [0.0, 0.0, 0.42]),
        _place(Sphere(0.26), _polished(Plain("#6d7278"), 0.7), [0.62, 0.42, 0.26]),
        _place(Sphere(0.24), _polished(marble, 0.04), [-0.6, 0.4, 0.24]),
        _place(
            Box(0.22, 0.22, 0.22),
            _polished(Checker("#f0e2c0", "#2c6e8f", 0.148), 0.05),
            [-0.42, -0.58, 0.22],
            _turn_z(28),
        ),
        _place(Cylinder(0.15, 0.3), _polished(Plain("#d99a2b"), 0.25), [0.5, -0.5, 0.3]),
    ]
    world = World(
        primitives=tuple(primitives),
        light_positions=_light_square(np.array([1.8, -1.2, 3.6]), 0.25),
        light_color=linear_rgb("#fff2dd") * 0.85,
        light_reach=3.8,
        ambient_above=linear_rgb("#a9b4c4"),
        ambient_below=linear_rgb("#6a5a4d"),
        sky=_studio,
    )
    return Setting(world, Orbit(np.array([0.0, 0.0, 0.3]), (1.9, 2.3), (0.8, 1.9), 50.0))


def outdoor(rng: np.random.Generator) -> Setting:
    """A meadow with a path, a tree, a fence, a hut and boulders; half of the picture is sky."""
    lattice = random_lattice(rng)
    grass = Noise("#4f6b2c", "#a3b35f", np.array([1.1, 1.1, 1.0]), lattice, n_octaves=4, contrast=1.5)
    leaves = Noise("#2f5a24", "#86a843", np.full(3, 0.4), lattice, contrast=1.8)
    stone = Noise("#6c665f", "#c4bcae", np.full(3, 0.4), lattice, contrast=1.7)
    brick = Bricks("#ddd0bd", "#9c5238", "#c9825c", 0.3, 0.11, 0.018, stone, up_axis=2)
    primitives = [
        _sheet(150.0, 150.0, grass, [0.0, 0.0, 0.0]),
        _place(Cylinder(1.7, 0.01), Noise("#a98d66", "#d8c19a", np.full(3, 0.3), lattice), [0.0, 0.0, 0.01]),
        *_tree(np.array([-0.75, 0.7, 0.0]), leaves),
        *_fence(np.array([1.1, 1.0, 0.0])),
        _place(Box(0.45, 0.4, 0.45), brick, [0.8, -0.65, 0.45], _turn_z(20)),
        _place(Box(0.55, 0.5, 0.04), Stripes("#7b3f35", "#99564a", 0.14, axis=1), [0.8, -0.65, 0.94], _turn_z(20)),
        _place(Sphere(0.3), stone, [-0.75, -0.7, 0.2]),
        _place(Sphere(0.18), stone, [-0.25, -1.0, 0.1]),
        _place(Sphere(0.25), Stripes("#f5efe3", "#d2493f", 0.2, axis=0), [0.0, 0.1, 0.27], _turn_z(40)),
    ]
    world = World(
        primitives=tuple(primitives),
        light_positions=_light_square(np.array([60.0, -35.0, 70.0]), 1.5),
        light_color=linear_rgb("#fff0d2") * 1.0,
        light_reach=float(np.linalg.norm([60.0, -35.0, 70.0])),
        ambient_above=linear_rgb("#9fb6d8"),
        ambient_below=linear_rgb("#5a5240"),
        sky=_Sky(Noise("#000000", "#ffffff", np.array([0.5, 0.5, 0.16]), lattice, n_octaves=4, contrast=2.0)),
    )
    return Setting(world, Orbit(np.array([0.0, 0.0, 0.75]), (3.3, 4.1), (0.7, 1.8), 60.0))


SETTINGS: dict[str, Callable[[np.random.Generator], Setting]] = {
    "room": room,
    "plain-wall": plain_wall,
    "glossy": glossy,
    "outdoor": outdoor,
}
"""The scenes by name."""


def _lamp_world(primitives: list[Primitive]) -> World:
    """A room's light: a lamp under the ceiling, and walls that scatter a warm rest of it."""
    lamp = np.array([0.35, -0.25, ROOM_HEIGHT - 0.12])
    panel = _place(
        Box(0.3, 0.3, 0.02), Material(Plain("#fffaf0"), is_light=True), lamp + np.array([0.0, 0.0, 0.06]), np.eye(3)
    )
    return World(
        primitives=(*primitives, panel),
        light_positions=_light_square(lamp, 0.2),
        light_color=linear_rgb("#fff3e0") * 0.72,
        light_reach=2.4,
        ambient_above=linear_rgb("#b3a99f"),
        ambient_below=linear_rgb("#978b83"),
        sky=None,
    )


def _room_shell(floor: Texture, walls: tuple[Texture, ...]) -> list[Primitive]:
    """Floor, ceiling and four walls; on a wall the texture's x runs along it and its y is up."""
    shell = [
        _sheet(ROOM_HALF, ROOM_HALF, floor, [0.0, 0.0, 0.0]),
        _sheet(ROOM_HALF, ROOM_HALF, Plain("#efe9df"), [0.0, 0.0, ROOM_HEIGHT]),
    ]
    for index, texture in enumerate(walls):
        upright = _turn_z(90.0 * index) @ _STANDING
        centre = upright @ np.array([0.0, 0.0, -ROOM_HALF]) + np.array([0.0, 0.0, 0.5 * ROOM_HEIGHT])
        shell.append(_sheet(ROOM_HALF, 0.5 * ROOM_HEIGHT, texture, centre, upright))
    return shell


def _picture(centre: Floats, turn: float, lattice: Floats, low: str, high: str) -> list[Primitive]:
    """A framed abstract painting, flat on a wall."""
    upright = _turn_z(turn) @ _STANDING
    front = upright[:, 2]
    painting = Noise(low, high, np.array([0.35, 0.25, 1.0]), lattice, contrast=2.5)
    return [
        _place(Box(0.5, 0.36, 0.02), Plain("#f3ede2"), centre, upright),
        _place(Box(0.42, 0.28, 0.02), painting, centre + 0.005 * front, upright),
    ]


def _chair(foot: Floats, turn: float) -> list[Primitive]:
    """Four legs, a seat and a barred back, all rods of 1 to 2 cm radius."""
    wood = Plain("#c9793b")
    half, seat, top = 0.21, 0.45, 0.95
    at = _Placement(foot, _turn_z(turn))
    corners = [(sx * half, sy * half) for sx in (-1, 1) for sy in (-1, 1)]
    legs = [at.rod([x, y, 0.0], [x, y, top if y > 0 else seat], 0.018, wood) for x, y in corners]
    bars = [at.thin_rod([x, half, seat], [x, half, top], 0.009, wood) for x in np.linspace(-half, half, 7)[1:-1]]
    rails = [at.rod([-half, half, z], [half, half, z], 0.014, wood) for z in (0.62, top)]
    cushion = at.place(Box(0.24, 0.24, 0.025), Checker("#e9d8b0", "#4f7d6f", 0.12), [0.0, 0.0, seat])
    return [*legs, *bars, *rails, cushion]


def _table(foot: Floats, lattice: Floats) -> list[Primitive]:
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


def _rack(foot: Floats, turn: float) -> list[Primitive]:
    """A clothes rack: a lattice of rods of 6 to 10 mm radius, the thinnest things in the room."""
    at = _Placement(foot, _turn_z(turn))
    steel = Material(Plain("#3c4650"), highlight=0.25, shininess=40.0)
    height, half = 0.85, 0.34
    posts = [at.thin_rod([x, 0.0, 0.0], [x, 0.0, height], 0.01, steel) for x in np.linspace(-half, half, 5)]
    bars = [at.thin_rod([-half, 0.0, z], [half, 0.0, z], 0.006, steel) for z in np.linspace(0.2, height, 4)]
    return [*posts, *bars]


def _tree(foot: Floats, leaves: Texture) -> list[Primitive]:
    """A trunk with a crown of overlapping balls."""
    at = _Placement(foot, np.eye(3))
    crown = [((0.0, 0.0, 1.65), 0.55), ((0.4, 0.1, 1.4), 0.36), ((-0.38, 0.15, 1.45), 0.38), ((0.0, -0.35, 1.4), 0.35)]
    return [
        at.rod([0.0, 0.0, 0.0], [0.0, 0.0, 1.4], 0.1, Stripes("#5d4330", "#775a41", 0.09, axis=2)),
        *(at.place(Sphere(radius), leaves, list(centre)) for centre, radius in crown),
    ]


def _fence(foot: Floats) -> list[Primitive]:
    """Thin posts with two rails."""
    at = _Placement(foot, _turn_z(-40.0))
    white = Plain("#efe9dd")
    posts = [at.rod([x, 0.0, 0.0], [x, 0.0, 0.7], 0.025, white) for x in np.linspace(-0.9, 0.9, 10)]
    rails = [at.rod([-0.95, 0.0, z], [0.95, 0.0, z], 0.02, white) for z in (0.25, 0.55)]
    return [*posts, *rails]


class _Sky:
    """Clouds on a gradient from a pale horizon to a blue zenith."""

    def __init__(self, clouds: Noise) -> None:
        self.clouds = clouds

    def __call__(self, directions: Floats) -> Floats:
        up = np.clip(directions[:, 2], 0.0, 1.0)  # [n]
        horizon, zenith = linear_rgb("#dbe7f0"), linear_rgb("#4f8fd0")
        clear = horizon + np.sqrt(up)[:, None] * (zenith - horizon)  # [n, 3]
        cover = np.clip(2.0 * self.clouds.values(directions) - 1.0, 0.0, 1.0) * np.minimum(4.0 * up, 1.0)
        return clear + 0.85 * cover[:, None] * (1.0 - clear)


def _studio(directions: Floats) -> Floats:
    """A photographer's backdrop: dark floor to light ceiling, with two bright soft boxes to be mirrored."""
    up = directions[:, 2:]  # [n, 1]
    colors = linear_rgb("#3d4650") + (0.5 + 0.5 * up) * (linear_rgb("#c9d3dd") - linear_rgb("#3d4650"))
    for towards, width in (((0.45, -0.3, 0.85), 0.16), ((-0.7, 0.6, 0.35), 0.1)):
        unit = np.array(towards) / np.linalg.norm(towards)
        glow = 1.0 / (1.0 + np.exp(-(directions @ unit - (1.0 - width**2)) / 0.004))
        colors = colors + 0.8 * glow[:, None] * linear_rgb("#fff6e6")
    return colors


def _polished(texture: Texture, reflectance: float) -> Material:
    """A lacquered or metallic surface."""
    return Material(texture, highlight=0.8, shininess=120.0, reflectance=reflectance)


class _Placement(NamedTuple):
    """A piece of furniture's own frame, so that its parts are described where they belong on it."""

    origin: Floats
    rotation: Floats

    def place(self, shape: Shape, look: Texture | Material, centre: list[float]) -> Primitive:
        return _place(shape, look, self.origin + self.rotation @ np.array(centre), self.rotation)

    def rod(self, start: list[float], end: list[float], radius: float, look: Texture | Material) -> Primitive:
        """A cylinder from one point to another."""
        axis = np.array(end) - np.array(start)
        length = float(np.linalg.norm(axis))
        middle = self.rotation @ (0.5 * (np.array(start) + np.array(end))) + self.origin
        return _place(Cylinder(radius, 0.5 * length), look, middle, self.rotation @ _frame_along(axis / length))

    def thin_rod(self, start: list[float], end: list[float], radius: float, look: Texture | Material) -> Primitive:
        """A rod without a shadow: under a lamp this wide it is too faint to see, but four samples would draw lines."""
        return self.rod(start, end, radius, look)._replace(casts_shadow=False)


def _place(
    shape: Shape, look: Texture | Material, centre: list[float] | Floats, rotation: Floats | None = None
) -> Primitive:
    """A primitive; a bare texture is a matte material."""
    material = look if isinstance(look, Material) else Material(look)
    return Primitive(shape, material, np.array(centre, float), np.eye(3) if rotation is None else rotation)


def _sheet(
    half_x: float, half_y: float, look: Texture, centre: list[float] | Floats, rotation: Floats | None = None
) -> Primitive:
    """A wall, floor or ceiling: the world ends behind it."""
    return _place(Rectangle(half_x, half_y), look, centre, rotation)._replace(casts_shadow=False)


def _light_square(centre: Floats, half: float) -> Floats:
    """[4, 3] samples of a square light that faces down."""
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])
    return centre + half * corners


_STANDING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""[3, 3] rotation of a sheet from lying to standing: its y becomes the world's z, and it faces -y."""


def _turn_z(degrees: float) -> Floats:
    """[3, 3] rotation about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _frame_along(axis: Floats) -> Floats:
    """[3, 3] rotation whose third column is the axis."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis], axis=1)
