"""Colours: spherical harmonics where their polynomials are extreme, and channels beyond [0, 1]."""

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.oracle.hard_cases.case import HardCase
from minisplat_ref.oracle.hard_cases.scenes import call, camera, cloud, gaussians, rounded
from minisplat_ref.oracle.hard_cases.subjects import Call, Parameters
from minisplat_ref.oracle.tolerances import HARMONICS
from minisplat_ref.types import Floats

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


def _along(axis: int, sign: float) -> Parameters:
    """One Gaussian straight ahead of a camera that looks along a world axis: the other two components are 0."""
    rows = [np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3], np.eye(3)[axis]]
    R = np.array(rows) * [[1.0], [sign], [sign]]  # a rotation for either sign
    rest = 0.3 * np.random.default_rng(9).normal(size=(1, 15, 3))
    return Parameters(gaussians([3 * sign * np.eye(3)[axis]], sh_rest=rest), camera(cam_from_world_R=R))


def _clamped(value: float) -> Parameters:
    return Parameters(cloud(sh_dc=np.full((30, 3), rounded((value - 0.5) / SH_C0))), camera())


def _coefficients(factor: float) -> Parameters:
    population = cloud(sh_degree=3)
    return Parameters(population._replace(sh_rest=rounded(factor * population.sh_rest)), camera())


def _channels(colors: Floats) -> Call:
    return call(
        np.random.default_rng(6).uniform((-0.2, -0.2, 2.8), (0.2, 0.2, 3.2), size=(len(colors), 3)), colors=colors
    )


COLORS = (
    *(
        HardCase(
            f"sh-3-at-{'plus' if sign > 0 else 'minus'}-{name}",
            "two components of the direction are 0: most polynomials vanish, their derivatives do not",
            "the polynomials' value and derivative; no 0 / 0 of angles",
            lambda axis=axis, sign=sign: _along(axis, sign),  # type: ignore[misc]
        )
        for axis, name in enumerate(AXES)
        for sign in (1.0, -1.0)
    ),
    HardCase("sh-3-of-many", "all sixteen polynomials", "their sum, clamped at 0", lambda: _coefficients(1.0)),
    HardCase(
        "sh-3-times-1e4",
        "coefficients of 1e4 cancel to what is seen",
        "their sum, relative to its terms",
        lambda: _coefficients(1e4),
        HARMONICS,
    ),
    HardCase(
        "color-below-0",
        "all channels are negative before the clamp",
        "black, and no gradient by the colours",
        lambda: _clamped(-0.3),
    ),
    HardCase(
        "color-just-above-0",
        "1e-3 above the clamp",
        "nearly black, and the whole gradient by the colours",
        lambda: _clamped(1e-3),
    ),
    HardCase(
        "colors-negative-and-huge",
        "given channels from -1e6 to 1e6",
        "no clamp: they are any numbers",
        lambda: _channels(rounded(np.linspace(-1e6, 1e6, 60).reshape(20, 3))),
    ),
    HardCase(
        "colors-1e30",
        "their squares are beyond float32",
        "sums of 1e30, finite",
        lambda: _channels(np.full((20, 3), rounded(1e30))),
    ),
    HardCase(
        "colors-1e-40", "subnormal in float32", "as good as black", lambda: _channels(np.full((20, 3), rounded(1e-40)))
    ),
    HardCase(
        "background-1e6",
        "a million times brighter than the Gaussians: alpha's last digit is seen",
        "what the Gaussians leave of it",
        lambda: Parameters(cloud(scales=0.3), camera(), background=(1e6, 1e6, 0.0)),
        HARMONICS,
    ),
)
