"""Errors that docs/conformance reports of other renderers: a scene, a pixel, what 3DGS shows there, and what was shown.

``expected`` is computed here a second time, by SciPy's rotations and mpmath's spherical harmonics, one pixel at a time
and with nothing of the package but the scenes.
"""

from typing import NamedTuple

import mpmath
import numpy as np
from scipy.spatial.transform import Rotation

from data_tools.conformance.probes import FOCAL, PROBES, Probe
from minisplat_ref.types import Gaussians

SH_C0 = 0.28209479177387814  # sqrt(1 / (4 pi))
ALPHA_MIN = 1 / 255
LOW_PASS = 0.3  # px^2
BY_NAME = {probe.name: probe for probe in PROBES}


class Reported(NamedTuple):
    """An error of a renderer."""

    renderer: str
    probe: Probe
    pixel: tuple[int, int]
    """Column and row, from 0."""
    expected: tuple[int, int, int]
    """Of 255."""
    found: tuple[int, int, int]
    report: str
    """In docs/conformance."""
    n_more: int = 0
    """Gaussians that nobody sees, with which the picture was made."""

    def __str__(self) -> str:
        return f"{self.report}-{self.probe.name}"


def grey(level):
    return (level, level, level)


def _single(mean, scale):
    """A round white Gaussian of opacity 0.8."""
    fields = ([mean], [[1, 0, 0, 0]], np.log([[scale] * 3]), [np.log(4)], [[0.5 / SH_C0] * 3], np.zeros((1, 0, 3)))
    return Gaussians(*(np.array(field, np.float32) for field in fields))


BABYLON = Probe("beside the axis", "a large Gaussian at the height of the axis", _single((1.9425, 0, 3.7), 1.85))
REPORTED = (
    Reported("babylon", BABYLON, (89, 31), grey(204), grey(0), "babylon"),
    Reported("gsplatjs", BY_NAME["disc"], (48, 32), grey(202), grey(0), "gsplatjs"),
    Reported("gsplatjs", BY_NAME["order"], (65, 30), (233, 176, 176), (233, 50, 50), "gsplatjs"),
    Reported("gsplatjs", BY_NAME["huge"], (48, 32), (38, 76, 115), grey(0), "gsplatjs"),
    Reported("antimatter15", BY_NAME["disc"], (48, 32), grey(202), grey(0), "antimatter15"),
    Reported("antimatter15", BY_NAME["huge"], (48, 32), (38, 76, 115), grey(0), "antimatter15"),
    Reported("mkkellogg", BY_NAME["disc"], (48, 32), grey(202), grey(0), "gaussian-splats-3d"),
    Reported("mkkellogg", BY_NAME["tiny"], (40, 30), grey(166), grey(0), "gaussian-splats-3d", 6),
    Reported("mkkellogg", BY_NAME["crowd"], (88, 42), (150, 116, 92), (18, 17, 28), "gaussian-splats-3d"),
    Reported("torch-splatting", BY_NAME["centre"], (64, 0), grey(0), grey(255), "torch-splatting"),
    Reported("torch-splatting", BY_NAME["harmonics"], (20, 26), (53, 50, 53), (255, 23, 124), "torch-splatting"),
)
"""Each of one pixel; of torch-splatting's third error there is no picture."""


def pixel_by_hand(probe, pixel, has_unit_directions=True, hidden=()):
    """Return the colour of a pixel, of 255, for a camera at the origin that looks along z; ``hidden`` are left out."""
    g = Gaussians(*(np.asarray(field, np.float64) for field in probe.gaussians))
    color, T = np.zeros(3), 1.0
    for k in np.argsort(g.means[:, 2], kind="stable"):
        if k not in hidden:
            alpha = alpha_by_hand(g.means[k], g.quats[k], np.exp(g.log_scales[k]), g.opacity_logits[k], pixel)
            color += T * alpha * color_by_hand(g.means[k], g.sh_dc[k], g.sh_rest[k], has_unit_directions)
            T *= 1 - alpha
    return 255 * np.clip(color + T * np.array(probe.background), 0, 1)


def alpha_by_hand(mean, quat, scales, logit, pixel):
    """Return opacity times exp(-d^T Sigma^-1 d / 2) at the middle of a pixel, 0 below 1/255."""
    x, y, z = mean
    offset = np.array(pixel) + 0.5 - [FOCAL * x / z + 48, FOCAL * y / z + 32]
    J = FOCAL / z * np.array([[1, 0, -x / z], [0, 1, -y / z]])
    axes = J @ Rotation.from_quat(quat, scalar_first=True).as_matrix() * scales
    alpha = np.exp(-0.5 * offset @ np.linalg.solve(axes @ axes.T + LOW_PASS * np.eye(2), offset)) / (1 + np.exp(-logit))
    return alpha if alpha >= ALPHA_MIN else 0.0


def color_by_hand(mean, sh_dc, sh_rest, has_unit_directions=True):
    """Return the colour; a direction that is as long as the distance r multiplies degree n by r^n."""
    r = 1.0 if has_unit_directions else float(np.linalg.norm(mean))
    polar, azimuth = np.arccos(mean[2] / np.linalg.norm(mean)), np.arctan2(mean[1], mean[0])
    color, row = 0.5 + SH_C0 * sh_dc, 0
    for degree in range(1, int(np.sqrt(len(sh_rest) + 1))):
        for m in range(-degree, degree + 1):
            value = mpmath.spherharm(degree, abs(m), polar, azimuth)
            real = value.real if m == 0 else mpmath.sqrt(2) * (value.real if m > 0 else value.imag)
            color, row = color + r**degree * float(real) * sh_rest[row], row + 1
    return np.maximum(color, 0)
