"""Synthetic scenes, stage 7b: four small worlds whose surface is the subject. Metres, z up, the floor at z = 0.

``staircase``: planes at right angles with steps in depth. ``noisy-sphere``: one ball whose sparse points err by a
twentieth of its radius. ``facing-spheres``: two balls with a gap, in which each hides the other. ``box-city``: blocks
with narrow streets, of which few views see the ground.
"""

from typing import NamedTuple, Protocol

import numpy as np

from minisplat_ref.datasets.synthetic.cameras import Orbit
from minisplat_ref.datasets.synthetic.furniture import place, rotate_z
from minisplat_ref.datasets.synthetic.geometry import Primitive
from minisplat_ref.datasets.synthetic.lights import light_square, studio
from minisplat_ref.datasets.synthetic.materials import (
    Bricks,
    Checker,
    Noise,
    Stripes,
    Texture,
    linear_rgb,
    random_lattice,
)
from minisplat_ref.datasets.synthetic.shapes import Box, Cylinder, Sphere
from minisplat_ref.datasets.synthetic.tracer import World
from minisplat_ref.types import Camera

N_STEPS, RISE, TREAD = 5, 0.16, 0.3
RADIUS, RELATIVE_NOISE = 0.5, 0.05
GAP = 0.16  # between the two spheres
N_BLOCKS, BLOCK, STREET = 4, 0.3, 0.14


class Path(Protocol):
    """The path of the photographer."""

    def cameras(self, n_cameras: int, width: int, height: int, rng: np.random.Generator) -> list[Camera]:
        """Return cameras in walking order, float64."""


class Setting(NamedTuple):
    """A world and the camera path around it."""

    world: World
    """The surfaces and the light."""
    path: Path
    """The camera path."""
    point_noise: float = 0.0
    """Standard deviation of the error of each sparse point's coordinates, metres, by default."""


def staircase(rng: np.random.Generator) -> Setting:
    """Five steps of stone: boxes from the floor up, each a rise higher than the one before."""
    lattice = random_lattice(rng)
    stone = Noise("#5f5a55", "#d9cfc0", np.full(3, 0.12), lattice, contrast=2.2)
    steps = []
    for k in range(N_STEPS):
        half = 0.5 * RISE * (k + 1)
        look: Texture = stone if k % 2 == 0 else Checker("#e3d3b5", "#7d5b3f", 0.117)
        steps.append(place(Box(0.5 * TREAD, 0.6, half), look, [TREAD * (k - 0.5 * (N_STEPS - 1)), 0.0, half]))
    return Setting(_table_world(steps), Orbit(np.array([0.0, 0.0, 0.35]), (1.9, 2.3), (0.8, 1.8), 50.0))


def noisy_sphere(rng: np.random.Generator) -> Setting:
    """One marbled ball; the error of its sparse points is 5 % of its radius."""
    marble = Noise("#23405c", "#e9e4d6", np.full(3, 0.22), random_lattice(rng), contrast=2.4)
    ball = place(Sphere(RADIUS), marble, [0.0, 0.0, RADIUS])
    orbit = Orbit(np.array([0.0, 0.0, 0.45]), (1.9, 2.2), (0.5, 1.7), 42.0)
    return Setting(_table_world([ball]), orbit, RELATIVE_NOISE * RADIUS)


def facing_spheres(rng: np.random.Generator) -> Setting:
    """Two balls, nearly touching: the part of one that the other hides is seen only from the sides."""
    lattice = random_lattice(rng)
    marble = Noise("#7a2848", "#f2c48d", np.full(3, 0.2), lattice, contrast=2.2)
    x = 0.4 + 0.5 * GAP
    balls = [
        place(Sphere(0.4), marble, [-x, 0.0, 0.4], rotate_z(25)),
        place(Sphere(0.4), Checker("#efe6d2", "#2c6e8f", 0.11), [x, 0.0, 0.4], rotate_z(25)),
    ]
    return Setting(_table_world(balls), Orbit(np.array([0.0, 0.0, 0.38]), (2.0, 2.4), (0.5, 1.7), 46.0))


def box_city(rng: np.random.Generator) -> Setting:
    """A square of 4 x 4 blocks of random heights, with narrow streets between them."""
    lattice = random_lattice(rng)
    grain = Noise("#000000", "#ffffff", np.full(3, 0.1), lattice, n_octaves=2)
    looks: tuple[Texture, ...] = (
        Bricks("#cfc6b8", "#8b4a35", "#c98a66", 0.12, 0.05, 0.008, grain, up_axis=2),
        Stripes("#46637f", "#d7dee2", 0.09, axis=2),
        Checker("#e6dcc4", "#6f7f5c", 0.083),
    )
    heights = rng.uniform(0.25, 0.9, (N_BLOCKS, N_BLOCKS))
    blocks = []
    for (i, k), height in np.ndenumerate(heights):
        x, y = ((BLOCK + STREET) * (index - 0.5 * (N_BLOCKS - 1)) for index in (i, k))
        look = looks[(i + 2 * k) % len(looks)]
        blocks.append(place(Box(0.5 * BLOCK, 0.5 * BLOCK, 0.5 * height), look, [x, y, 0.5 * height]))
    return Setting(_table_world(blocks), Orbit(np.array([0.0, 0.0, 0.3]), (1.9, 2.3), (1.2, 2.2), 56.0))


def _table_world(primitives: list[Primitive]) -> World:
    """Put things on a round table in a studio."""
    table = place(Cylinder(1.5, 0.05), Checker("#e9dfcb", "#8c6d52", 0.21), [0.0, 0.0, -0.05])
    return World(
        primitives=(table, *primitives),
        light_positions=light_square(np.array([1.6, -1.4, 3.6]), 0.25),
        light_color=linear_rgb("#fff2dd") * 0.8,
        light_reach=3.8,
        ambient_above=linear_rgb("#a9b4c4"),
        ambient_below=linear_rgb("#6a5a4d"),
        sky=studio,
    )
