"""Worlds whose origin, or whose unit, is far from the scene's."""

import numpy as np

from minisplat_ref.oracle.hard_cases.case import HardCase
from minisplat_ref.oracle.hard_cases.scenes import cloud, moved_world
from minisplat_ref.oracle.hard_cases.subjects import Call, Parameters
from minisplat_ref.oracle.tolerances import ORDINARY, WORLD

RELATIVE = "the image of the means that float32 holds: the camera's centre is subtracted before anything is rounded"


def _georeferenced_call() -> Call:
    """Through the door, whose view matrix is rounded like everything else: t = -R c is 1e6 too."""
    subject = moved_world((448000, 5412000, 300), scale=50.0)
    viewmat, K = np.eye(4), np.eye(3)
    view, g = subject.camera, subject.gaussians
    viewmat[:3, :3], viewmat[:3, 3] = np.eye(3), -np.array([448000, 5412000, 300.0])
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = view.fx, view.fy, view.cx, view.cy
    means = (50 * cloud().means + [448000, 5412000, 300]).astype(np.float32).astype(np.float64)
    arrays = {
        "means": means,
        "quats": g.quats,
        "scales": np.exp(g.log_scales).astype(np.float32).astype(np.float64),
        "opacities": np.full(len(means), 0.5),
        "colors": g.sh_dc,
        "viewmats": viewmat[None],
        "Ks": K[None],
    }
    return Call(arrays, view.width, view.height, {})


def _displaced(offset: tuple[float, float, float], scale: float) -> Parameters:
    return moved_world(offset, scale=scale)


WORLD_CASES = (
    HardCase(
        "world-at-1e6",
        "means of 1e6 are multiples of 1/16 in float32, and R mu + t cancels",
        RELATIVE,
        lambda: _displaced((1e6, -1e6, 1e6), 20.0),
        WORLD,
    ),
    HardCase(
        "world-utm",
        "a UTM position, 448 km east, 5412 km north",
        RELATIVE,
        lambda: _displaced((448e3, 5412e3, 300), 50.0),
        WORLD,
    ),
    HardCase(
        "world-earth-centred",
        "earth-centred coordinates of 6.4e6 metres",
        RELATIVE,
        lambda: _displaced((4.2e6, 0.8e6, 4.7e6), 50.0),
        WORLD,
    ),
    HardCase("world-utm-call", "a view matrix whose t is 5e6", RELATIVE, _georeferenced_call, WORLD),
    HardCase(
        "world-at-1e6-coarse",
        "a scene of one unit: every mean is rounded to a sixteenth of it",
        RELATIVE,
        lambda: _displaced((1e6, -1e6, 1e6), 1.0),
        WORLD,
    ),
    HardCase(
        "world-in-metres-of-a-map",
        "a scene that is 1e5 units wide",
        "as at any size",
        lambda: _displaced((0, 0, 0), 1e5),
        ORDINARY,
    ),
    HardCase(
        "world-of-centimetres",
        "a scene of a twentieth of a unit, at the near plane's scale",
        "as at any size",
        lambda: _displaced((0, 0, 0), 0.05),
        ORDINARY,
    ),
)
