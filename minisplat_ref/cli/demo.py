"""``demo``: makes a scene, trains it, and shows what came out of it in one page."""

import argparse
import itertools
import os
import platform
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.cli.arguments import Commands, HelpFormatter, integer

if TYPE_CHECKING:
    from data_tools.synthetic import SyntheticScene
    from minisplat_ref.cli.report import ViewPictures
    from minisplat_ref.cli.settings import Settings
    from minisplat_ref.cli.training import Outcome
    from minisplat_ref.types import Gaussians, Scene

ITERATIONS = 600
SCENE = {"n_views": 28, "width": 192, "height": 144, "n_points": 4000, "seed": 0, "test_every": 8}
DEFAULT_OUT = "minisplat-demo"
REPORT = "report.html"
N_SHOWN = 3  # test views in the report

DESCRIPTION = f"""\
See the program work, with nothing to download: ray-trace photographs of a
small room, train Gaussians on them ({ITERATIONS} iterations of recipe 3dgs-accel),
measure views that the training never saw, and write report.html: pictures,
depth against the exact depth, curves, and what to try next.

Takes a minute or two on two cores. The folder that it leaves is a run like
those of train, with the photographs in DIR/scene.
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "demo",
        help="see it work: make a scene, train it, write a report",
        description=DESCRIPTION,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"new folder for all of it (default {DEFAULT_OUT})")
    parser.add_argument(
        "--iterations", type=integer(1), default=ITERATIONS, metavar="N", help=f"of the training (default {ITERATIONS})"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Make the scene, train, write the report, and say where it is."""
    from tqdm import tqdm

    from data_tools.synthetic import make_scene
    from data_tools.synthetic.files import write_scene
    from minisplat_ref.cli import run_folder
    from minisplat_ref.cli.scoring import summary
    from minisplat_ref.cli.settings import Settings, load_photographs
    from minisplat_ref.cli.training import run_training
    from minisplat_ref.constants import GSPLAT_MAIN
    from minisplat_ref.recipes import get_recipe
    from minisplat_ref.train import initial_state

    start = time.perf_counter()
    folder = args.out or _first_free(Path(DEFAULT_OUT))
    run_folder.check_free(folder)
    synthetic = make_scene("room", **SCENE, progress=partial(tqdm, desc="ray-tracing", unit="view"))
    write_scene(synthetic, folder / "scene", {"scene": "room", **SCENE})
    settings = Settings(
        scene=str((folder / "scene").resolve()),
        downscale=1,
        test_every=SCENE["test_every"],
        undistort=False,
        recipe="3dgs-accel",
        schedule_iterations=args.iterations,
        iterations=args.iterations,
        seed=0,
        profile=GSPLAT_MAIN.name,
        backend="cpu",
    )
    scene = load_photographs(settings)
    recipe = get_recipe(settings.recipe, settings.schedule_iterations)
    state = initial_state(scene, recipe, settings.seed)
    outcome = run_training(folder, scene, settings, recipe, state)
    pictures = _pictures(synthetic, scene, state.gaussians, settings, outcome)
    _write_report(folder, scene, settings, outcome, pictures, time.perf_counter() - start)
    if not outcome.is_complete:
        print(
            f"minisplat-ref: stopped after {state.step} iterations, report of these: {folder / REPORT}", file=sys.stderr
        )
        return 130
    print(f"{summary(outcome.evaluation)}, {len(state.gaussians.means):,} Gaussians")
    print(f"open {(folder / REPORT).resolve()}")
    return 0


def _first_free(folder: Path) -> Path:
    """Return the folder, or with the first number behind it that no earlier demo has taken."""
    names = itertools.chain([folder], (folder.with_name(f"{folder.name}-{n}") for n in itertools.count(2)))
    return next(name for name in names if not name.exists())


def _pictures(
    synthetic: "SyntheticScene", scene: "Scene", gaussians: "Gaussians", settings: "Settings", outcome: "Outcome"
) -> "list[ViewPictures]":
    """Render the first test views with depth."""
    import numpy as np

    from minisplat_ref.backends import get_backend
    from minisplat_ref.cli.pictures import error_picture, to_picture
    from minisplat_ref.cli.report import ViewPictures
    from minisplat_ref.constants import DEPTH_ALPHA_MIN, PROFILES
    from minisplat_ref.render import render

    true_depths = {view.name: synthetic.test_depths[i] for i, view in enumerate(synthetic.scene.test_views)}
    pictures = []
    for view, metrics in zip(scene.test_views[:N_SHOWN], outcome.evaluation.per_view, strict=False):
        output, _ = render(
            gaussians,
            view.camera,
            background=scene.background,
            conventions=PROFILES[settings.profile],
            backend=get_backend(settings.backend),
            with_depth=True,
        )
        image = to_picture(output.image[..., :3])
        pictures.append(
            ViewPictures(
                name=view.name,
                caption=f"PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.3f}",
                truth=view.image,
                render=image,
                error=error_picture(view.image, image),
                true_depth=true_depths[view.name],
                depth=output.image[..., 3] / np.maximum(output.alpha, DEPTH_ALPHA_MIN),
            )
        )
    return pictures


def _write_report(
    folder: Path,
    scene: "Scene",
    settings: "Settings",
    outcome: "Outcome",
    pictures: "list[ViewPictures]",
    total_seconds: float,
) -> None:
    from minisplat_ref import __version__
    from minisplat_ref.cli import run_folder
    from minisplat_ref.cli.progress import read_log
    from minisplat_ref.cli.report import Report, report_html

    log = read_log(folder / run_folder.LOG)
    metrics = run_folder.read_json_object(folder / run_folder.METRICS)
    evaluation, n_gaussians = outcome.evaluation, metrics["n_gaussians"]
    n_train, n_test, n_points = len(scene.train_views), len(scene.test_views), len(scene.points)
    size = f"{SCENE['width']} x {SCENE['height']}"
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
        ("Recipe", f"{settings.recipe}, all milestones scaled to {settings.schedule_iterations} iterations"),
        ("Seed", f"{settings.seed}: the same seed gives the same result"),
        ("Conventions", f"{settings.profile}, the default"),
        ("Backend", f"{settings.backend}: Numba, float32, {os.cpu_count()} cores"),
        ("Memory", "not known here" if metrics["peak_rss_mb"] is None else f"{metrics['peak_rss_mb']:.0f} MB at most"),
        ("Program", f"minisplat_ref {__version__}, Python {platform.python_version()}, {platform.system()}"),
        ("Files", f"{folder.resolve()}: Gaussians, measures, log, checkpoint, pictures"),
    ]
    next_steps = [
        ("Walk around the room:", f"minisplat-ref render {folder} --cameras orbit --depth"),
        (
            "Train the same room for longer:",
            f"minisplat-ref train {folder / 'scene'} --iterations 3000 --out runs/room",
        ),
        (
            "Let the reference, which is NumPy and can be read, render the same views:",
            f"minisplat-ref render {folder} --backend reference --out {folder / 'reference'}",
        ),
        (
            "Train on your own photographs: find their cameras, then train:",
            "python -m data_tools.sfm PHOTOS --out SCENE\nminisplat-ref train SCENE --out runs/mine",
        ),
    ]
    title = "A room, rebuilt from photographs"
    page = report_html(Report(title, introduction, figures, pictures, log, rows, next_steps))
    (folder / REPORT).write_text(page, encoding="utf-8")
