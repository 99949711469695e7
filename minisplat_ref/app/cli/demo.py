"""``demo``: makes a scene, trains it, and shows the result in a page and a report."""

import argparse
import itertools
import sys
import time
from functools import partial
from pathlib import Path

from minisplat_ref.app.cli.steps import make_page_and_film, print_results, show_made
from minisplat_ref.interface.arguments import Commands, HelpFormatter, integer
from minisplat_ref.interface.progress import with_progress

SCENE = {"n_views": 28, "width": 192, "height": 144, "n_points": 8000, "seed": 0, "test_every": 8}
RECIPE = "mini-splatting2"
ITERATIONS = 1000  # fit into two minutes with compilation; more gain nothing on so few pixels
DEFAULT_OUT = "minisplat-demo"

DESCRIPTION = f"""\
See the program work, with nothing to download: ray-trace photographs of a
small room, train Gaussians on them ({ITERATIONS} iterations of {RECIPE},
all of its schedule), and measure views that the training never saw. It writes
scene.html, which shows the room in any browser, film.gif, and report.html:
images, depth against the exact depth, curves, and what to try next.

Takes a minute or two on two cores. The folder that it leaves is a run like
those of train, with the photographs in DIR/scene.
"""
EPILOG = """\
example:
  minisplat-ref demo --out demo"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "demo",
        help="see it work: make a scene, train it, write a report",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"new folder for all of it (default {DEFAULT_OUT})")
    parser.add_argument(
        "--iterations", type=integer(1), default=ITERATIONS, metavar="N", help=f"of the training (default {ITERATIONS})"
    )
    parser.set_defaults(run=run, needs=("matplotlib",), recommends=True)


def run(args: argparse.Namespace) -> int:
    """Make the scene, train, write the report, and print where it is."""
    from minisplat_ref.app.runs import run_folder
    from minisplat_ref.app.runs.demo_report import report_html, view_images
    from minisplat_ref.app.runs.first_use import compile_kernels
    from minisplat_ref.app.runs.options import Settings
    from minisplat_ref.app.runs.preparation import prepare
    from minisplat_ref.app.runs.run import run_training
    from minisplat_ref.app.runs.scoring import summary
    from minisplat_ref.datasets.synthetic import make_scene
    from minisplat_ref.datasets.synthetic.files import write_scene
    from minisplat_ref.training.interruption import terminated_like_interrupted

    start = time.perf_counter()
    folder = args.out or _first_free(Path(DEFAULT_OUT))
    run_folder.check_free(folder)
    synthetic = make_scene("room", **SCENE, progress=partial(with_progress, description="ray-tracing", unit="views"))
    write_scene(synthetic, folder / "scene", {"scene": "room", **SCENE})
    settings = Settings(
        scene=str((folder / "scene").resolve()),
        test_every=SCENE["test_every"],
        recipe=RECIPE,
        schedule_iterations=args.iterations,
        iterations=args.iterations,
    )
    training = prepare(folder, settings)
    scene, state = training.scene, training.state
    compile_kernels(settings.backend)
    with terminated_like_interrupted(), run_folder.hold_folder(folder):
        outcome = run_training(training)
    if outcome.evaluation is None:
        print(f"minisplat-ref: stopped; to continue: minisplat-ref train --resume {folder}", file=sys.stderr)
        return 130
    report = folder / run_folder.REPORT
    shown = ""
    if outcome.is_complete:
        make_page_and_film(folder, folder)
        shown = show_made(folder, report, folder)
    images = view_images(folder, synthetic, scene, outcome.evaluation)
    page = report_html(folder, scene, settings, outcome, images, shown, time.perf_counter() - start)
    report.write_text(page, encoding="utf-8")
    if not outcome.is_complete:
        print(f"minisplat-ref: stopped after {state.step} iterations, report of these: {report}", file=sys.stderr)
        return 130
    print(f"{summary(outcome.evaluation)}, {len(state.gaussians.means):,} Gaussians")
    print_results(folder, report, folder)
    return 0


def _first_free(folder: Path) -> Path:
    """Return the folder, or with the first number behind it that no earlier demo has taken."""
    names = itertools.chain([folder], (folder.with_name(f"{folder.name}-{n}") for n in itertools.count(2)))
    return next(name for name in names if not name.exists())
