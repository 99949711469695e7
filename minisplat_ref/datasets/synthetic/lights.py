"""Synthetic scenes, stage 6b: the light and the backdrop of a studio, which several worlds share."""

import numpy as np

from minisplat_ref.datasets.synthetic.materials import linear_rgb
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
