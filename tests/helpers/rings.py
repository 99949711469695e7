"""Cameras on a circle, for the tests of viewpoints and of orbits."""

import numpy as np

from minisplat_ref.io.viewpoints import Viewpoint
from scenes import make_camera

WIDTH, HEIGHT = 24, 18


def ring_of_cameras(target, radius, height, n=8):
    """Cameras on a circle about the vertical (-y) axis through the target, looking at it."""
    views = []
    for angle in 2 * np.pi * np.arange(n) / n:
        position = target + np.array([radius * np.cos(angle), -height, radius * np.sin(angle)])
        forward = (target - position) / np.linalg.norm(target - position)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        camera = make_camera(WIDTH, HEIGHT)._replace(cam_from_world_R=R, cam_from_world_t=-R @ position)
        views.append(Viewpoint(f"{len(views)}", camera, "train"))
    return views
