"""The study ``antialiasing/zoom``: scenes trained at one size, seen from farther and from nearer.

Training uses photographs at 1/D of their size. Test views are drawn with the same camera and more or fewer pixels, and
compared with means over blocks of the photographs' pixels; so zooms of more than D have no truth.
"""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from minisplat_ref.backends import CPU
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.shared_studies import psnr_of, shrunk, tidy, with_progress
from minisplat_ref.mechanisms.sampling import block_means, zoom_camera
from minisplat_ref.rendering import Renderer, Request
from minisplat_ref.training.loop import train
from minisplat_ref.types import Floats, Model, Scene, View, view_from

RECIPES = {"3dgs-accel": "#8a8580", "antialiasing": "#d2493f", "analytic": "#35608c"}
FARTHEST = 8  # times smaller than the training views
SIZE_MIN = 4  # pixels per side of the smallest picture that is measured


class Trained(NamedTuple):
    """A population trained at one size, with its renderer."""

    model: Model
    renderer: Renderer
    background: Floats

    def picture(self, view: View, scale: float) -> Floats:
        """Return the view [H, W, 3] with ``scale`` times the pixels of its camera."""
        request = Request(self.background, backend=CPU)
        return self.renderer.render(self.model, view_from(zoom_camera(view.camera, scale)), request)[0].image


def trained(name: str, scene: Scene, iterations: int, seed: int) -> Trained:
    """Train a scene with a recipe."""
    recipe = find_recipe(name, iterations)
    state = train(scene, recipe, seed=seed, backend=CPU)
    return Trained(state.model, recipe.renderer, scene.background)


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
        float(
            np.mean(
                [psnr_of(found.picture(view, 1 / n), block_means(view.image.astype(float) / 255, n)) for view in views]
            )
        )
        for n in sides
    ]


class Measured(NamedTuple):
    """The results of the study."""

    zooms: list[float]
    """Pixels per side, relative to the training views."""
    psnr: dict[str, list[list[float]]]
    """dB by recipe, then seed, then zoom."""
    counts: dict[str, list[int]]
    """Number of Gaussians by recipe, then seed."""
    pictures: dict[str, Floats]
    """The first test view at the largest zoom by recipe, and the photograph."""


def measure(scene: Scene, downscale: int, iterations: int, seeds: int) -> Measured:
    """Train the scene with every recipe and seed, and measure."""
    small, sides = shrunk(scene, downscale), blocks(scene, downscale)
    psnr: dict[str, list[list[float]]] = {name: [] for name in RECIPES}
    counts: dict[str, list[int]] = {name: [] for name in RECIPES}
    view = scene.test_views[0].load()
    pictures = {"photograph": block_means(view.image.astype(float) / 255, sides[-1])}
    for seed in range(seeds):
        for name in with_progress(RECIPES, f"trainings, seed {seed}"):
            found = trained(name, small, iterations, seed)
            psnr[name].append(psnrs(found, scene, sides))
            counts[name].append(len(found.model.gaussians.means))
            pictures.setdefault(name, np.clip(found.picture(view, 1 / sides[-1]), 0, 1))
    return Measured([downscale / n for n in sides], psnr, counts, pictures)


def draw(found: Measured) -> Figure:
    """Draw the PSNR over the zoom, and a detail of a view from nearby."""
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1, 1.1))[0]
    axes = left.subplots()
    for name, color in RECIPES.items():
        values = np.array(found.psnr[name])  # [seeds, zooms]
        axes.fill_between(found.zooms, values.min(axis=0), values.max(axis=0), color=color, alpha=0.25, lw=0)
        axes.plot(found.zooms, values.mean(axis=0), "o-", ms=4, color=color, label=name)
    axes.set_xscale("log", base=2)
    axes.set_xticks(found.zooms, [f"{zoom:g}" if zoom >= 1 else f"1/{1 / zoom:g}" for zoom in found.zooms])
    axes.set(title="PSNR of test views (dB)", xlabel="pixels per side, relative to the training views")
    axes.legend(frameon=False)
    tidy(axes)
    height, width = found.pictures["photograph"].shape[:2]
    panels = right.subplots(*((1, 4) if height > width else (2, 2))).ravel()
    for panel, (name, picture) in zip(panels, found.pictures.items(), strict=True):
        panel.imshow(picture[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4])
        panel.set_title(f"{name}, x {found.zooms[-1]:g}", fontsize=9)
        panel.set(xticks=[], yticks=[])
    return figure


def summarise(found: Measured) -> dict[str, Any]:
    """Return the content of ``result.json``."""
    return {"zooms": found.zooms, "psnr": found.psnr, "counts": found.counts}
