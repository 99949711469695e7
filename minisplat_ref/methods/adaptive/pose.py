"""Pose of each photograph, which ``adaptive`` refines where the photographs show that the given poses are off.

A camera that is turned by a small rotation w = (w_x, w_y, 0), in its own frame, shows everything displaced by

    du = f_x w_y,   dv = -f_y w_x        pixels, near the middle of the image

Where the displacement of one half of a photograph explains the other half
(:mod:`minisplat_ref.methods.adaptive.evidence`) its pose is off. All photographs then get corrections of their poses
(:mod:`minisplat_ref.training.calibration`), which begin with the rotations that correspond to these displacements.
Held-out photographs are not trained on: before each measurement they are rotated by their displacements alone.

A rotation of everything, cameras and scene, changes no photograph. It would drift, and test views would see the scene
from elsewhere; so the mean rotation and the mean shift, in the world frame, are kept at zero. The scale stays free.
"""

import numpy as np

from minisplat_ref.methods.adaptive.evidence import Answer, displacements, pose_evidence
from minisplat_ref.training.calibration import ROTATIONS, SHIFTS, zero_corrections
from minisplat_ref.training.pace import measured_ids, trained_ids
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Camera, Floats


def displacement_rotation(camera: Camera, displacement: Floats) -> Floats:
    """Return the rotation vector [3], radians, that displaces the middle of an image by (du, dv) pixels."""
    du, dv = displacement
    return np.array([-dv / camera.fy, du / camera.fx, 0.0])


def examine_poses(state: TrainState, iteration: Iteration) -> Answer:
    """Return whether displacements fitted to one half of each photograph explain the other; poses begin with these."""
    views = iteration.scene.train_views
    ids = trained_ids(len(views), iteration.cooling, state.pace)
    evidence = pose_evidence(state, iteration, ids)
    why = evidence.describe(f"cameras turned by {evidence.spread:.2f} pixels")

    def begin() -> dict[str, Floats]:
        corrections = zero_corrections(len(views))
        for index, x in zip(ids, evidence.fitted, strict=True):
            corrections[ROTATIONS][index] = displacement_rotation(views[index].camera, -x)
        return corrections

    return Answer(evidence, why, begin)


def turn_held_out(state: TrainState, iteration: Iteration) -> str | None:
    """Align the cameras of the held-out training views with the scene, if poses are refined."""
    if ROTATIONS not in state.shared or iteration.cooling is None or not state.pace.holds_out:
        return "nothing done: no poses are refined"
    views = iteration.scene.train_views
    if not iteration.cooling.holds_out(len(views)):
        return "nothing done: no views are held out"
    ids = measured_ids(len(views), iteration.cooling.hold_out_every)
    found = displacements(state, iteration, ids)
    for index, displacement in zip(ids, found, strict=True):
        state.shared[ROTATIONS][index] += displacement_rotation(views[index].camera, displacement)
    return f"by {np.sqrt(np.mean(found**2)):.2f} pixels"


def hold_mean_pose(state: TrainState, iteration: Iteration) -> None:
    """Keep the mean correction of the views that are trained on at zero."""
    if ROTATIONS not in state.shared:
        return
    views = iteration.scene.train_views
    ids = trained_ids(len(views), iteration.cooling, state.pace)
    world_from_cam = np.array([views[index].camera.cam_from_world_R.T for index in ids])  # [V, 3, 3]
    for corrections in (state.shared[ROTATIONS], state.shared[SHIFTS]):
        mean = np.einsum("vij,vj->i", world_from_cam, corrections[ids]) / len(ids)  # [3] world frame
        corrections[ids] -= np.einsum("vji,j->vi", world_from_cam, mean)
