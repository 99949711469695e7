"""From a model and a camera to flat Gaussians before a hologram.

A camera sees tens of degrees, a hologram with pixels of 8 um only two. So the scene is placed as in a display whose
eyepiece makes the angle: the camera's view becomes a box of the size of the hologram, without perspective, whose depth
is linear in 1 / Z. That map takes planes to planes. With rho metres for a pixel of the camera and Z the camera's depth

    x = rho (fx X / Z + cx - w / 2),   y likewise,   z = D (1 / Z - (a + b) / 2) / (a - b)

so that the nearest surface, 1 / Z = a, is at D / 2 and the farthest, b, at -D / 2. As in 3DGS a Gaussian is mapped by
the Jacobian J at its centre. Its spans ``S = [s_1 e_1, s_2 e_2]``, the two larger axes, become ``J S``. Its image
``A = (J S)_xy (J S)_xy^T`` gets the low-pass of the renderer, eps pixels^2 of the camera. Its plane keeps the slopes
``z = g . (x, y)`` of the mean depth at each place, which without the low-pass are those of its plane:

    B = A + eps rho^2 I,   g = B^-1 (J S)_xy (J S)_z^T

Both together give the new axes: the singular vectors of ``[B^1/2; g^T B^1/2]``, 3 x 2.

A Gaussian steeper than the light's own angle would shine as strongly along its mirrored direction. Slopes are therefore
held below half of that, ``|g| <= 1 / (2 tan(theta))`` with ``sin(theta) = lambda / (2 p)``.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.wave.blending import Scene, front_to_back
from minisplat_ref.extensions.wave.reference import Flats
from minisplat_ref.mechanisms.meshes.fans import flatten
from minisplat_ref.reference.spherical_harmonics import sh_colors
from minisplat_ref.rendering import activate
from minisplat_ref.types import Bools, Camera, Floats, Gaussians

THICK = 0.5  # ratio of the least to the middle scale above which a Gaussian is no disc
DEPTH_SHARE = 0.01  # of the scene in view, by opacity and area, that is nearer or farther than the box, each


class Box(NamedTuple):
    """The placement of a camera's view in a hologram."""

    camera: Camera
    nearest: float
    """Depth Z of the front of the box, world units."""
    farthest: float
    """Depth Z of its back."""
    width: float
    """Of the hologram, metres."""
    thickness: float
    """D, metres."""

    @property
    def rho(self) -> float:
        """Metres for a pixel of the camera."""
        return self.width / self.camera.width

    def z_of(self, depths: Floats) -> Floats:
        """Return z, metres, of depths of the camera."""
        a, b = 1 / self.nearest, 1 / self.farthest
        return self.thickness * (1 / depths - (a + b) / 2) / (a - b)


class Placed(NamedTuple):
    """A scene in its box, with counts of the Gaussians that could not be kept."""

    scene: Scene
    box: Box
    n_thick: int
    """Gaussians that were no discs and have lost a third axis."""
    n_steep: int
    """Whose slopes were bounded."""


def place(
    gaussians: Gaussians, camera: Camera, width: float, thickness: float, steepest: float, conventions: Conventions
) -> Placed:
    """Return a camera's view of a model, in a box around a hologram.

    Parameters
    ----------
    gaussians : Gaussians
        Surfels, or any Gaussians: the thinnest axis is left out.
    camera : Camera
    width, thickness : float
        Of the box, metres.
    steepest : float
        Bound of |g|.
    conventions : Conventions
        Near plane, least alpha and low-pass of the renderer.

    Raises
    ------
    InputError
        The camera sees nothing, or everything at one depth.
    """
    g = Gaussians(*(field.astype(np.float64) for field in gaussians))
    opacities = activate(g).opacities
    in_camera = g.means @ camera.cam_from_world_R.T + camera.cam_from_world_t
    is_seen = _is_seen(in_camera, g, opacities, camera, conventions)
    if not is_seen.any():
        raise InputError(
            f"none of the {len(is_seen):,} Gaussians is in front of the camera and in its view: give another --camera"
        )
    seen, in_camera = Gaussians(*(field[is_seen] for field in g)), in_camera[is_seen]
    degree = math.isqrt(g.sh_rest.shape[1] + 1) - 1
    colors = sh_colors(
        seen.means, seen.sh_dc, seen.sh_rest, camera.astype(np.float64), degree, np.ones((len(in_camera), 2), int)
    )
    log_areas = seen.log_scales.sum(axis=1) - seen.log_scales.min(axis=1) - 2 * np.log(in_camera[:, 2])
    weights = opacities[is_seen] * np.exp(log_areas - log_areas.max())
    box = Box(camera, *_ends(in_camera[:, 2], weights), width, thickness)
    flats, n_steep = _flats_in(box, seen, in_camera, steepest, conventions.eps2d)
    ordered = np.sort(seen.log_scales, axis=1)
    n_thick = int(np.count_nonzero(ordered[:, 0] - ordered[:, 1] > math.log(THICK)))
    alphas = np.minimum(opacities[is_seen], conventions.alpha_max)
    return Placed(front_to_back(Scene(flats, alphas, colors)), box, n_thick, n_steep)


def _is_seen(
    in_camera: Floats, gaussians: Gaussians, opacities: Floats, camera: Camera, conventions: Conventions
) -> Bools:
    """Return which Gaussians are in front of the camera, not transparent, and within three deviations of its image."""
    X, Y, Z = in_camera.T
    is_seen: Bools = (conventions.near_plane < Z) & (opacities >= conventions.alpha_min)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        reach = 3 * np.exp(gaussians.log_scales.max(axis=1)) / Z
        u, v = X / Z, Y / Z
        is_seen &= (u + reach > -camera.cx / camera.fx) & (u - reach < (camera.width - camera.cx) / camera.fx)
        is_seen &= (v + reach > -camera.cy / camera.fy) & (v - reach < (camera.height - camera.cy) / camera.fy)
    # A Gaussian that the camera is almost inside of has no footprint that a Jacobian describes.
    return is_seen & (np.abs(u) < camera.width / camera.fx) & (np.abs(v) < camera.height / camera.fy)


def _ends(depths: Floats, weights: Floats) -> tuple[float, float]:
    """Return the depths between which all but a share of the weight is, at either end."""
    order = np.argsort(depths)
    below = np.cumsum(weights[order]) / np.sum(weights)
    nearest, farthest = depths[order][np.searchsorted(below, [DEPTH_SHARE, 1 - DEPTH_SHARE])].tolist()
    if not farthest > nearest:  # one depth: any range around it
        return 0.5 * nearest, 2 * nearest
    return nearest, farthest


def _flats_in(box: Box, seen: Gaussians, in_camera: Floats, steepest: float, eps2d: float) -> tuple[Flats, int]:
    """Return flat Gaussians in the box, and the number of those that were too steep."""
    camera, (X, Y, Z) = box.camera, in_camera.T
    z = np.clip(box.z_of(Z), -box.thickness / 2, box.thickness / 2)
    x = box.rho * (camera.fx * X / Z + camera.cx - camera.width / 2)
    y = box.rho * (camera.fy * Y / Z + camera.cy - camera.height / 2)
    J = np.zeros((len(Z), 3, 3))
    J[:, 0, 0], J[:, 0, 2] = box.rho * camera.fx / Z, -box.rho * camera.fx * X / Z**2
    J[:, 1, 1], J[:, 1, 2] = box.rho * camera.fy / Z, -box.rho * camera.fy * Y / Z**2
    J[:, 2, 2] = -box.thickness / (1 / box.nearest - 1 / box.farthest) / Z**2
    spans = J @ (camera.cam_from_world_R @ flatten(seen.means, seen.quats, seen.log_scales).spans)  # [N, 3, 2]
    lateral, across = spans[:, :2], spans[:, 2:]
    B = lateral @ np.swapaxes(lateral, 1, 2) + eps2d * box.rho**2 * np.eye(2)
    slopes = np.linalg.solve(B, lateral @ np.swapaxes(across, 1, 2))[..., 0]  # [N, 2]
    lengths = np.linalg.norm(slopes, axis=1)
    slopes *= np.minimum(1, steepest / np.maximum(lengths, steepest))[:, None]
    roots = np.linalg.cholesky(B)
    mapped = np.concatenate([roots, slopes[:, None, :] @ roots], axis=1)  # [N, 3, 2]
    axes, scales, _ = np.linalg.svd(mapped)
    return Flats(np.column_stack([x, y, z]), axes, scales), int(np.count_nonzero(lengths > steepest))


def steepest_slope(wavelength: float, pitch: float) -> float:
    """Return the bound of |g|, ``1 / (2 tan(theta))``; 0 where the pitch is finer than half a wavelength."""
    sine = wavelength / (2 * pitch)
    return math.sqrt(1 - sine**2) / (2 * sine) if sine < 1 else 0.0
