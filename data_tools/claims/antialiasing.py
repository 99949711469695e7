"""Claim ``antialiasing/zoom`` (arXiv 2311.16493): scenes trained at one size, seen from farther and from nearer.

Training uses photographs at 1/D of their size. Test views are drawn with the same camera and more or fewer pixels, and
compared with means over blocks of the photographs' pixels; so zooms of more than D have no truth. Each of
Mip-Splatting's two filters is also trained and drawn alone: without the one in space Gaussians are as thin as they
become, and without the one in the image they are dilated as in 3DGS.
"""

import argparse
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, downscale, iterations, scene, seeds
from data_tools.claims.kit.figures import plot_band, show, with_deviation
from minisplat_ref.extensions.antialiasing.model import apply_filters, with_2d_filter, with_3d_filter
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.palette import BLUE, GREEN, GREY, OCHRE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.mechanisms.sampling import shrink_photographs, zoom_camera
from minisplat_ref.rendering import SPLATTING, Renderer, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.compensation import compensation, with_compensation
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import Floats, Gaussians, Model, Scene, View, view_from

IN_SPACE, IN_IMAGE = "3D filter alone", "2D filter alone"
COLORS = {"3dgs-accel": GREY, IN_SPACE: OCHRE, IN_IMAGE: GREEN, "antialiasing": RED, "analytic": BLUE}
FUSED = "antialiasing, fused"
FARTHEST = 8  # times smaller than the training views
SIZE_MIN = 4  # pixels per side of the smallest image that is measured


class Trained(NamedTuple):
    """A population trained at one size, with its renderer."""

    model: Model
    renderer: Renderer
    background: Floats

    def render_at(self, view: View, scale: float) -> Floats:
        """Return the view [H, W, 3] with ``scale`` times the pixels of its camera."""
        request = Request(self.background, backend=CPU)
        return self.renderer.render(self.model, view_from(zoom_camera(view.camera, scale)), request)[0].image


def recipe_of(arm: str, iterations: int) -> Recipe:
    """Return the recipe of one of ``COLORS``."""
    if arm == IN_SPACE:
        return _drawn_by(with_3d_filter(SPLATTING), find_recipe("antialiasing", iterations))
    if arm == IN_IMAGE:
        return _drawn_by(with_2d_filter(SPLATTING), find_recipe("3dgs-accel", iterations))
    return find_recipe(arm, iterations)


def _drawn_by(renderer: Renderer, recipe: Recipe) -> Recipe:
    return recipe._replace(representation=recipe.representation._replace(renderer=renderer))


def train_arm(arm: str, scene: Scene, iterations: int, seed: int) -> Trained:
    """Train a scene with a recipe of ``COLORS``."""
    recipe = recipe_of(arm, iterations)
    state = kit.train_with_progress(scene, recipe, seed, backend=CPU)
    return Trained(state.model, recipe.renderer, scene.background)


def in_viewers(trained: Trained) -> dict[str, Trained]:
    """Return what viewers of 3DGS show of the recipe ``antialiasing``: without its filters, and after ``fuse``."""
    filtered = trained.model.gaussians
    gaussians = Gaussians(*(getattr(filtered, name) for name in Gaussians._fields))
    fused = trained._replace(model=Model(apply_filters(filtered)), renderer=SPLATTING)
    antialiased = fused.model._replace(shared=compensation(0))
    return {
        "antialiasing, filters left out": fused._replace(model=Model(gaussians)),
        FUSED: fused,
        f"{FUSED}, viewer antialiased": fused._replace(model=antialiased, renderer=with_compensation(SPLATTING)),
    }


def blocks(scene: Scene, downscale: int) -> list[int]:
    """Return the sides n of the blocks that are compared, the largest first: from 8 D to 1 in factors of two."""
    camera = scene.test_views[0].camera
    sides = [FARTHEST * downscale]
    while sides[-1] % 2 == 0:
        sides.append(sides[-1] // 2)
    return [n for n in sides if min(camera.width, camera.height) // n >= SIZE_MIN]


def psnrs(found: Trained, scene: Scene, sides: list[int]) -> list[float]:
    """Return the mean PSNR of the test views, dB, for each size of block."""
    views = [view.load() for view in scene.test_views]
    return [
        float(np.mean([kit.psnr_of(found.render_at(view, 1 / n), kit.photograph_at(view, n)) for view in views]))
        for n in sides
    ]


class Measured(NamedTuple):
    """The results."""

    zooms: list[float]
    """Pixels per side, relative to the training views."""
    psnr: dict[str, list[list[float]]]
    """dB by recipe, and by viewer of ``antialiasing``, then seed, then zoom."""
    counts: dict[str, list[int]]
    """Number of Gaussians by recipe, then seed."""
    images: dict[str, Floats]
    """The first test view at the largest zoom by recipe, and the photograph."""


def measure(scene: Scene, downscale: int, iterations: int, seeds: int) -> Measured:
    """Train the scene with every recipe and seed, and measure."""
    small, sides = shrink_photographs(scene, downscale), blocks(scene, downscale)
    psnr: dict[str, list[list[float]]] = {}
    counts: dict[str, list[int]] = {name: [] for name in COLORS}
    view = scene.test_views[0]
    images = {"photograph": kit.photograph_at(view, sides[-1])}
    for seed in range(seeds):
        for name in kit.with_progress(COLORS, f"trainings, seed {seed}"):
            found = train_arm(name, small, iterations, seed)
            shown = {name: found, **(in_viewers(found) if name == "antialiasing" else {})}
            for how, trained in shown.items():
                psnr.setdefault(how, []).append(psnrs(trained, scene, sides))
            counts[name].append(len(found.model.gaussians.means))
            images.setdefault(name, np.clip(found.render_at(view, 1 / sides[-1]), 0, 1))
    return Measured([downscale / n for n in sides], psnr, counts, images)


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure."""
    scene = kit.read_scene(args.scene)
    found = measure(scene, args.downscale, args.iterations, args.seeds)
    rows = []
    for name, runs in found.psnr.items():
        count = np.mean(found.counts[name.partition(",")[0]])
        rows.append([name, f"{count:,.0f}", *(with_deviation(values, 2) for values in zip(*runs, strict=True))])
    table = markdown_table(["recipe", "Gaussians", *(f"x {zoom:g}" for zoom in found.zooms)], rows)
    result = kit.settings_of(args, "scene", "downscale", "iterations", "seeds")
    result |= {"zooms": found.zooms, "psnr": found.psnr, "counts": found.counts}
    text = f"PSNR (dB) of test views: mean over the seeds ± standard deviation\n\n{table}"
    return kit.Report(result, draw(found), text, arms=found.psnr)


def draw(found: Measured) -> Figure:
    """Draw the PSNR over the zoom, and a detail of a view from nearby."""
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1, 1.1))[0]
    axes = left.subplots()
    for name, color in COLORS.items():
        plot_band(axes, found.zooms, np.array(found.psnr[name]), color, name)
    axes.plot(found.zooms, np.mean(found.psnr[FUSED], axis=0), "--", color=COLORS["antialiasing"], label=FUSED)
    axes.set_xscale("log", base=2)
    axes.set_xticks(found.zooms, [f"{zoom:g}" if zoom >= 1 else f"1/{1 / zoom:g}" for zoom in found.zooms])
    axes.set(title="PSNR of test views (dB)", xlabel="pixels per side, relative to the training views")
    axes.legend()
    height, width = found.images["photograph"].shape[:2]
    panels = right.subplots(*((1, 6) if height > width else (2, 3))).ravel()
    for panel, (name, image) in zip(panels, found.images.items(), strict=True):
        middle = image[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4]
        show(panel, middle, f"{name}, x {found.zooms[-1]:g}")
    return figure


CLAIMS = (
    declare(
        "zoom",
        "a scene seen from farther and nearer than in training",
        run,
        *(scene("room"), OUT, downscale(4), iterations(1000), seeds(2)),
    ),
)
