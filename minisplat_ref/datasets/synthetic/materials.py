"""Synthetic scenes, stage 3: materials. Procedural solid textures and the parameters of the shading.

A texture maps points [n, 3] in the frame of a shape to linear RGB [n, 3]. It is a pattern in space, so that every shape
can have every texture without texture coordinates. Colours are given as sRGB hex codes and stored linear, because light
adds linearly.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minisplat_ref.io.srgb import decode_srgb
from minisplat_ref.types import Floats, Ints

Texture = Callable[[Floats], Floats]
"""Points [n, 3] in the shape's frame -> linear RGB [n, 3]."""


class Material(NamedTuple):
    """Appearance of a surface."""

    texture: Texture
    """Diffuse albedo."""
    highlight: float = 0.0
    """Strength of the Blinn-Phong highlight."""
    shininess: float = 60.0
    """Exponent of the highlight: the larger, the smaller the spot."""
    reflectance: float = 0.0
    """Mirror reflectance seen from straight above (Schlick's F0); 0 is a matte surface without reflections."""
    is_light: bool = False
    """The texture is emitted as it is, unlit."""


def linear_rgb(hex_code: str) -> Floats:
    """[3] linear RGB of an sRGB colour such as ``"#e8dcc8"``."""
    return decode_srgb(np.array([int(hex_code[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0)


@dataclass(frozen=True)
class Plain:
    """One colour."""

    color: str

    def __call__(self, points: Floats) -> Floats:
        """The colour at every point."""
        return np.broadcast_to(linear_rgb(self.color), points.shape)


@dataclass(frozen=True)
class Checker:
    """Cubes of alternating colours; 0 is the centre of a cube, so that a sheet at z = 0 does not flicker."""

    even: str
    odd: str
    size: float

    def __call__(self, points: Floats) -> Floats:
        """Parity of the sum of the cell's indices."""
        parity = np.floor(points / self.size + 0.5).sum(axis=1) % 2  # [n]
        return _blend(self.even, self.odd, parity)


@dataclass(frozen=True)
class Stripes:
    """Alternating slabs across one axis; the odd ones take ``share`` of the period."""

    even: str
    odd: str
    period: float
    axis: int
    share: float = 0.5

    def __call__(self, points: Floats) -> Floats:
        """Position within the period."""
        phase = points[:, self.axis] / self.period % 1.0  # [n]
        return _blend(self.even, self.odd, (phase < self.share).astype(float))


@dataclass(frozen=True)
class Bricks:
    """Courses of bricks, each shifted by half a brick; long bricks with thin joints are planks."""

    joint: str
    dark: str
    light: str
    length: float
    height: float
    joint_width: float
    noise: "Noise"
    up_axis: int = 1
    """Axis that counts the courses; a brick's length runs along the sum of the others, hence around a box."""

    def __call__(self, points: Floats) -> Floats:
        """A random shade for every brick, streaks of noise on it, the joint's colour along its edges."""
        up = points[:, self.up_axis]  # [n]
        course = np.floor(up / self.height)
        along = (points.sum(axis=1) - up) / self.length + 0.5 * (course % 2)
        brick = np.floor(along)
        from_end = (along - brick) * self.length
        from_bed = up - course * self.height
        is_joint = (from_end < self.joint_width) | (from_bed < self.joint_width)
        shade = self.noise.cell_colors(course.astype(int), brick.astype(int))
        shade = 0.65 * shade + 0.35 * self.noise.values(points)
        return np.where(is_joint[:, None], linear_rgb(self.joint), _blend(self.dark, self.light, shade))


@dataclass(frozen=True, eq=False)
class Noise:
    """Clouds: smooth random values on lattices of halving cell sizes that mix two colours."""

    low: str
    high: str
    size: Floats
    """[3] largest cell along each axis: unequal sizes make streaks."""
    lattice: Floats
    """[L, L, L] random values in [0, 1], repeated periodically."""
    n_octaves: int = 3
    contrast: float = 1.0

    def __call__(self, points: Floats) -> Floats:
        """Blend by the noise value."""
        return _blend(self.low, self.high, self.values(points))

    def values(self, points: Floats) -> Floats:
        """[n] in [0, 1]: octaves of halving amplitude, contrast stretched around one half."""
        total, weight = np.zeros(len(points)), 0.0
        for octave in range(self.n_octaves):
            total += 0.5**octave * self._smooth(points / self.size * 2.0**octave)
            weight += 0.5**octave
        return np.clip(0.5 + self.contrast * (total / weight - 0.5), 0.0, 1.0)

    def cell_colors(self, i: Ints, j: Ints) -> Floats:
        """[n] one random number in [0, 1] for each pair of integers."""
        return self.lattice[i % len(self.lattice), j % len(self.lattice), 0]

    def _smooth(self, positions: Floats) -> Floats:
        """[n] trilinear interpolation with ``3 f^2 - 2 f^3`` weights, which hides the lattice."""
        cells = np.floor(positions)  # [n, 3]
        fraction = positions - cells
        x, y, z = (fraction**2 * (3.0 - 2.0 * fraction)).T  # [n] each
        i, j, k = (cells.astype(int) % len(self.lattice)).T
        i_next, j_next, k_next = ((cells.astype(int) + 1) % len(self.lattice)).T
        edges = []
        for j_end, k_end in ((j, k), (j_next, k), (j, k_next), (j_next, k_next)):
            start, end = self.lattice[i, j_end, k_end], self.lattice[i_next, j_end, k_end]
            edges.append(start + x * (end - start))
        front = edges[0] + y * (edges[1] - edges[0])
        back = edges[2] + y * (edges[3] - edges[2])
        return front + z * (back - front)


def random_lattice(rng: np.random.Generator, period: int = 32) -> Floats:
    """[period, period, period] uniform numbers for :class:`Noise`."""
    return rng.random((period, period, period))


def _blend(first: str, second: str, share: Floats) -> Floats:
    """[n, 3] linear mix: 0 is the first colour, 1 the second."""
    return linear_rgb(first) + share[:, None] * (linear_rgb(second) - linear_rgb(first))
