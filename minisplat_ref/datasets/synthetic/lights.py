"""Synthetic scenes, stage 6b: light and backdrop that several worlds share, of a studio and of a clear day."""

from collections.abc import Sequence

import numpy as np

from minisplat_ref.datasets.synthetic.geometry import Primitive
from minisplat_ref.datasets.synthetic.materials import Noise, linear_rgb
from minisplat_ref.datasets.synthetic.tracer import World
from minisplat_ref.types import Floats


def studio(directions: Floats) -> Floats:
    """A photographer's backdrop: dark floor to light ceiling, with two bright soft boxes to be mirrored."""
    up = directions[:, 2:]  # [n, 1]
    colors = linear_rgb("#3d4650") + (0.5 + 0.5 * up) * (linear_rgb("#c9d3dd") - linear_rgb("#3d4650"))
    for towards, width in (((0.45, -0.3, 0.85), 0.16), ((-0.7, 0.6, 0.35), 0.1)):
        unit = np.array(towards) / np.linalg.norm(towards)
        glow = 1.0 / (1.0 + np.exp(-(directions @ unit - (1.0 - width**2)) / 0.004))
        colors = colors + 0.8 * glow[:, None] * linear_rgb("#fff6e6")
    return colors


def light_square(centre: Floats, half: float) -> Floats:
    """[4, 3] samples of a square light that faces down."""
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])
    return centre + half * corners


def daylight(primitives: Sequence[Primitive], lattice: Floats) -> World:
    """Put things under the sun and a sky with clouds of lattice noise."""
    sun = np.array([60.0, -35.0, 70.0])
    return World(
        primitives=tuple(primitives),
        light_positions=light_square(sun, 1.5),
        light_color=linear_rgb("#fff0d2") * 1.0,
        light_reach=float(np.linalg.norm(sun)),
        ambient_above=linear_rgb("#9fb6d8"),
        ambient_below=linear_rgb("#5a5240"),
        sky=_Sky(Noise("#000000", "#ffffff", np.array([0.5, 0.5, 0.16]), lattice, n_octaves=4, contrast=2.0)),
    )


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
