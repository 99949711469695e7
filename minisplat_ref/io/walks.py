"""Walks: photographs taken one after the other on the way through a scene, such as a street, and a path along them.

Cameras that look along the way that they go do not surround anything: at one angle about the point that they look at
there are cameras at every distance, and a circle through their mean is where nobody has been. A path of a walk goes
from photograph to photograph instead, in their order.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.interpolate import PchipInterpolator

from minisplat_ref.types import Camera, Floats

CAMERAS_MIN = 4  # three are on one circle
SCATTER_MIN = 0.5  # of distances at one angle, over the spread of the cameras; 1 for a straight line into the scene
STEP_MAX = 0.5  # of the mean step to the next photograph, over the mean distance of any two; about 1 in any other order
TURN = math.radians(20.0)  # counts as much as the median step, so that a turn on the spot takes its time


def is_walk(cameras: Sequence[Camera], off_circle: Floats) -> bool:
    """Return whether cameras are those of a walk, in its order.

    Parameters
    ----------
    cameras : sequence of Camera
        In the order of their photographs.
    off_circle : ndarray of shape (V,)
        How much farther from the axis cameras are than a path around the scene at their angle, world units.
    """
    if len(cameras) < CAMERAS_MIN:
        return False
    centres = np.array([camera.center for camera in cameras])  # [V, 3]
    spread = math.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean())
    if math.sqrt((off_circle**2).mean()) <= SCATTER_MIN * spread:
        return False
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)  # [V - 1]
    distances = np.linalg.norm(centres[:, None] - centres, axis=2)  # [V, V]
    return steps.mean() <= STEP_MAX * distances.sum() / (len(cameras) * (len(cameras) - 1))


def way_along(cameras: Sequence[Camera]) -> Callable[[float], tuple[Floats, Floats]]:
    """Return the way from the first photograph (0) to the last (1): position [3], and direction of the view [3].

    It is a smooth curve through the cameras, each of which is first moved towards the middle of its neighbours, because
    a walker sways. The ends stay.
    """
    centres = np.array([camera.center for camera in cameras])  # [V, 3]
    forwards = np.array([camera.cam_from_world_R[2] for camera in cameras])  # [V, 3]
    places = np.concatenate([centres, forwards], axis=1)  # [V, 6]
    places[1:-1] = 0.25 * places[:-2] + 0.5 * places[1:-1] + 0.25 * places[2:]
    steps = np.linalg.norm(np.diff(places[:, :3], axis=0), axis=1)  # [V - 1]
    turns = np.linalg.norm(np.diff(places[:, 3:], axis=0), axis=1)  # [V - 1] nearly angles
    lengths = steps / max(float(np.median(steps)), 1e-12) + turns / TURN + 1e-6  # never 0
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    curve = PchipInterpolator(way / way[-1], places)

    def place(share: float) -> tuple[Floats, Floats]:
        at = curve(share)
        return at[:3], at[3:]

    return place
