"""A small scene for testing gradients, with the decisive positions set by hand.

It has a clamped hit, a pixel that stops early, a mean outside the clamp of the Jacobian on either axis, a colour below
zero, a principal point off centre and a rotated camera: every branch of every gradient is taken. The Jacobian's limits
differ along x and y, and one mean lies between them, which detects code that clamps y by the limit of x.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.reference.pinhole import pinhole_rays, pose, slope_limits, with_principal_point
from minisplat_ref.types import Camera, Floats, Gaussians, Primitives

POSE = ("cam_from_world_R", "cam_from_world_t")


class Setting(NamedTuple):
    """The scene on which a stage is tested."""

    gaussians: Gaussians
    camera: Camera
    background: Floats
    conventions: Conventions

    @property
    def primitives(self) -> Primitives:
        """Return the activated Gaussians."""
        g = self.gaussians
        return Primitives(g.means, g.quats, np.exp(g.log_scales), 1 / (1 + np.exp(-g.opacity_logits)))

    @property
    def pose(self) -> dict[str, Floats]:
        """Return the pose of the camera by name."""
        return dict(zip(POSE, pose(self.camera, np.dtype(float)), strict=True))


def make_setting(
    rng: np.random.Generator, n: int, width: int, height: int, conventions: Conventions, sh_degree: int
) -> Setting:
    """Render a scene.

    Parameters
    ----------
    rng : Generator
        For all but the Gaussians that are placed on purpose: row 0 is opaque and on a pixel's centre, rows 1 and 2 lie
        behind it, row 3 is beyond the Jacobian's clamp along x, row 4 along y, where x would not be clamped yet.
    n : int
        Gaussians, at least 5.
    width, height : int
        Image, pixels.
    conventions : Conventions
        Where the gradient deviates from the derivative, as for INRIA's clamp, no alpha is clamped.
    sh_degree : int
        Stored and active.

    Returns
    -------
    Setting
        Float64.
    """
    fx, fy = 1.2 * width, 1.1 * width
    R = rotation_matrices(np.array([[1.0, 0.12, -0.07, 0.05]]))[0]
    camera = Camera(R, np.array([0.1, -0.2, 0.15]), fx, fy, 0.53 * width, 0.46 * height, width, height)
    seen = with_principal_point(camera, conventions)
    half_view = np.array([width / fx, height / fy]) / 2

    z = 3 + rng.uniform(-0.8, 0.8, size=n)
    slopes = rng.uniform(-1, 1, size=(n, 2)) * half_view
    center = pinhole_rays(width // 2 + 0.54, height // 2 + 0.47, seen)[:2]
    slopes[:3] = center + rng.uniform(-0.02, 0.02, size=(3, 2)) * [[0], [1], [1]]
    z[:3] = 2.0, 2.3, 2.6
    below, beyond = slope_limits(seen, conventions, np.dtype(float))
    slopes[3] = beyond[0] + 0.03, 0.1 * beyond[1]
    slopes[4] = 0.75 * below[0], beyond.mean()
    in_camera = np.column_stack([slopes * z[:, None], z])

    log_scales = np.log(0.15 if n > 20 else 0.3) + rng.uniform(-0.5, 0.5, size=(n, 3))
    log_scales[:5] += np.log([1.5, 1.5, 1.5, 2.5, 2.5])[:, None]
    logits = rng.normal(size=n)
    has_derivative = conventions.clamp_stops_mean_gradient and conventions.clamp_stops_shape_gradient
    logits[:3] = 6.0 if has_derivative else 4.0, 4.0, 4.0  # opacities 0.998 or 0.982, then 0.982
    sh_dc = rng.normal(size=(n, 3))
    sh_dc[1, 1] = -2.5  # a colour of about 0.5 - 2.5 SH_C0 < 0
    sh_rest = 0.2 * rng.normal(size=(n, (sh_degree + 1) ** 2 - 1, 3))
    sh_rest[1, :, 1] *= 0.1
    gaussians = Gaussians(
        means=(in_camera - camera.cam_from_world_t) @ R,
        quats=rng.normal(size=(n, 4)),
        log_scales=log_scales,
        opacity_logits=logits,
        sh_dc=sh_dc,
        sh_rest=sh_rest,
    )
    return Setting(gaussians, camera, rng.uniform(0.2, 1, size=3), conventions)
