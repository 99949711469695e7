"""A synthetic scene: twelve boxes on the ground, seen by six satellites, each with its own sun and colours.

Rays are parallel, so a pixel's ray and the way to the sun meet boxes in closed form. World units are 48 m.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.satellite.cameras import make_affine_camera
from minisplat_ref.mechanisms.cameras.affine import downward
from minisplat_ref.types import Bools, Camera, Floats, Frame, Scene, View

SCALE, SIZE, N_VIEWS = 48.0, 96, 6  # metres per unit, pixels, photographs
HIGH = 24.0  # metres above the ground to which points fill the volume
SKY = np.array([0.30, 0.35, 0.45])  # what lights the shadows


class Truth(NamedTuple):
    """The scene's truth."""

    scene: Scene
    is_shadow: Bools
    """[V, H, W] of the photographs."""
    radiometry: Floats
    """[V, 3, 4]."""
    heights: Floats
    """[H, W] metres, seen by :func:`zenith`."""


class Boxes(NamedTuple):
    """Boxes that stand on the ground, in metres."""

    low: Floats
    """[B, 3]."""
    high: Floats
    """[B, 3]."""
    colors: Floats
    """[B + 1, 2, 3] of the roof and of the walls; the ground is last."""


def zenith(size: int = SIZE, width: float = 2 * SCALE) -> Camera:
    """Return a camera that looks straight down on ``width`` metres, without a sun; north is up."""
    return _camera(np.zeros(2), size, width, None)


def _camera(tilt: Floats, size: int, width: float, sun: Floats | None) -> Camera:
    """Return a camera that sees what is h metres high beside by ``tilt h`` metres."""
    per_metre = size / width
    A = SCALE * np.array([[per_metre, 0, -per_metre * tilt[0]], [0, -per_metre, per_metre * tilt[1]]])
    return make_affine_camera(A, np.array([size / 2, size / 2]), SCALE, (size, size), sun)


def make_boxes(rng: np.random.Generator) -> Boxes:
    """Return twelve boxes in a grid of 4 x 3, moved at random, 6 to 20 metres high."""
    places = np.stack(np.meshgrid(np.arange(4) - 1.5, np.arange(3) - 1.0, indexing="ij"), axis=-1).reshape(-1, 2)
    centres = places * [21, 27] + rng.uniform(-3, 3, size=(12, 2))
    half = rng.uniform([4, 5], [7, 9], size=(12, 2))
    heights = rng.uniform(6, 20, size=12)
    low = np.column_stack([centres - half, np.zeros(12)])
    high = np.column_stack([centres + half, heights])
    colors = rng.uniform(0.15, 0.6, size=(13, 2, 3))
    colors[-1] = 0.5, 0.5, 0.42
    return Boxes(low, high, colors)


def meet(boxes: Boxes, origins: Floats, direction: Floats, limit: float) -> tuple[Floats, Floats, Floats]:
    """Return where rays [P, 3] first meet a box: lengths [P] up to ``limit``, the box [P] or -1, and the axis [P]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (boxes.low - origins[:, None]) / direction  # [P, B, 3]
        second = (boxes.high - origins[:, None]) / direction
    near, far = np.fmin(first, second), np.fmax(first, second)
    enter, leave = near.max(axis=2), far.min(axis=2)
    lengths = np.where((enter < leave) & (leave > 1e-6), np.maximum(enter, 0), np.inf)
    box = lengths.argmin(axis=1)
    rows = np.arange(len(origins))
    found = lengths[rows, box]
    axis = near[rows, box].argmax(axis=1)
    is_met = found < limit
    return np.where(is_met, found, limit), np.where(is_met, box, -1), axis


def trace(boxes: Boxes, camera: Camera, sun: Floats | None) -> tuple[Floats, Floats, Bools]:
    """Return albedo [H, W, 3], height [H, W] and which pixels [H, W] are in shadow."""
    seen = downward(camera)
    A = seen.cam_from_world_R / SCALE  # per metre; rows of u, v, -h
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    top = HIGH + 1
    targets = np.stack([columns, rows, np.full(rows.shape, -top)], axis=-1).reshape(-1, 3)
    origins = (targets - seen.cam_from_world_t) @ np.linalg.inv(A).T
    down = np.linalg.solve(A, [0.0, 0.0, 1.0])  # metres per metre downwards
    lengths, box, axis = meet(boxes, origins, down, top)
    points = origins + lengths[:, None] * down
    albedo = boxes.colors[box, np.where((axis == 2) | (box < 0), 0, 1)]
    albedo = albedo * texture(points)[:, None]
    shape = camera.height, camera.width
    is_shadow = np.zeros(len(points), bool)
    if sun is not None:
        is_shadow = meet(boxes, points + 1e-3 * sun, sun, np.inf)[1] >= 0
    return albedo.reshape(*shape, 3), points[:, 2].reshape(shape), is_shadow.reshape(shape)


def texture(points: Floats) -> Floats:
    """Return the factor of the colour [P] at points [P, 3] in metres: waves of 4 to 40 m, between 0.68 and 1.32."""
    waves = np.array([[1.1, 0.7, 0.9], [-0.5, 0.9, 0.6], [0.35, 0.4, -0.5], [-0.12, 0.1, 0.2]])
    found: Floats = 1 + 0.08 * np.sin(points @ waves.T + np.arange(4)).sum(axis=1)
    return found


def make_scene(seed: int, n_points: int = 5000, size: int = SIZE, below: float = 0.0) -> Truth:
    """Return the scene of a seed, with random points in its volume; the first photograph has identity radiometry.

    Parameters
    ----------
    seed : int
    n_points, size : int
        Points, and pixels of a photograph in width and height.
    below : float
        By how many metres the lowest altitude, which is the world's origin, is below the ground.
    """
    rng = np.random.default_rng(seed)
    boxes, views, masks, radiometry = make_boxes(rng), [], [], []
    turned = rng.uniform(0, 2 * np.pi)
    for k in range(N_VIEWS):
        around, sunwards = turned + 2 * np.pi * k / N_VIEWS, turned + 1.9 * k
        tilt = rng.uniform(0.3, 0.6) * np.array([np.cos(around), np.sin(around)])
        sun = np.array([np.cos(sunwards), np.sin(sunwards), rng.uniform(1.0, 1.8)])
        camera = _camera(tilt, size, 2 * SCALE, sun)
        albedo, _, is_shadow = trace(boxes, camera, sun)
        C = np.diag(rng.uniform(0.7, 1.2, 3)) + rng.uniform(-0.05, 0.05, (3, 3))
        light = np.column_stack([C, rng.uniform(-0.05, 0.05, 3)]) if k else np.eye(3, 4)
        lit = np.where(is_shadow[..., None], SKY, 1) * (albedo @ light[:, :3].T + light[:, 3])
        image = np.clip(np.rint(255 * lit), 0, 255).astype(np.uint8)
        lowered = camera.cam_from_world_t - below / SCALE * camera.cam_from_world_R[:, 2]
        views.append(View(f"{k:02d}", camera._replace(cam_from_world_t=lowered), image, None, view_id=k))
        masks.append(is_shadow)
        radiometry.append(light)
    points = rng.uniform([-1.1, -1.1, 0], [1.1, 1.1, (HIGH + below) / SCALE], size=(n_points, 3))
    frame = Frame((0.0, 0.0, 0.0), SCALE)
    scene = Scene("boxes", tuple(views), (), points, np.full((n_points, 3), 128, np.uint8), np.zeros(3), 1.0, frame)
    _, heights, _ = trace(boxes, zenith(size), None)
    return Truth(scene, np.array(masks), np.array(radiometry), heights + below)
