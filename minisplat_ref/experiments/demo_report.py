"""What the demo's report says: pictures of held-out views, key figures, what was run, what to try next."""

import os
import platform
import shutil
import sys
from pathlib import Path

from minisplat_ref import __version__
from minisplat_ref.datasets.synthetic import SyntheticScene
from minisplat_ref.experiments import run_folder
from minisplat_ref.experiments.pictures import error_picture, to_picture
from minisplat_ref.experiments.progress import read_log
from minisplat_ref.experiments.report import Report, ViewPictures
from minisplat_ref.experiments.run import Outcome
from minisplat_ref.experiments.scoring import load_trained
from minisplat_ref.experiments.settings import Settings
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.types import Scene

N_SHOWN = 3  # test views


def view_pictures(folder: Path, synthetic: SyntheticScene, scene: Scene, outcome: Outcome) -> list[ViewPictures]:
    """Render the first test views with depth."""
    true_depths = {view.name: synthetic.test_depths[i] for i, view in enumerate(synthetic.scene.test_views)}
    trained, pictures = load_trained(folder), []
    for view, metrics in zip(scene.test_views[:N_SHOWN], outcome.evaluation.per_view, strict=False):
        output = trained.render(view, frozenset({"depth"}))
        image = to_picture(output.image[..., :3])
        pictures.append(
            ViewPictures(
                name=view.name,
                caption=f"PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.3f}",
                truth=view.image,
                render=image,
                error=error_picture(view.image, image),
                true_depth=true_depths[view.name],
                depth=expected_depth(output.image[..., 3], output.alpha),
            )
        )
    return pictures


def demo_report(
    folder: Path,
    scene: Scene,
    settings: Settings,
    outcome: Outcome,
    pictures: list[ViewPictures],
    total_seconds: float,
) -> Report:
    """Return what the page says about the run."""
    log = read_log(folder / run_folder.LOG)
    metrics = run_folder.read_json_object(folder / run_folder.METRICS)
    evaluation, n_gaussians = outcome.evaluation, metrics["n_gaussians"]
    n_train, n_test, n_points = len(scene.train_views), len(scene.test_views), len(scene.points)
    size = f"{scene.train_views[0].camera.width} x {scene.train_views[0].camera.height}"
    introduction = (
        f"A ray tracer took {n_train} photographs of a small room, and {n_test} more that the training never sees."
        f" From the {n_train}, their cameras and {n_points:,} points on the surfaces, {n_gaussians:,} Gaussians were"
        " trained. Everything ran on the CPU."
    )
    figures = [
        (f"{evaluation.psnr:.2f} dB", f"PSNR, mean of {n_test} held-out views"),
        (f"{evaluation.ssim:.3f}", "SSIM, mean of the same"),
        (f"{n_gaussians:,}", f"Gaussians, from {n_points:,} points"),
        (f"{outcome.seconds:.0f} s", f"training, {metrics['iterations']} iterations with compilation"),
        (f"{total_seconds:.0f} s", "in all, from scene to report"),
    ]
    rows = [
        ("Scene", f"synthetic room, {n_train} training and {n_test} test views of {size} pixels, in {settings.scene}"),
        (
            "Recipe",
            f"{settings.recipe}, the first {metrics['iterations']} of its {settings.schedule_iterations:,} iterations",
        ),
        ("Seed", f"{settings.seed}: the same seed gives the same result"),
        ("Conventions", f"{settings.profile}, the default"),
        ("Backend", f"{settings.backend}: Numba, float32, {os.cpu_count()} cores"),
        ("Memory", "not known here" if metrics["peak_rss_mb"] is None else f"{metrics['peak_rss_mb']:.0f} MB at most"),
        ("Program", f"minisplat_ref {__version__}, Python {platform.python_version()}, {platform.system()}"),
        ("Files", f"{folder.resolve()}: Gaussians, measures, log, checkpoint, pictures"),
    ]
    title = "A room, rebuilt from photographs"
    return Report(title, introduction, figures, pictures, log, rows, _next_steps(folder, metrics["iterations"]))


def _next_steps(folder: Path, n_iterations: int) -> list[tuple[str, str]]:
    """Return sentences with the command to copy, which runs from the folder in which the demo was started."""
    is_installed = shutil.which("minisplat-ref") is not None  # otherwise the environment has not been activated
    python = "python" if is_installed else os.path.relpath(sys.executable)
    program = "minisplat-ref" if is_installed else f"{python} -m minisplat_ref"
    return [
        ("Walk around the room:", f"{program} render {folder} --cameras orbit --depth"),
        ("Train on, for a few minutes more:", f"{program} train --resume {folder} --iterations {2 * n_iterations}"),
        (
            "Render the same views with the reference, which is NumPy and made to be read:",
            f"{program} render {folder} --backend reference --out {folder / 'reference'}",
        ),
        (
            "Train on your own photographs; the first command finds out where they were taken from:",
            f"{python} -m minisplat-ref sfm PHOTOS --out SCENE\n{program} train SCENE --out runs/mine",
        ),
    ]
