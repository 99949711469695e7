"""``photos``: from a folder of photographs to a page that shows the scene, a film and a report, in one command."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.app.cli.sfm import MATCHINGS
from minisplat_ref.app.cli.steps import do, make_page_and_film, print_results, show_made
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import Commands, HelpFormatter, add_up_argument, integer, positive

if TYPE_CHECKING:
    from minisplat_ref.io.upright import Up

SCENE, RUN = "scene", "run"

DESCRIPTION = """\
Make a 3D model of what photographs show: find their cameras, choose a size that
a laptop trains in minutes, train, and write a page that shows the scene in any
browser, and a film along the photographer's path. It prints the command of each
step, which can be given alone to choose more. DIR will hold:

  scene.html   the scene, to look at offline and to send (convert)
  film.gif     along the path of the cameras (render)
  run/         report.html, point_cloud.ply, metrics.json and more (train)
  scene/       the photographs with their cameras, a COLMAP scene (sfm)

Some 20 to 60 photographs of something that stands still, taken from places a
step apart, with a lot of overlap, are a good start. After an interruption the
same command continues; with another --up it makes page and film again.
"""
EPILOG = """\
examples:
  minisplat-ref photos holiday/fountain
  minisplat-ref photos holiday/fountain --minutes 10 --out fountain"""

MEASURED_FROM = 5  # photographs to train on; with fewer, each counts for more than the measure of one that is held out


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "photos",
        help="your photographs: cameras, training, page, film and report",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("photos", type=Path, metavar="PHOTOS", help="folder of photographs, or a video")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for all of it (default splats/PHOTOS)")
    parser.add_argument("--minutes", type=positive, metavar="T", help="the most minutes to train (default: as needed)")
    parser.add_argument(
        "--downscale",
        type=integer(1),
        metavar="K",
        help="train at 1/K of the scene's width and height (default: of at most 640 pixels)",
    )
    parser.add_argument(
        "--matching",
        choices=MATCHINGS,
        metavar="M",
        help="of photographs with each other: auto (default), exhaustive, or sequential (default of a video); see sfm",
    )
    add_up_argument(parser)
    parser.set_defaults(run=run, needs=("matplotlib",), recommends=True)


def run(args: argparse.Namespace) -> int:
    """Do the remaining steps, and print where their results are."""
    from minisplat_ref.app.runs import run_folder, settings
    from minisplat_ref.app.runs.run_report import write_report
    from minisplat_ref.datasets.video import is_video

    path = args.photos.resolve()
    folder = args.out or Path("splats") / (path.stem if is_video(path) else path.name)
    scene, trained = folder / SCENE, folder / RUN
    if not args.photos.is_dir() and not is_video(args.photos):
        raise InputError(f"{args.photos} is no folder: give the folder of your photographs, or a video")
    if args.downscale is not None and args.photos.is_dir() and not scene.exists():
        _check_downscale(args.photos, args.downscale)
    if not scene.exists():
        matching = () if args.matching is None else ("--matching", args.matching)
        up = () if args.up is None else ("--up", args.up)
        do("sfm", args.photos, "--out", scene, *matching, *up)
    if not run_folder.has_begun(trained):
        factor = _choose_factor(scene) if args.downscale is None else args.downscale
        limit = () if args.minutes is None else ("--minutes", f"{args.minutes:g}")
        few = _options_for_few(scene)
        code = do("train", scene, "--downscale", str(factor), *limit, *few, "--out", trained)
    elif not run_folder.is_finished(trained, settings.load(trained).iterations):
        code = do("train", "--resume", trained)
    else:
        code = 0
    if code != 0:
        return code
    report = trained / run_folder.REPORT
    new_up = None if args.up is None else _find_new_up(trained, args.up)
    if make_page_and_film(trained, folder, *(() if new_up is None else ("--up", args.up))):
        photographs, metrics = settings.load_photographs(settings.load(trained)), trained / run_folder.METRICS
        shown = show_made(trained, report, folder)
        write_report(trained, photographs, run_folder.read_json_object(metrics), shown)
    if new_up is not None:
        settings.record_up(trained, new_up)  # last, so that an interruption before it does all of it again
    print_results(trained, report, folder)
    return 0


def _find_new_up(trained: Path, text: str) -> "Up | None":
    """Return what is up as given, or None where the run has recorded the same."""
    import numpy as np

    from minisplat_ref.app.runs.model_source import open_source
    from minisplat_ref.app.runs.settings import load_up

    given, recorded = open_source(trained, up=text).up, load_up(trained)
    is_same = recorded is not None and np.allclose(given.direction, recorded.direction)
    return None if is_same else given


def _check_downscale(photos: Path, factor: int) -> None:
    """Refuse a factor that leaves next to no pixels, before cameras are looked for."""
    from minisplat_ref.app.cli.sfm import LONG_SIDE
    from minisplat_ref.datasets.photo_files import list_images
    from minisplat_ref.io.images import check_downscale, image_size

    shares = ((size, min(1.0, LONG_SIDE / max(size))) for size in map(image_size, list_images(photos)))
    sizes = [(round(share * size[0]), round(share * size[1])) for size, share in shares]
    check_downscale(photos, sizes, factor)


def _options_for_few(scene: Path) -> tuple[str, ...]:
    """Return options to train on few photographs: hold none out, and if these are too few, too, take another recipe."""
    from minisplat_ref.io import list_scene
    from minisplat_ref.io.scene import TEST_EVERY
    from minisplat_ref.methods.adaptive.numbers import TRAIN_VIEWS_MIN

    listing = list_scene(scene, TEST_EVERY)
    if len(listing.train_photos) >= MEASURED_FROM:
        return ()
    n_photographs = len(listing.names)
    recipe = () if n_photographs >= TRAIN_VIEWS_MIN else ("--recipe", "3dgs-accel")
    print(f"{n_photographs} photographs: all are trained on, and none is left to measure", file=sys.stderr)
    return ("--test-every", "0", *recipe)


def _choose_factor(scene: Path) -> int:
    """Return the factor by which photographs are made smaller for the training."""
    from minisplat_ref.app.runs.proposed_size import comfortable_factor
    from minisplat_ref.io.images import image_size

    sizes = [image_size(file) for file in sorted((scene / "images").rglob("*")) if file.is_file()]
    return comfortable_factor(*max(sizes, key=max))
