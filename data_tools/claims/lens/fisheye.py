"""Claim ``lens/fisheye``: a fisheye of 150 degrees trained as photographed, against undistorting and cropping it.

The paper is 3DGUT, arXiv 2412.12507. The photographs are ray-traced in a closed room along an equidistant fisheye's
rays. COLMAP's undistortion keeps a pinhole image of the same focal length; the pixels whose rays leave it are the
border. The arms start from the same points, seen by the fisheye, so the undistorted ones are told of places that their
photographs do not show, and none changes the number of Gaussians:

- ``as photographed``: exact rays, on the fisheye's photographs;
- ``undistorted, exact rays``: the same renderer on the pinhole's, so that the photographs alone make the difference;
- ``undistorted, EWA``: 3DGS on the pinhole's, as it is usually done.

PSNR is measured on held-out photographs of the fisheye, which exact rays draw for all arms, in what undistortion keeps
and in the border, and on undistorted held-out ones by the renderer of the training. The last measure favours the arms
that were trained on such photographs.
"""

import argparse
import itertools
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import plot_deviations, subplots, summarise
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.datasets.synthetic.geometry import first_hits
from minisplat_ref.datasets.synthetic.scenes import SETTINGS
from minisplat_ref.datasets.synthetic.tracer import World, points_along, radiance
from minisplat_ref.extensions.lens.model import LENS, THROUGH_LENS
from minisplat_ref.interface.palette import BLUE, GREY, RED
from minisplat_ref.interface.reporting import describe_machine
from minisplat_ref.io.lens import Lens, undistort
from minisplat_ref.io.srgb import encode_srgb
from minisplat_ref.mechanisms.cameras.models import PERSPECTIVE, model_of
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import Renderer, Request
from minisplat_ref.training.schedule import Recipe, scale_recipe
from minisplat_ref.types import Bools, Camera, Floats, Model, Optics, Scene, View, number_views, view_from

ANGLE = 150.0  # degrees, from the left edge to the right one
N_VIEWS, TEST_EVERY, N_POINTS = 32, 4, 6000
SUPERSAMPLING = 2
EXTENT = 3.0  # metres: the extent that learning rates of means are relative to, about the radius of the room
RINGS = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 95.0)  # degrees off the axis
THROUGH_RAYS = LENS._replace(representation=THROUGH_LENS)
ARMS: dict[str, tuple[Recipe, bool, str]] = {
    "as photographed": (THROUGH_RAYS, False, RED),
    "undistorted, exact rays": (THROUGH_RAYS, True, BLUE),
    "undistorted, EWA": (GS_ACCEL, True, GREY),
}
"""Recipe, whether the photographs are undistorted, colour."""
MEASURES = {
    "pinhole": "undistorted photographs",
    "kept": "fisheye, what undistortion keeps",
    "border": "fisheye, its border",
}


class Photographs(NamedTuple):
    """A scene through the fisheye, and what undistortion makes of it."""

    fisheye: Scene
    pinhole: Scene
    is_kept: Bools
    """[H, W] which pixels of the fisheye have a ray inside the pinhole's image."""
    angles: Floats
    """[H, W] of the rays to the axis, degrees."""


def fisheye_of(camera: Camera) -> Camera:
    """Return the equidistant fisheye with the pose and size of a camera."""
    focal = camera.width / 2 / np.radians(ANGLE / 2)
    return camera._replace(fx=focal, fy=focal, optics=Optics("fisheye", (0.0, 0.0, 0.0, 0.0)))


def rays_of(camera: Camera, dx: float = 0.5, dy: float = 0.5) -> Floats:
    """Return the directions [H W, 3] through a place of each pixel, camera frame."""
    grid = np.meshgrid(np.arange(camera.width) + dx, np.arange(camera.height) + dy)
    return model_of(camera).rays(np.stack(grid, axis=-1).reshape(-1, 2), camera)[1]


def photograph(world: World, camera: Camera) -> Any:
    """Return the image [H, W, 3], uint8, that a camera takes; each sample of a pixel sees one sample of the light."""
    light = np.zeros((camera.height * camera.width, 3))
    places = (np.arange(SUPERSAMPLING) + 0.5) / SUPERSAMPLING
    for i, (dx, dy) in enumerate((x, y) for y in places for x in places):
        directions = rays_of(camera, dx, dy) @ camera.cam_from_world_R
        ids = np.full(len(directions), i % len(world.light_positions))
        hits = first_hits(world.primitives, camera.center, directions)
        light += np.clip(radiance(world, camera.center, directions, hits, ids), 0, 1)
    image = np.round(255 * encode_srgb(np.clip(light / SUPERSAMPLING**2, 0, 1))).astype(np.uint8)
    return image.reshape(camera.height, camera.width, 3)


def take_photographs(width: int, seed: int) -> Photographs:
    """Return the photographs of a room, ``width`` and three quarters of it in size, every fourth held out."""
    scene_rng, camera_rng, point_rng = np.random.default_rng(seed).spawn(3)
    world, path, _ = SETTINGS["room"](scene_rng)
    cameras = path.cameras(N_VIEWS, width, 3 * width // 4, camera_rng)
    bent = [fisheye_of(camera) for camera in cameras]
    views = [View(f"{i:04d}", camera, photograph(world, camera), None) for i, camera in enumerate(bent)]
    straight = [_undistorted(view) for view in views]
    points, colors = _points(world, [view for i, view in enumerate(views) if i % TEST_EVERY], point_rng)
    fisheye, pinhole = (_scene(each, points, colors) for each in (views, straight))
    rays, camera = rays_of(bent[0]), straight[0].camera
    is_ahead = rays[:, 2] > 0
    places = PERSPECTIVE.project(np.where(is_ahead[:, None], rays, 1.0), camera)
    is_kept = is_ahead & (places >= 0).all(axis=1) & (places <= (camera.width, camera.height)).all(axis=1)
    angles = np.degrees(np.arccos(np.clip(rays[:, 2], -1, 1)))
    shape = views[0].image.shape[:2]
    return Photographs(fisheye, pinhole, is_kept.reshape(shape), angles.reshape(shape))


def _undistorted(view: View) -> View:
    """Return a photograph of the fisheye as COLMAP undistorts it."""
    camera = view.camera
    lens = Lens("OPENCV_FISHEYE", (camera.fx, camera.fy, camera.cx, camera.cy, 0.0, 0.0, 0.0, 0.0))
    image, _, pinhole = undistort(view.image, None, camera._replace(optics=None), lens)
    return view._replace(image=image, camera=pinhole)


def _points(world: World, views: list[View], rng: np.random.Generator) -> tuple[Floats, Any]:
    """Return points [N_POINTS, 3] on what random pixels of the views show, and their colours."""
    which = rng.integers(0, len(views), N_POINTS)
    points, colors = np.zeros((N_POINTS, 3)), np.zeros((N_POINTS, 3), np.uint8)
    for v, view in enumerate(views):
        rows = np.flatnonzero(which == v)
        pixels = rng.integers(0, view.camera.width * view.camera.height, len(rows))
        directions = rays_of(view.camera)[pixels] @ view.camera.cam_from_world_R
        hits = first_hits(world.primitives, view.camera.center, directions)
        points[rows] = points_along(view.camera.center, directions, hits)
        colors[rows] = view.image.reshape(-1, 3)[pixels]
    return points, colors


def _scene(views: list[View], points: Floats, colors: Any) -> Scene:
    train = number_views(view for i, view in enumerate(views) if i % TEST_EVERY)
    return Scene("room", train, tuple(views[::TEST_EVERY]), points, colors, np.zeros(3), EXTENT)


def train_and_measure(photographs: Photographs, arm: str, iterations: int, seed: int) -> dict[str, Any]:
    """Train an arm; return the PSNR of ``MEASURES``, and those of the rings, None where a ring has no pixels."""
    recipe, is_straight, _ = ARMS[arm]
    recipe = scale_recipe(recipe, iterations)._replace(events=(), sh_degree=0)
    scene = photographs.pinhole if is_straight else photographs.fisheye
    state = kit.train_with_progress(scene, recipe, seed)
    squares = _squares(state.model, photographs.fisheye, THROUGH_LENS.renderer)
    straight = _squares(state.model, photographs.pinhole, recipe.renderer)
    rings = [(low <= photographs.angles) & (photographs.angles < high) for low, high in itertools.pairwise(RINGS)]
    return {
        "pinhole": _psnr(straight),
        "kept": _psnr(squares[:, photographs.is_kept]),
        "border": _psnr(squares[:, ~photographs.is_kept]),
        "rings": [_psnr(squares[:, ring]) if ring.any() else None for ring in rings],
        "share kept": float(photographs.is_kept.mean()),
        "gaussians": len(state.gaussians.means),
    }


def _squares(model: Model, scene: Scene, renderer: Renderer) -> Floats:
    """Return the squared errors [V, H, W, 3] of the held-out views."""
    found = []
    for view in scene.test_views:
        output, _ = renderer.render(model, view_from(view.camera), Request())
        found.append((np.clip(output.image, 0, 1).astype(np.float64) - view.image / 255) ** 2)
    return np.stack(found)


def _psnr(squares: Floats) -> float:
    return float(-10 * np.log10(squares.mean()))


def run(args: argparse.Namespace) -> kit.Report:
    """Photograph the rooms, train all arms in each, and measure."""
    photographs = lru_cache(maxsize=1)(partial(take_photographs, args.width))
    settings = {**kit.settings_of(args, "width", "iterations"), "machine": describe_machine()}
    records = kit.resume(
        args.out,
        settings,
        kit.jobs_of(seed=range(args.seeds), arm=ARMS),
        lambda seed, arm: train_and_measure(photographs(seed), arm, args.iterations, seed),
    )
    text = (
        f"A fisheye of {ANGLE:g} degrees, {args.width} x {3 * args.width // 4}; undistortion keeps"
        f" {records[0]['share kept']:.1%} of its pixels; {records[0]['gaussians']:,} Gaussians;"
        f" {args.iterations:,} iterations, {args.seeds} seeds; {settings['machine']}\n\nPSNR on held-out views, dB\n\n"
        + table(records, {"arm": "arm"}, [(heading, spread(name, 2)) for name, heading in MEASURES.items()])
    )
    result = {**settings, "psnr": summarise(records, "arm", MEASURES), "records": records}
    return kit.Report(result, draw(records), text, kit.arms_of(records, "arm", list(MEASURES)))


def draw(records: list[dict[str, Any]]) -> Figure:
    """Draw the PSNR of held-out photographs of the fisheye against the angle to the axis."""
    figure, axes = subplots((6.0, 3.8))
    middles = [(low + high) / 2 for low, high in itertools.pairwise(RINGS)]
    for arm, (_, _, color) in ARMS.items():
        of_seeds = [record["rings"] for record in records if record["arm"] == arm]
        shown = [i for i in range(len(middles)) if all(rings[i] is not None for rings in of_seeds)]
        by_ring = [[rings[i] for rings in of_seeds] for i in shown]
        plot_deviations(axes, [middles[i] for i in shown], by_ring, color=color, label=arm)
    axes.set(title="Held-out photographs of the fisheye", xlabel="degrees off the axis", ylabel="PSNR, dB")
    axes.legend()
    return figure
