"""Synthetic scenes, stage 5: camera poses.

The cameras walk around the scene at varying distance and height, upright and looking inwards.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Camera, Floats

WORLD_UP = np.array([0.0, 0.0, 1.0])
EVEN_STEPS = (
    0.7548776662466927,
    0.5698402909980532,
)  # powers of 1 / plastic number: multiples modulo 1 fill a square evenly


class Orbit(NamedTuple):
    """A ring of camera positions."""

    target: Floats
    """[3] point that every camera looks at, world frame."""
    radius: tuple[float, float]
    """Minimum and maximum horizontal distance from the target, world units."""
    height: tuple[float, float]
    """Minimum and maximum z of a camera, world units."""
    fov_degrees: float
    """Horizontal field of view."""

    def cameras(self, n_cameras: int, width: int, height: int, rng: np.random.Generator) -> list[Camera]:
        """Return cameras at equal angles around the target, at quasi-random radius and height.

        Parameters
        ----------
        n_cameras : int
            How many.
        width, height : int
            Image size, pixels.
        rng : numpy.random.Generator
            Draws where the ring starts.

        Returns
        -------
        list of Camera
            float64, in walking order.
        """
        steps = np.arange(n_cameras)
        angles = 2.0 * np.pi * (steps / n_cameras + rng.random())
        radii = _within(self.radius, (steps * EVEN_STEPS[0] + rng.random()) % 1.0)
        heights = _within(self.height, (steps * EVEN_STEPS[1] + rng.random()) % 1.0)
        positions = np.stack(
            [self.target[0] + radii * np.cos(angles), self.target[1] + radii * np.sin(angles), heights], axis=1
        )  # [n, 3]
        focal = 0.5 * width / np.tan(0.5 * np.radians(self.fov_degrees))
        return [look_at(position, self.target, focal, width, height) for position in positions]


def look_at(position: Floats, target: Floats, focal: float, width: int, height: int) -> Camera:
    """Return a camera at a position with the target in the image's centre and the world's z axis upright.

    Parameters
    ----------
    position, target : ndarray of shape (3,)
        World frame; not one above the other.
    focal : float
        Focal length, pixels.
    width, height : int
        Image size, pixels.

    Returns
    -------
    Camera
        OpenCV axes: the rows of its rotation are the camera's right, down and forward.
    """
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, WORLD_UP)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    rotation = np.stack([right, down, forward])  # [3, 3]
    return Camera(rotation, -rotation @ position, focal, focal, 0.5 * width, 0.5 * height, width, height)


def _within(bounds: tuple[float, float], share: Floats) -> Floats:
    """[n] linear interpolation between two bounds."""
    return bounds[0] + (bounds[1] - bounds[0]) * share
