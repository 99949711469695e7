"""The demo's ``report.html``: images of held-out views, depth beside the true depth, curves, and the next steps."""

import os
import platform
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref import __version__
from minisplat_ref.app.reports.commands import command, how_to_call
from minisplat_ref.app.reports.images import (
    Image8,
    colorize,
    depth_image,
    depth_range,
    error_image,
    to_8_bits,
)
from minisplat_ref.app.reports.page import (
    add_caption,
    cards,
    code,
    curves,
    page,
    panel,
    paragraph,
    section,
    slider,
    table,
)
from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.next_steps import live_view, own_photographs
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.progress import read_log
from minisplat_ref.app.runs.report_parts import ERROR_TEXT, training_curves, view_panel
from minisplat_ref.app.runs.run import Outcome
from minisplat_ref.app.runs.scoring import load_trained
from minisplat_ref.datasets.synthetic import SyntheticScene
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import Evaluation
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.types import Floats, Scene

DEPTH_ERROR_RANGE = 0.1  # of the true depth: larger differences are all shown as the brightest colour

VIEWS_TEXT = f"The training never saw these views. {ERROR_TEXT}"
DEPTH_TEXT = """\
Nothing taught the Gaussians depth. Here is the distance that they came to, next to the exact one
of the ray tracer. Near is bright; beside it is the difference relative to the true depth."""
CURVES_TEXT = """\
The number of Gaussians grows at once, by clones of all that matter in an image, and falls when those of
little weight go: the loss jumps with it, and recovers."""


class ViewImages(NamedTuple):
    """One held-out view of the report."""

    name: str
    """Name of the view."""
    caption: str
    """The metrics measured on it."""
    truth: Image8
    """[H, W, 3] photograph, sRGB."""
    render: Image8
    """[H, W, 3] render, sRGB."""
    error: Image8
    """[H, W, 3] image of the difference."""
    true_depth: Floats
    """[H, W] exact camera z, world units; 0 where the view sees nothing."""
    depth: Floats
    """[H, W] rendered camera z, world units; 0 where nothing was hit."""


def view_images(folder: Path, synthetic: SyntheticScene, scene: Scene, evaluation: Evaluation) -> list[ViewImages]:
    """Render the test views with depth."""
    true_depths = {view.name: synthetic.test_depths[i] for i, view in enumerate(synthetic.scene.test_views)}
    trained, images = load_trained(folder), []
    for view, metrics in zip(scene.test_views, evaluation.per_view, strict=True):
        output = trained.render(view, frozenset({"depth"}))
        image = to_8_bits(output.image[..., :3])
        images.append(
            ViewImages(
                name=view.name,
                caption=f"PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.3f}",
                truth=view.image,
                render=image,
                error=error_image(view.image, image),
                true_depth=true_depths[view.name],
                depth=expected_depth(output.image[..., 3], output.alpha),
            )
        )
    return images


def report_html(
    folder: Path,
    scene: Scene,
    settings: Settings,
    outcome: Outcome,
    images: list[ViewImages],
    shown: str,
    total_seconds: float,
) -> str:
    """Return the page as text of one self-contained HTML file."""
    log = read_log(folder / run_folder.LOG)
    metrics = run_folder.read_json_object(folder / run_folder.METRICS)
    evaluation, n_gaussians = outcome.evaluation, metrics["n_gaussians"]
    assert evaluation is not None, "there is a report of what was measured only"
    worst = min(evaluation.per_view, key=lambda view: view.psnr)
    n_train, n_test, n_points = len(scene.train_views), len(scene.test_views), len(scene.points)
    size = f"{scene.train_views[0].camera.width} x {scene.train_views[0].camera.height}"
    introduction = (
        f"A ray tracer took {n_train} photographs of a small room, and {n_test} more that the training never sees."
        f" From the {n_train}, their cameras and {n_points:,} points on the surfaces, {n_gaussians:,} Gaussians were"
        " trained. Everything ran on the CPU."
    )
    key_figures = [
        (f"{evaluation.psnr:.2f} dB", f"PSNR, mean of {n_test} held-out views"),
        (f"{worst.psnr:.2f} dB", f"PSNR of the worst, {worst.name}"),
        (f"{evaluation.ssim:.3f}", "SSIM, mean of the same"),
        (f"{n_gaussians:,}", f"Gaussians, from {n_points:,} points"),
        (f"{outcome.seconds:.0f} s", f"training, {metrics['iterations']} iterations with compilation"),
        (f"{total_seconds:.0f} s", "in all, from scene to report"),
    ]
    rows = [
        ("Scene", f"synthetic room, {n_train} training and {n_test} test views of {size} pixels, in {settings.scene}"),
        (
            "Recipe",
            f"{settings.recipe}, {metrics['iterations']:,} iterations, into which its"
            f" {get_recipe(settings.recipe).iterations:,} are compressed",
        ),
        ("Seed", f"{settings.seed}: the same seed gives the same result"),
        ("Conventions", f"{settings.profile}, the default"),
        ("Backend", f"{settings.backend}: Numba, float32, {os.cpu_count()} cores"),
        ("Memory", "not known here" if metrics["peak_rss_mb"] is None else f"{metrics['peak_rss_mb']:.0f} MB at most"),
        ("Program", f"minisplat_ref {__version__}, Python {platform.python_version()}, {platform.system()}"),
        ("Files", f"{folder.resolve()}: Gaussians, metrics, log, checkpoint, images"),
    ]
    steps = [
        part
        for text, lines in _next_steps(folder, settings.recipe, metrics["iterations"])
        for part in (paragraph(text), code(lines))
    ]
    sections = [
        *([shown] if shown else []),
        cards(key_figures),
        section("Held-out views", paragraph(VIEWS_TEXT), *map(_view_panel, images)),
        section("Depth", paragraph(DEPTH_TEXT), *map(_depth_panel, images)),
        section("How the training went", paragraph(CURVES_TEXT), curves(training_curves(log))),
        section("What was run", table(rows)),
        section("What to try next", *map(paragraph, how_to_call()), *steps),
    ]
    return page("A room, rebuilt from photographs", introduction, sections)


def _view_panel(view: ViewImages) -> str:
    return view_panel(f"{view.name}: {view.caption}", view.truth, view.render, view.error)


def _depth_panel(view: ViewImages) -> str:
    near, far = depth_range(view.true_depth)
    is_seen = view.true_depth > 0  # [H, W]
    relative = np.abs(view.depth - view.true_depth) / np.where(is_seen, view.true_depth, 1.0) * is_seen  # [H, W]
    median = float(np.median(relative[is_seen])) if is_seen.any() else 0.0
    true, rendered = (depth_image(depth, near, far) for depth in (view.true_depth, view.depth))
    difference = colorize(relative, 0.0, DEPTH_ERROR_RANGE, "magma")
    images = [
        slider(true, {f"render, {near:.2f} to {far:.2f} units": rendered}),
        add_caption(difference, "relative difference, 0 to 10 % or more"),
    ]
    return panel(f"{view.name}: median difference {100 * median:.1f} %", images, n_columns=2)


def _next_steps(folder: Path, recipe: str, n_iterations: int) -> list[tuple[str, str]]:
    """Return sentences, each with lines to copy."""
    live, own = live_view(folder), own_photographs()
    longer = ("--recipe", recipe, "--iterations", str(2 * n_iterations))
    return [
        (f"{own.purpose}:", own.line),
        (f"{live.purpose}:", live.line),
        ("Walk around the room:", command("render", folder, "--cameras", "orbit", "--depth")),
        (
            "Train for longer, in a few minutes more:",
            command("train", folder / "scene", *longer, "--out", folder.parent / f"{folder.name}-longer"),
        ),
        (
            "Render the same views with the reference, which is NumPy and made to be read:",
            command("render", folder, "--backend", "reference", "--out", folder / "reference"),
        ),
    ]
