"""Poses: rotate and shift every camera by a known amount, which the training has to correct.

The claim is ours. A synthetic scene is trained three times: with its true cameras, with the disturbed ones, and with
these and pose refinement. Poses are determined up to one similarity transform ``x_true = s S x + d`` that scene and
cameras share, so it is fitted to the camera centres before anything is compared, and its inverse maps held-out cameras
into the trained scene.

A rotation of the camera and a shift across its axis move an image nearly alike, and only differences of depth
distinguish them: errors of both may remain that compensate each other in the image. So there is a third measure besides
angle and distance: the median displacement, in pixels, of the points that a photograph shows.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from data_tools.claims import kit
from data_tools.claims.kit import recovery
from data_tools.claims.kit.claim import CALIBRATION, argument, declare
from data_tools.claims.kit.figures import subplots
from data_tools.claims.kit.recovery import ARMS
from data_tools.claims.kit.tables import mean
from minisplat_ref.errors import InputError
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.calibration import ROTATIONS, SHIFTS, correct_pose
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import Camera, Floats, Gaussians, Scene, View


class Disturbance(NamedTuple):
    """By how much each camera is rotated and shifted, in random directions."""

    degrees: float
    shift: float
    """Of the scene's extent."""


class Similarity(NamedTuple):
    """``x_true = s S x + d``."""

    s: float
    S: Floats
    """[3, 3] rotation."""
    d: Floats
    """[3] world units."""


def run(args: argparse.Namespace) -> kit.Report:
    """Disturb, train and measure.

    Raises
    ------
    InputError
        The disturbance is out of range.
    """
    if not (0 <= args.degrees < 90 and 0 <= args.shift < 1):
        raise InputError(f"--degrees is {args.degrees} and --shift {args.shift}: give 0 to 90 and 0 to 1")
    scene, recipe = recovery.scene_and_recipe(args)
    disturbance = Disturbance(args.degrees, args.shift)
    arms = measure(scene, recipe, disturbance, args.seed)
    columns = (
        ("angle (degrees)", mean("degrees", 3)),
        ("centre (% of extent)", mean(lambda row: 100 * np.asarray(row["shifts"]) / scene.extent, 3)),
        ("points (px)", mean("pixels", 3)),
        ("held-out PSNR (dB)", mean("psnr", 2)),
    )
    more = {**disturbance._asdict(), "extent": scene.extent}
    return recovery.report(args, scene, arms, columns, draw(arms), **more)


def measure(
    scene: Scene, recipe: Recipe, disturbance: Disturbance, seed: int, arms: tuple[str, ...] = ARMS
) -> dict[str, dict[str, Any]]:
    """Train the arms, and return for each the errors of its cameras, and the PSNR of held-out views."""
    disturbed = disturb_poses(scene, disturbance, np.random.default_rng(seed))
    truth = [view.camera for view in scene.train_views]
    result = {}
    for arm in kit.with_progress(arms, "trainings"):
        seen = scene if arm == "undisturbed" else disturbed
        cameras = [view.camera for view in seen.train_views]
        state = train(seen, configure(recipe, pose=arm == "calibrated"), seed=seed)
        if arm == "calibrated":
            corrections = zip(cameras, state.shared[ROTATIONS], state.shared[SHIFTS], strict=True)
            cameras = [move(camera, w, u) for camera, w, u in corrections]
        similarity = align(cameras, truth)
        aligned = [carry(camera, similarity) for camera in cameras]
        degrees, shifts = errors(aligned, truth)
        result[arm] = {
            "degrees": degrees.tolist(),
            "shifts": shifts.tolist(),
            "pixels": [displacement(*pair, scene) for pair in zip(aligned, scene.train_views, strict=True)],
            "psnr": measure_held_out_psnr(state.gaussians, scene, similarity),
        }
    return result


def disturb_poses(scene: Scene, disturbance: Disturbance, rng: np.random.Generator) -> Scene:
    """Return the scene with every training camera rotated and shifted in its own random directions."""
    directions = rng.normal(size=(2, len(scene.train_views), 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    rotations = np.radians(disturbance.degrees) * directions[0]  # [V, 3]
    shifts = disturbance.shift * scene.extent * directions[1]
    views = zip(scene.train_views, rotations, shifts, strict=True)
    return scene._replace(train_views=tuple(v._replace(camera=move(v.camera, w, u)) for v, w, u in views))


def move(camera: Camera, w: Floats, u: Floats) -> Camera:
    """Return the camera with its pose corrected by :func:`correct_pose`."""
    R, t = correct_pose(camera.cam_from_world_R, camera.cam_from_world_t, w, u)
    return camera._replace(cam_from_world_R=R, cam_from_world_t=t)


def centres(cameras: list[Camera]) -> Floats:
    """Return the camera centres ``-R^T t`` [V, 3]."""
    return np.array([camera.center for camera in cameras])


def align(cameras: list[Camera], truth: list[Camera]) -> Similarity:
    """Return the least-squares similarity that maps the camera centres to the true ones (Umeyama 1991).

    ::

        sum_v (p_v - mean p) (q_v - mean q)^T = U diag(lambda) V^T       q the given centres, p the true ones
        S = U diag(1, 1, det U V^T) V^T,   s = sum_i lambda_i sign_i / sum_v |q_v - mean q|^2,   d = mean p - s S mean q
    """
    q, p = centres(cameras), centres(truth)
    offsets = q - q.mean(axis=0)
    U, lambdas, Vt = np.linalg.svd((p - p.mean(axis=0)).T @ offsets)
    signs = np.array([1, 1, np.linalg.det(U @ Vt)])
    S = (U * signs) @ Vt
    s = float(lambdas @ signs / np.sum(offsets**2))
    return Similarity(s, S, p.mean(axis=0) - s * S @ q.mean(axis=0))


def carry(camera: Camera, similarity: Similarity) -> Camera:
    """Map a camera from the trained scene to the true frame."""
    s, S, d = similarity
    R = camera.cam_from_world_R @ S.T
    return camera._replace(cam_from_world_R=R, cam_from_world_t=s * camera.cam_from_world_t - R @ d)


def carry_back(camera: Camera, similarity: Similarity) -> Camera:
    """Map a camera from the true frame to the trained scene."""
    s, S, d = similarity
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    return camera._replace(cam_from_world_R=R @ S, cam_from_world_t=(R @ d + t) / s)


def errors(cameras: list[Camera], truth: list[Camera]) -> tuple[Floats, Floats]:
    """Return angles (degrees) and distances of the centres (world units) between two sets of cameras, [V] each."""
    turns = [a.cam_from_world_R @ b.cam_from_world_R.T for a, b in zip(cameras, truth, strict=True)]
    degrees = np.degrees(Rotation.from_matrix(np.array(turns)).magnitude())
    return degrees, np.linalg.norm(centres(cameras) - centres(truth), axis=1)


def displacement(camera: Camera, view: View, scene: Scene) -> float:
    """Return the median distance, pixels, between a view's points as seen by a camera and by the view's own."""
    points = scene.points[view.point_ids]  # [Q, 3]
    images = []
    for seen_by in (camera, view.camera):
        x, y, z = (points @ seen_by.cam_from_world_R.T + seen_by.cam_from_world_t).T
        images.append(np.stack([seen_by.fx * x / z, seen_by.fy * y / z]))  # [2, Q]
    return float(np.median(np.linalg.norm(images[0] - images[1], axis=0)))


def measure_held_out_psnr(gaussians: Gaussians, scene: Scene, similarity: Similarity) -> float:
    """Return the mean PSNR of the test views, with their cameras mapped into the trained scene."""
    views = [view._replace(camera=carry_back(view.camera, similarity)) for view in scene.test_views]
    psnr = evaluate(gaussians, views, RenderSettings(scene.background)).psnr
    assert psnr is not None, "there are test views"
    return psnr


def draw(result: dict[str, dict[str, Any]]) -> Figure:
    """Draw each camera's error before and after, and the PSNR of the three trainings."""
    figure, (degrees, pixels, quality) = subplots((10, 3), 1, 3)
    recovery.draw_errors(degrees, result, "degrees")
    recovery.draw_errors(pixels, result, "pixels")
    degrees.set(title="rotation against the truth", ylabel="degrees")
    pixels.set(title="points in the image against the truth", ylabel="pixels")
    degrees.legend()
    recovery.draw_quality(quality, result)
    return figure


CLAIMS = (
    declare(
        "pose",
        "pose refinement: cameras moved by known amounts, and recovered",
        run,
        *CALIBRATION,
        argument(
            "--degrees", type=float, default=0.5, metavar="A", help="by which each camera is turned (default 0.5)"
        ),
        argument(
            "--shift", type=float, default=0.005, metavar="F", help="of the extent, of each camera (default 0.005)"
        ),
    ),
)
