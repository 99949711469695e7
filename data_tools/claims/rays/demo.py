"""The scene of ``rays/claims``: a ball of 300 Gaussians over a floor of them, a mirror, a lamp.

Camera frame and world are the same: x right, y down, z forward.
"""

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.extensions.rays.lights import (
    MIRROR,
    Surroundings,
    World,
    concatenate_surfaces,
    make_surfaces,
    parallelogram,
)
from minisplat_ref.extensions.rays.model import make_tracer, whiten_model
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Camera, Floats, Gaussians, Model

CENTRE, RADIUS, N_BALL = np.array([-0.4, 0.2, 4.0]), 0.6, 300
FLOOR_Y = 1.0  # below the ball, as y points down
LAMP = np.array([-1.4, -2.0, 3.0])
MIRROR_CORNER, MIRROR_SIDES = np.array([0.82, -0.7, 5.36]), np.array([[0.96, 0.0, -0.72], [0.0, 1.6, 0.0]])
BIAS = 0.15  # of the way to the lamp: the thickness of the ball's shell


def ball(n: int = N_BALL, centre: Floats = CENTRE, radius: float = RADIUS) -> Gaussians:
    """Return discs spread over a sphere by the golden angle, coloured by position."""
    k = np.arange(n) + 0.5
    y, angle = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    normals = np.column_stack([np.sqrt(1 - y * y) * np.cos(angle), y, np.sqrt(1 - y * y) * np.sin(angle)])
    size = 1.2 * radius * np.sqrt(4 * np.pi / n) / 2
    return discs(centre + radius * normals, normals, size, 0.5 + 0.4 * normals)


def floor(n_side: int = 24) -> Gaussians:
    """Return a checkered floor of flat discs."""
    steps = (np.arange(n_side) + 0.5) / n_side
    x, z = (grid.ravel() for grid in np.meshgrid(4 * steps - 2, 4 * steps + 2.2))
    means = np.column_stack([x, np.full_like(x, FLOOR_Y), z])
    is_light = (np.floor(2 * x) + np.floor(2 * z)) % 2 == 0
    colors = np.where(is_light[:, None], [0.85, 0.82, 0.75], [0.45, 0.5, 0.6])
    return discs(means, np.tile([0.0, 1.0, 0.0], (len(x), 1)), 0.6 * 4 / n_side, colors)


def discs(means: Floats, normals: Floats, size: float, colors: Floats) -> Gaussians:
    """Return nearly opaque Gaussians, a fiftieth as thick as wide, whose thin axes are unit normals."""
    half = normals + np.array([0.0, 0.0, 1.0])  # the half-way vector: rotation by pi about it takes z to the normal
    is_opposite = np.linalg.norm(half, axis=1) < 1e-9
    half[is_opposite] = [1.0, 0.0, 0.0]
    n = len(means)
    return Gaussians(
        means=means,
        quats=np.column_stack([np.zeros(n), half]),
        log_scales=np.log(np.tile([size, size, size / 50], (n, 1))),
        opacity_logits=np.full(n, 4.0),
        sh_dc=(colors - 0.5) / SH_C0,
        sh_rest=np.zeros((n, 0, 3)),
    )


def concatenate_populations(*parts: Gaussians) -> Gaussians:
    """Return several populations concatenated to one."""
    return Gaussians(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def camera_of(width: int = 240, height: int = 180) -> Camera:
    """Return a camera at the origin that looks along z."""
    return Camera(np.eye(3), np.zeros(3), 1.1 * width, 1.1 * width, width / 2, height / 2, width, height)


def world_of(gaussians: Gaussians, surroundings: Surroundings, background: Floats) -> World:
    """Return Gaussians and their surroundings as a world for the kernels."""
    tracer = make_tracer(whiten_model(Model(gaussians)), GSPLAT_MAIN, CPU)
    return World(gaussians, tracer, surroundings, background, GSPLAT_MAIN)


def demo_world() -> World:
    """Return the whole scene."""
    mirror = make_surfaces(parallelogram(MIRROR_CORNER, MIRROR_SIDES), MIRROR, np.array([0.9, 0.9, 0.95]))
    around = Surroundings(LAMP[None], 0.35, BIAS, concatenate_surfaces([mirror]))
    return world_of(concatenate_populations(ball(), floor()), around, np.array([0.1, 0.12, 0.16]))
