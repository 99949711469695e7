"""Synthetic scenes, stage 7c: a park, larger than one photograph can show. Metres, z up, the ground at z = 0.

``park-1``, ``park-4`` and ``park-16`` are 1, 4 and 16 squares of 4 m. In each square stand hedges, boulders, beds and
balls, all lower than a person's eyes; the camera walks along lanes a metre apart and looks around and down.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from minisplat_ref.datasets.synthetic.cameras import EVEN_STEPS, look_at
from minisplat_ref.datasets.synthetic.furniture import place, rotate_z, sheet
from minisplat_ref.datasets.synthetic.geometry import Primitive
from minisplat_ref.datasets.synthetic.lights import daylight
from minisplat_ref.datasets.synthetic.materials import Bricks, Checker, Noise, Stripes, Texture, random_lattice
from minisplat_ref.datasets.synthetic.shapes import Box, Cylinder, Sphere
from minisplat_ref.datasets.synthetic.truths import Setting
from minisplat_ref.types import Camera, Floats

SIDE = 4.0  # metres, of a square
LANE = 1.0  # metres between lanes
EYES = (1.5, 2.1)  # metres, height of the camera
AHEAD = 2.2  # metres on the ground, to where the camera looks
N_THINGS = 7  # in a square


class Walk(NamedTuple):
    """Lanes over a square, there and back."""

    side: float
    """Of the square, around the origin, metres."""
    fov_degrees: float
    """Horizontal field of view."""

    def cameras(self, n_cameras: int, width: int, height: int, rng: np.random.Generator) -> list[Camera]:
        """Return cameras at equal steps along the lanes; they turn by the golden section of a circle at each.

        Parameters
        ----------
        n_cameras : int
        width, height : int
            Image size, pixels.
        rng : numpy.random.Generator
            Draws in which direction the first looks, and how high it is.
        """
        n_lanes = max(1, round(self.side / LANE))
        along = (np.arange(n_cameras) + 0.5) / n_cameras * n_lanes  # lanes walked so far
        lane = np.minimum(along.astype(int), n_lanes - 1)
        share = np.where(lane % 2 == 0, along - lane, 1.0 - (along - lane))
        x, y = self.side * (share - 0.5), self.side * ((lane + 0.5) / n_lanes - 0.5)  # [n] each
        turns = 2.0 * np.pi * ((np.arange(n_cameras) * EVEN_STEPS[0] + rng.random()) % 1.0)
        z = EYES[0] + (EYES[1] - EYES[0]) * ((np.arange(n_cameras) * EVEN_STEPS[1] + rng.random()) % 1.0)
        focal = 0.5 * width / np.tan(0.5 * np.radians(self.fov_degrees))
        positions = np.stack([x, y, z], axis=1)  # [n, 3]
        targets = np.stack([x + AHEAD * np.cos(turns), y + AHEAD * np.sin(turns), np.full(n_cameras, 0.4)], axis=1)
        return [look_at(p, t, focal, width, height) for p, t in zip(positions, targets, strict=True)]


def park(n_squares: int, rng: np.random.Generator) -> Setting:
    """Lay out a park of n x n squares; ``n_squares`` is n^2."""
    n = round(np.sqrt(n_squares))
    lattice = random_lattice(rng)
    looks = _looks(lattice)
    grass = Noise("#4f6b2c", "#b3bf6a", np.array([0.7, 0.7, 1.0]), lattice, n_octaves=4, contrast=1.8)
    primitives = [sheet(150.0, 150.0, grass, [0.0, 0.0, 0.0])]
    for row, column in np.ndindex(n, n):
        corner = SIDE * (np.array([row, column]) - 0.5 * n)  # [2]
        primitives += _square(corner, looks, rng)
    return Setting(daylight(primitives, lattice), Walk(n * SIDE, 75.0))


def _looks(lattice: Floats) -> list[Texture]:
    stone = Noise("#6c665f", "#d4ccbe", np.full(3, 0.25), lattice, contrast=1.9)
    return [
        Noise("#244a1e", "#86a843", np.full(3, 0.2), lattice, contrast=1.9),
        stone,
        Bricks("#ddd0bd", "#9c5238", "#c9825c", 0.3, 0.11, 0.018, stone, up_axis=2),
        Stripes("#f5efe3", "#d2493f", 0.16, axis=0),
        Checker("#efe4cf", "#35608c", 0.14),
        Noise("#7a2848", "#f2c48d", np.full(3, 0.18), lattice, contrast=2.0),
    ]


def _square(corner: Floats, looks: list[Texture], rng: np.random.Generator) -> list[Primitive]:
    """Put things on a square, each into a separate cell."""
    cells = rng.permutation(9)[:N_THINGS]
    things = []
    for cell in cells.tolist():
        x, y = corner + SIDE * (np.array(divmod(cell, 3)) + 0.5 + rng.uniform(-0.18, 0.18, 2)) / 3
        look = looks[rng.integers(len(looks))]
        size, kind = rng.uniform(0.2, 0.45), rng.integers(3)
        if kind == 0:
            things.append(place(Sphere(size), look, [x, y, 0.7 * size], rotate_z(rng.uniform(0, 180))))
        elif kind == 1:
            height = rng.uniform(0.15, 0.5)
            turn = rotate_z(rng.uniform(0, 90))
            things.append(place(Box(size, 0.6 * size, height), look, [x, y, height], turn))
        else:
            height = rng.uniform(0.1, 0.4)
            things.append(place(Cylinder(size, height), look, [x, y, height], rotate_z(rng.uniform(0, 90))))
    return things


PARKS = {f"park-{n}": partial(park, n) for n in (1, 4, 16)}
"""The parks by name."""
