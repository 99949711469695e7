"""Claim ``multi-scale/downscale`` (Multi-Scale 3DGS, arXiv 2311.17089): a trained scene in smaller and smaller images.

The truth at 1/n of the size is the mean over blocks of n x n pixels of the held-out photographs. Beside the error the
claim counts the work: pairs of a Gaussian and a tile, which are sorted, and hits, which are blended. Levels are
compared with the compensation of opacities, on the same Gaussians and on those of a training with it.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, downscale, iterations, scene, seeds
from data_tools.claims.kit.figures import plot_band, show, with_deviation
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.multi_scale.model import LEVELS, Plan, add_levels, level_zero
from minisplat_ref.extensions.multi_scale.recipe import COVERAGE_MIN, finest_densities
from minisplat_ref.interface.palette import BLUE, BROWN, GREEN, GREY, OCHRE, PURPLE, RED, TEAL
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.mechanisms.sampling import zoom_camera
from minisplat_ref.rendering import SPLATTING, Renderer, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.types import Floats, Model, Scene, view_from

BLOCKS = (1, 2, 4, 8, 16)
SIZE_MIN = 4  # pixels per side of the smallest image that is measured
PLANS = {"levels 2": Plan(2, 4, COVERAGE_MIN), "levels 4": Plan(4, 2, COVERAGE_MIN)}
EARLY = 4  # cells are divided by this, so that coarse Gaussians appear while their cells are 4 pixels wide
COMPENSATED = GSPLAT_MAIN._replace(is_antialiased=True)
COLORS = dict(
    zip(
        ("3dgs", "compensated", "trained compensated", *PLANS, "levels 4, compensated", "too early", "trained"),
        (GREY, OCHRE, BROWN, GREEN, BLUE, TEAL, PURPLE, RED),
        strict=True,
    )
)


class Variant(NamedTuple):
    """A population of the scene, and how it is drawn."""

    gaussians: Any
    renderer: Renderer
    conventions: Conventions = GSPLAT_MAIN


class Figures(NamedTuple):
    """Quality and work of one variant at one size, as means over the test views."""

    psnr: float
    n_pairs: float
    n_hits: float


def variants(scene: Scene, iterations: int, seed: int) -> dict[str, Variant]:
    """Train the scene without and with levels, and build levels for the former; return all variants by name."""
    plain, compensated = (
        kit.train_with_progress(
            scene, find_recipe("3dgs", iterations), seed, backend=CPU, conventions=conventions
        ).gaussians
        for conventions in (GSPLAT_MAIN, COMPENSATED)
    )
    zero = level_zero(plain, np.random.default_rng(0))
    densities = finest_densities(plain.means, [view.camera for view in scene.train_views])
    built = {name: add_levels(zero, densities, plan, GSPLAT_MAIN) for name, plan in PLANS.items()}
    early = built["levels 4"]._replace(cells=built["levels 4"].cells / EARLY)
    recipe = configure(find_recipe("multi-scale", iterations), factor=4, n_levels=2)
    trained = kit.train_with_progress(scene, recipe, seed, backend=CPU).gaussians
    return {
        "3dgs": Variant(plain, SPLATTING),
        "compensated": Variant(plain, SPLATTING, COMPENSATED),
        "trained compensated": Variant(compensated, SPLATTING, COMPENSATED),
        **{name: Variant(gaussians, LEVELS.renderer) for name, gaussians in built.items()},
        "levels 4, compensated": Variant(built["levels 4"], LEVELS.renderer, COMPENSATED),
        "too early": Variant(early, LEVELS.renderer),
        "trained": Variant(trained, LEVELS.renderer),
    }


def render_reduced(variant: Variant, scene: Scene, i: int, n: int) -> Any:
    """Return test view ``i`` at 1/n of its size, with blend statistics."""
    camera = zoom_camera(scene.test_views[i].camera, 1 / n)
    request = Request(scene.background, conventions=variant.conventions, backend=CPU, wants=frozenset({"stats"}))
    return variant.renderer.render(Model(variant.gaussians), view_from(camera), request)[0]


def figures(variant: Variant, scene: Scene, n: int) -> Figures:
    """Measure the test views at 1/n of their size."""
    rows = []
    for i, view in enumerate(scene.test_views):
        output = render_reduced(variant, scene, i, n)
        rows.append(
            (kit.psnr_of(output.image, kit.photograph_at(view, n)), output.n_pairs, output.stats.hit_count.sum())
        )
    return Figures(*(float(value) for value in np.mean(rows, axis=0)))


class Measured(NamedTuple):
    """The results."""

    blocks: list[int]
    figures: dict[str, list[list[Figures]]]
    """Figures by variant, then seed, then size of block."""
    counts: dict[str, list[int]]
    """Number of Gaussians of all levels by variant, then seed."""
    images: dict[str, Floats]
    """The first test view at a quarter of its size by variant, and the photograph."""


def measure(scene: Scene, iterations: int, seeds: int) -> Measured:
    """Train with every seed, and measure every variant at every size."""
    camera = scene.test_views[0].camera
    blocks = [n for n in BLOCKS if min(camera.width, camera.height) // n >= SIZE_MIN]
    found: dict[str, list[list[Figures]]] = {name: [] for name in COLORS}
    counts: dict[str, list[int]] = {name: [] for name in COLORS}
    shown = min(4, blocks[-1])
    images = {"photograph": kit.photograph_at(scene.test_views[0], shown)}
    for seed in range(seeds):
        for name, variant in kit.with_progress(variants(scene, iterations, seed).items(), f"measuring, seed {seed}"):
            found[name].append([figures(variant, scene, n) for n in blocks])
            counts[name].append(len(variant.gaussians.means))
            images.setdefault(name, np.clip(render_reduced(variant, scene, 0, shown).image, 0, 1))
    return Measured(blocks, found, counts, images)


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure."""
    scene = kit.read_scene(args.scene, args.downscale)
    found = measure(scene, args.iterations, args.seeds)
    rows = []
    for name, runs in found.figures.items():
        psnrs, pairs, hits = np.moveaxis(np.array(runs), -1, 0)  # [seeds, blocks] each
        work = zip(psnrs.T.tolist(), pairs.mean(axis=0), hits.mean(axis=0), strict=True)
        cells = [f"{with_deviation(p, 2)}, {n / 1e3:.1f}, {h / 1e3:.0f}" for p, n, h in work]
        rows.append([name, f"{np.mean(found.counts[name]):,.0f}", *cells])
    table = markdown_table(["", "Gaussians", *_sizes(found)], rows)
    by_name = {
        name: {key: [[getattr(row, key) for row in rows] for rows in runs] for key in Figures._fields}
        for name, runs in found.figures.items()
    }
    result = kit.settings_of(args, "scene", "downscale", "iterations", "seeds")
    result |= {"blocks": found.blocks, "counts": found.counts, "figures": by_name}
    text = "PSNR (dB) of test views, thousands of pairs and of hits per view; means over the seeds, and their deviation"
    return kit.Report(result, draw(found), f"{text}\n\n{table}", arms=by_name)


def _sizes(found: Measured) -> list[str]:
    return ["1", *(f"1/{n}" for n in found.blocks[1:])]


def draw(found: Measured) -> Figure:
    """Draw PSNR and hits over the size, and a small image of each variant."""
    figure = Figure(figsize=(11, 6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.6, 1))[:, 0]
    left, right = upper.subplots(1, 2)
    for name, color in COLORS.items():
        values = np.array(found.figures[name])  # [seeds, blocks, 3]
        plot_band(left, found.blocks, values[..., 0], color, name)
        plot_band(right, found.blocks, values[..., 2], color, name)
    for axes, title in ((left, "PSNR of test views (dB)"), (right, "blended hits per view")):
        axes.set_xscale("log", base=2)
        axes.set_xticks(found.blocks, _sizes(found))
        axes.set(title=title, xlabel="size of the image")
    right.set_yscale("log")
    left.legend()
    for panel, (name, image) in zip(lower.subplots(1, len(found.images)), found.images.items(), strict=True):
        show(panel, image, name.replace(", ", ",\n"))
    return figure


CLAIMS = (
    declare(
        "downscale",
        "a trained scene in smaller images, with and without levels",
        run,
        *(scene("room"), OUT, downscale(), iterations(1000, minimum=10), seeds(2)),
    ),
)
