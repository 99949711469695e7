"""The command ``minisplat-ref vr render``: images for an eye that looks at a given pixel."""

import argparse
from pathlib import Path
from typing import Any

FULL = 8.0  # degrees in which every pixel is rendered


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "render",
        help="draw images with fewer rays away from the gaze",
        epilog="example: minisplat-ref vr render runs/vr/point_cloud.ply --gaze 320,240 --out images",
    )
    parser.add_argument("ply", type=Path, metavar="PLY", help="point_cloud.ply of a run")
    parser.add_argument("--gaze", type=gaze, required=True, metavar="X,Y", help="pixel at which the eye looks")
    parser.add_argument("--full", type=float, default=FULL, metavar="DEG", help=f"drawn in full (default {FULL:g})")
    parser.add_argument("--cameras", type=Path, metavar="FILE", help="default cameras.json beside the PLY")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the images")
    parser.set_defaults(run=run)


def gaze(text: str) -> tuple[float, float]:
    """Return x and y of ``X,Y``."""
    try:
        x, y = (float(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a pixel such as 320,240") from None
    return x, y


def run(args: argparse.Namespace) -> int:
    """Render the test views, or all views where there are none, and print the work of each zone.

    Raises
    ------
    InputError
        The PLY or the cameras cannot be used, the gaze lies outside an image, or the folder exists.
    """
    from minisplat_ref.extensions.vr.foveation import Gaze, check_gaze, render_foveated
    from minisplat_ref.extensions.vr.model import BUFFER
    from minisplat_ref.interface.progress import with_progress
    from minisplat_ref.interface.reporting import markdown_table
    from minisplat_ref.io import load_ply, write_image
    from minisplat_ref.io.atomic import making_folder
    from minisplat_ref.io.label import warn_of_another
    from minisplat_ref.io.names import file_names
    from minisplat_ref.io.ply import read_label
    from minisplat_ref.io.run_files import read_cameras
    from minisplat_ref.rendering import Request
    from minisplat_ref.types import Model

    x, y = args.gaze
    look = Gaze(x, y, args.full)
    model = Model(load_ply(args.ply))
    warn_of_another(args.ply, read_label(args.ply), "vr", "vr render")
    views = read_cameras(args.ply, args.cameras)
    views = [view for view in views if view.split == "test"] or views
    for view in views:
        check_gaze(look, view.camera, view.name)
    names = file_names([view.name for view in views])
    with making_folder(args.out) as folder:
        bar = with_progress(views, "rendering")
        rendered = [render_foveated(model, view.camera, Request(), look, BUFFER) for view in bar]
        for name, (image, _) in zip(names, rendered, strict=True):
            write_image(folder / f"{name}.png", image)
    n_pixels = sum(view.camera.width * view.camera.height for view in views)
    rows = []
    for zones in zip(*(zones for _, zones in rendered), strict=True):
        n_samples = sum(zone.n_samples for zone in zones)
        tiles, pairs = (sum(getattr(zone, name) for zone in zones) for name in ("n_tiles", "n_pairs"))
        first, share = zones[0], f"{100 * n_samples / n_pixels:.1f} %"
        rows.append(
            [f"from {first.begins:.1f}", f"1 for {first.block} x {first.block}", f"{tiles:,}", share, f"{pairs:,}"]
        )
    print(markdown_table(["degrees", "rays", "tiles", "rays of all pixels", "pairs"], rows))
    print(f"\n{len(views)} images in {args.out}")
    return 0
