"""Synthetic scenes, stage 7: four worlds to render, and the list of all. Metres, z up, the floor at z = 0.

``room``: textured walls, furniture with thin rods, spheres and boxes. ``plain-wall``: walls without any texture fill
most of the image. ``glossy``: polished things, whose appearance changes with the viewpoint. ``outdoor``: open ground
with a few objects under a sky that has no depth.
"""

from collections.abc import Callable

import numpy as np

from minisplat_ref.datasets.synthetic.cameras import Orbit
from minisplat_ref.datasets.synthetic.furniture import (
    ROOM_HEIGHT,
    chair,
    fence,
    painting,
    place,
    rack,
    room_shell,
    rotate_z,
    sheet,
    table,
    tree,
)
from minisplat_ref.datasets.synthetic.geometry import Primitive
from minisplat_ref.datasets.synthetic.lights import daylight, light_square, studio
from minisplat_ref.datasets.synthetic.materials import (
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
from minisplat_ref.datasets.synthetic.park import PARKS
from minisplat_ref.datasets.synthetic.shapes import Box, Cylinder, Sphere
from minisplat_ref.datasets.synthetic.tracer import World
from minisplat_ref.datasets.synthetic.truths import Setting, box_city, facing_spheres, noisy_sphere, staircase


def room(rng: np.random.Generator) -> Setting:
    """A furnished room: every wall has its own texture, the chair and the clothes rack are thin rods."""
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
        *room_shell(Bricks("#5b3a24", "#8a5a34", "#c08a55", 1.3, 0.2, 0.012, streaks), walls),
        *painting(np.array([2.58, 0.5, 1.45]), -90.0, lattice, "#274b7a", "#f2b84b"),
        *painting(np.array([-2.58, -0.4, 1.4]), 90.0, lattice, "#7a2848", "#9fd3c7"),
        place(Cylinder(1.25, 0.01), Checker("#efe4cf", "#35608c", 0.28), [0.0, 0.0, 0.01]),
        *chair(np.array([0.55, 0.35, 0.02]), 35.0),
        *table(np.array([-0.5, 0.35, 0.02]), lattice),
        *rack(np.array([0.1, -0.95, 0.02]), 12.0),
        place(
            Box(0.2, 0.2, 0.2), Stripes("#f1e6cf", "#3f8f6b", 0.13, axis=2, share=0.5), [0.75, -0.4, 0.22], rotate_z(25)
        ),
        place(Sphere(0.18), Checker("#f5efe3", "#d2493f", 0.12), [0.05, -0.25, 0.2], rotate_z(20)),
        place(Sphere(0.1), Plain("#f0b93a"), [-0.45, -0.6, 0.12]),
    ]
    return Setting(_lamp_world(primitives), Orbit(np.array([0.0, 0.0, 0.55]), (1.75, 2.2), (0.75, 1.75), 68.0))


def plain_wall(rng: np.random.Generator) -> Setting:
    """The same room with bare walls: a photograph does not reveal where such a wall is."""
    lattice = random_lattice(rng)
    bare = Plain("#e4d8c6")
    streaks = Noise("#000000", "#ffffff", np.array([0.9, 0.06, 1.0]), lattice)
    primitives = [
        *room_shell(Bricks("#5b3a24", "#8a5a34", "#c08a55", 1.3, 0.2, 0.012, streaks), (bare,) * 4),
        place(Box(0.25, 0.25, 0.3), Checker("#f1e6cf", "#35608c", 0.16), [0.3, 0.25, 0.3], rotate_z(30)),
        place(Sphere(0.24), Noise("#7a2848", "#f2c48d", np.full(3, 0.25), lattice, contrast=2.0), [-0.3, -0.15, 0.24]),
        place(Cylinder(0.12, 0.35), Stripes("#f5efe3", "#3f8f6b", 0.16, axis=2), [-0.25, 0.45, 0.35]),
    ]
    return Setting(_lamp_world(primitives), Orbit(np.array([0.0, 0.0, 0.85]), (1.9, 2.3), (0.95, 1.45), 72.0))


def glossy(rng: np.random.Generator) -> Setting:
    """Polished objects on a table: highlights and reflections move when the camera does."""
    lattice = random_lattice(rng)
    marble = Noise("#2f4858", "#dfe7e4", np.full(3, 0.3), lattice, contrast=2.2)
    primitives = [
        place(Cylinder(1.7, 0.05), Checker("#e9dfcb", "#8c6d52", 0.25), [0.0, 0.0, -0.05]),
        place(Sphere(0.42), _polish(Plain("#a81e2b"), 0.06), [0.0, 0.0, 0.42]),
        place(Sphere(0.26), _polish(Plain("#6d7278"), 0.7), [0.62, 0.42, 0.26]),
        place(Sphere(0.24), _polish(marble, 0.04), [-0.6, 0.4, 0.24]),
        place(
            Box(0.22, 0.22, 0.22),
            _polish(Checker("#f0e2c0", "#2c6e8f", 0.148), 0.05),
            [-0.42, -0.58, 0.22],
            rotate_z(28),
        ),
        place(Cylinder(0.15, 0.3), _polish(Plain("#d99a2b"), 0.25), [0.5, -0.5, 0.3]),
    ]
    world = World(
        primitives=tuple(primitives),
        light_positions=light_square(np.array([1.8, -1.2, 3.6]), 0.25),
        light_color=linear_rgb("#fff2dd") * 0.85,
        light_reach=3.8,
        ambient_above=linear_rgb("#a9b4c4"),
        ambient_below=linear_rgb("#6a5a4d"),
        sky=studio,
    )
    return Setting(world, Orbit(np.array([0.0, 0.0, 0.3]), (1.9, 2.3), (0.8, 1.9), 50.0))


def outdoor(rng: np.random.Generator) -> Setting:
    """A meadow with a path, a tree, a fence, a hut and boulders; half of the image is sky."""
    lattice = random_lattice(rng)
    grass = Noise("#4f6b2c", "#a3b35f", np.array([1.1, 1.1, 1.0]), lattice, n_octaves=4, contrast=1.5)
    leaves = Noise("#2f5a24", "#86a843", np.full(3, 0.4), lattice, contrast=1.8)
    stone = Noise("#6c665f", "#c4bcae", np.full(3, 0.4), lattice, contrast=1.7)
    brick = Bricks("#ddd0bd", "#9c5238", "#c9825c", 0.3, 0.11, 0.018, stone, up_axis=2)
    primitives = [
        sheet(150.0, 150.0, grass, [0.0, 0.0, 0.0]),
        place(Cylinder(1.7, 0.01), Noise("#a98d66", "#d8c19a", np.full(3, 0.3), lattice), [0.0, 0.0, 0.01]),
        *tree(np.array([-0.75, 0.7, 0.0]), leaves),
        *fence(np.array([1.1, 1.0, 0.0])),
        place(Box(0.45, 0.4, 0.45), brick, [0.8, -0.65, 0.45], rotate_z(20)),
        place(Box(0.55, 0.5, 0.04), Stripes("#7b3f35", "#99564a", 0.14, axis=1), [0.8, -0.65, 0.94], rotate_z(20)),
        place(Sphere(0.3), stone, [-0.75, -0.7, 0.2]),
        place(Sphere(0.18), stone, [-0.25, -1.0, 0.1]),
        place(Sphere(0.25), Stripes("#f5efe3", "#d2493f", 0.2, axis=0), [0.0, 0.1, 0.27], rotate_z(40)),
    ]
    return Setting(daylight(primitives, lattice), Orbit(np.array([0.0, 0.0, 0.75]), (3.3, 4.1), (0.7, 1.8), 60.0))


SETTINGS: dict[str, Callable[[np.random.Generator], Setting]] = {
    "room": room,
    "plain-wall": plain_wall,
    "glossy": glossy,
    "outdoor": outdoor,
    "staircase": staircase,
    "noisy-sphere": noisy_sphere,
    "facing-spheres": facing_spheres,
    "box-city": box_city,
    **PARKS,
}
"""The scenes by name."""


def _lamp_world(primitives: list[Primitive]) -> World:
    """Light a room with a lamp under the ceiling and warm ambient light scattered by the walls."""
    lamp = np.array([0.35, -0.25, ROOM_HEIGHT - 0.12])
    panel = place(
        Box(0.3, 0.3, 0.02), Material(Plain("#fffaf0"), is_light=True), lamp + np.array([0.0, 0.0, 0.06]), np.eye(3)
    )
    return World(
        primitives=(*primitives, panel),
        light_positions=light_square(lamp, 0.2),
        light_color=linear_rgb("#fff3e0") * 0.72,
        light_reach=2.4,
        ambient_above=linear_rgb("#b3a99f"),
        ambient_below=linear_rgb("#978b83"),
        sky=None,
    )


def _polish(texture: Texture, reflectance: float) -> Material:
    """A lacquered or metallic surface."""
    return Material(texture, highlight=0.8, shininess=120.0, reflectance=reflectance)
