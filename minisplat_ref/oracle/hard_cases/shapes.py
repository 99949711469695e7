"""Needles, pancakes, points and worlds: shapes whose covariance is nearly singular, huge, or zero."""

import numpy as np

from minisplat_ref.constants import INRIA
from minisplat_ref.oracle.hard_cases.scenes import (
    ANTIALIASED,
    call,
    camera,
    cloud,
    gaussians,
    needle,
    rotation_quat,
    round_to_float32,
)
from minisplat_ref.oracle.hard_cases.subjects import HardCase, Parameters, Surface
from minisplat_ref.oracle.tolerances import LONG, ORDINARY

RIDGE = "a ridge without holes; the gradient that the float64 formula has"
DIAGONAL, TILTED = rotation_quat(np.pi / 4), rotation_quat(0.3)


def _scale_quats(factor: float) -> Parameters:
    population = cloud()
    return Parameters(population._replace(quats=round_to_float32(population.quats * factor)), camera())


SHAPES = (
    HardCase(
        "needle-1e3-oblique",
        "a c and b^2 of its conic agree to many digits: float32 sums of a dx^2, c dy^2, 2 b dx dy are all rounding",
        RIDGE,
        lambda: needle((1, 1e-3, 1e-3), DIAGONAL),
        LONG,
    ),
    HardCase(
        "needle-1e4-oblique",
        "the same, ten times longer than the image",
        RIDGE,
        lambda: needle((30, 3e-3, 3e-3), TILTED),
        LONG,
    ),
    HardCase(
        "needle-1e6-oblique",
        "axis ratio 1e6, 30,000 pixels long",
        RIDGE,
        lambda: needle((1e3, 1e-3, 1e-3), DIAGONAL),
        LONG,
    ),
    HardCase(
        "needle-1e6-tilted",
        "axis ratio 1e6 at 17 degrees: the products that cancel differ",
        RIDGE,
        lambda: needle((1e3, 1e-3, 1e-3), TILTED),
        LONG,
    ),
    HardCase(
        "needle-1e6-along-x",
        "on the pixels' rows: b is 0 and the extents differ by 1e5",
        RIDGE,
        lambda: needle((1e3, 1e-3, 1e-3), rotation_quat(0.0)),
        LONG,
    ),
    HardCase(
        "needle-1e6-nearly-along-y",
        "slope and pivot of the conic are at opposite ends of their ranges",
        RIDGE,
        lambda: needle((1e3, 1e-3, 1e-3), rotation_quat(np.pi / 2 - 1e-4)),
        LONG,
    ),
    HardCase(
        "needle-end-on",
        "points at the camera: its length vanishes in the difference V_0 - x' V_2",
        "a dot of the low-pass's size",
        lambda: needle((1e-3, 1e-3, 1), rotation_quat(0.0)),
    ),
    HardCase(
        "needle-through-the-camera",
        "long along the view, 1e3 behind and before the camera",
        "its linear footprint at the mean; nothing overflows",
        lambda: needle((1e-3, 1e-3, 1e3), rotation_quat(0.05, (0, 1, 0))),
        LONG,
    ),
    HardCase(
        "needle-antialiased",
        "the compensation divides two nearly equal, nearly zero determinants",
        "the floor of the compensation, or its square root, without a negative radicand",
        lambda: needle((1, 1e-3, 1e-3), DIAGONAL, conventions=ANTIALIASED),
        LONG,
    ),
    HardCase(
        "needle-inria",
        "its box is a square of 3 sigma",
        RIDGE,
        lambda: needle((30, 3e-3, 3e-3), TILTED, conventions=INRIA),
        LONG,
    ),
    HardCase(
        "hundred-needles",
        "needles at all angles over each other: every pixel sums their errors",
        RIDGE,
        lambda: Parameters(cloud(100, scales=(2, 2e-3, 2e-3)), camera(48, 40, fx=60.0, fy=60.0)),
        LONG,
    ),
    HardCase(
        "pancake-1e6-face-on",
        "thickness 1e-6 of the width, along the view",
        "as a ball of its width",
        lambda: needle((0.3, 0.3, 3e-7), rotation_quat(0.0)),
    ),
    HardCase(
        "pancake-1e6-edge-on",
        "two long axes fall onto one line",
        RIDGE,
        lambda: needle((1, 1, 1e-6), rotation_quat(np.pi / 2, (1, 0, 0))),
        LONG,
    ),
    HardCase(
        "pancake-1e6-oblique-edge",
        "edge-on and turned in the image: u x w is a difference of products 1e6 times larger",
        RIDGE,
        lambda: needle((1, 1, 1e-6), rotation_quat(np.pi / 2, (1, 1, 0))),
        LONG,
    ),
    HardCase(
        "pancake-1e6-huge",
        "a plane through the view, 1e3 wide",
        "a half-space's band; nothing overflows",
        lambda: needle((1e3, 1e3, 1e-3), rotation_quat(1.5, (1, 0.2, 0))),
        LONG,
    ),
    HardCase(
        "scale-1e-8",
        "its covariance 1e-16 vanishes beside the low-pass",
        "the low-pass's dot",
        lambda: Parameters(cloud(scales=1e-8), camera()),
    ),
    HardCase(
        "scale-1e-20",
        "its square is below float32's range",
        "the low-pass's dot",
        lambda: Parameters(cloud(scales=1e-20), camera()),
    ),
    HardCase(
        "scale-underflows",
        "exp(-100) is subnormal in float32, exp(-110) is 0",
        "the low-pass's dot; no division by 0",
        lambda: Parameters(cloud(log_scales=round_to_float32(np.linspace(-110, -95, 90).reshape(30, 3))), camera()),
    ),
    HardCase(
        "scale-1e4",
        "one Gaussian covers everything: footprint 1e5 pixels, covariance 1e10, determinant 1e20",
        "a constant image",
        lambda: Parameters(gaussians([[0, 0, 3]], 1e4), camera()),
        ORDINARY,
    ),
    HardCase(
        "scale-1e4-of-many",
        "thirty that cover everything",
        "a constant image",
        lambda: Parameters(cloud(scales=1e4), camera()),
    ),
    HardCase(
        "scale-1e12",
        "its determinant, 1e56, is beyond float32",
        "a constant image, not a culled Gaussian",
        lambda: Parameters(gaussians([[0, 0, 3]], 1e12), camera()),
    ),
    HardCase(
        "scale-overflows",
        "exp(95) is infinite in float32",
        "a constant image: the largest number takes its place",
        lambda: Parameters(gaussians([[0, 0, 3]])._replace(log_scales=np.full((1, 3), 95.0)), camera()),
    ),
    HardCase(
        "scales-1e-8-to-1e4-in-one",
        "axis ratio 1e12",
        "a half-space's band; nothing overflows",
        lambda: Parameters(gaussians([[0.1, 0.1, 3]], [[1e-8, 1, 1e4]], quats=rotation_quat(0.8, (1, 2, 3))), camera()),
        LONG,
    ),
    HardCase(
        "scales-1e-8-to-1e4-of-many",
        "dots and walls in one sum: gradients span 12 orders",
        "each its own footprint",
        lambda: Parameters(cloud(scales=np.logspace(-8, 4, 30)[:, None]), camera()),
    ),
    HardCase(
        "ball",
        "turning it changes nothing: its rotation has no gradient, only rounding",
        "a disc; the quaternion's gradient is 0 beside the others",
        lambda: Parameters(gaussians([[0.1, -0.1, 3]], 0.3), camera()),
    ),
    HardCase(
        "disc-inria",
        "equal eigenvalues: the root of mid^2 - det cancels",
        "radius by the floored root",
        lambda: Parameters(gaussians([[0, 0, 3]], 20.0, quats=rotation_quat(0.0)), camera(64, 48), conventions=INRIA),
    ),
    HardCase(
        "singular-without-low-pass",
        "a plane seen edge-on has no area and eps2d is 0: the 2D covariance has no inverse",
        "culled: the background",
        lambda: call([[0, 0, 3.0]], [[0.2, 0, 0.2]], eps2d=0.0),
        is_background=True,
    ),
    HardCase(
        "point-without-low-pass",
        "all scales and eps2d are 0",
        "culled: the background",
        lambda: call([[0, 0, 3.0]], 0.0, eps2d=0.0),
        is_background=True,
    ),
    HardCase(
        "tiny-without-low-pass",
        "a footprint of 1e-29 pixels: its conic, 1e58, is beyond float32",
        "one pixel, whose centre it is",
        lambda: call([[0, 0, 3.0]], 1e-30, eps2d=0.0),
    ),
    HardCase("zero-scales", "all scales are exactly 0", "the low-pass's dot", lambda: call([[0, 0, 3.0]], 0.0)),
    HardCase(
        "huge-quaternions",
        "|q| = 1e30: its square is beyond float32",
        "length does not matter",
        lambda: _scale_quats(1e30),
    ),
    HardCase(
        "tiny-quaternions",
        "|q| = 1e-30: its square is 0 in float32",
        "length does not matter",
        lambda: _scale_quats(1e-30),
    ),
    HardCase(
        "subnormal-quaternions",
        "|q| = 1e-38: half of the entries are subnormal, 1 / |q| nearly overflows",
        "length does not matter; the gradient, 1e38 times larger, is finite",
        lambda: _scale_quats(1e-36),
    ),
    HardCase(
        "half-turns",
        "quaternions with w = 0, and -q beside q",
        "q and -q are one rotation",
        lambda: Parameters(
            cloud(quats=np.repeat(np.eye(4), 8, axis=0)[:30] * np.tile([1.0, -1.0], 15)[:, None]), camera()
        ),
    ),
    HardCase(
        "surface-of-needles",
        "densities along a ray that differ by 1e12 between the axes",
        "depth of the densest point, in front of the camera",
        lambda: Surface(cloud(scales=(1, 1e-3, 1e-6)), camera()),
        LONG,
    ),
    HardCase(
        "surface-of-points",
        "1 / s^2 = 1e40 is beyond float32",
        "the depth at which the ray passes nearest",
        lambda: Surface(cloud(scales=1e-20), camera()),
    ),
)
