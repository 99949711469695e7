"""``view``: a trained scene in the browser."""

import argparse
from pathlib import Path

from minisplat_ref.interface.arguments import (
    VIEWER_PORT,
    Commands,
    HelpFormatter,
    add_background,
    add_renderer_arguments,
    add_up_argument,
    integer,
)

DESCRIPTION = """\
Look at a run (its --out folder), a PLY or a compact file in the browser, drawn
by the renderer of its recipe: coarse while the camera moves, then in full.

The panel chooses what is shown: colours, depth, alpha, transmittance, normals,
importance, the dominant Gaussian of each pixel, the load of each tile, and the
training cameras with their photographs; and makes a film through keyframes.
"""
EPILOG = """\
examples:
  minisplat-ref view runs/fox
  minisplat-ref view point_cloud.ply --port 0 --profile INRIA

It can be reached from this machine only. Over SSH, connect with
ssh -L 8080:127.0.0.1:8080 HOST, and open the address on your side.
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "view",
        help="look at a run or a PLY in the browser",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("input", type=Path, metavar="RUN|PLY", help="run folder, PLY or compact file")
    parser.add_argument(
        "--port", type=integer(0), default=VIEWER_PORT, metavar="P", help=f"0 for a free one (default {VIEWER_PORT})"
    )
    parser.add_argument(
        "--film", type=Path, metavar="FILE", help="that keyframes are written to, .gif or .mp4 (default view.gif)"
    )
    parser.add_argument("--extension", metavar="E", help="draws a file; core is 3DGS (default: what it names)")
    parser.add_argument("--axes", metavar="A", help="of an .spz, such as RUB, RDF (default: what it names, or RUB)")
    parser.add_argument(
        "--environment", type=Path, metavar="FILE", help="other light by latitude and longitude: image or .npy"
    )
    add_background(parser)
    add_up_argument(parser)
    add_renderer_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Serve the scene until Ctrl-C."""
    from minisplat_ref.app.film import check_film
    from minisplat_ref.app.runs.first_use import warn_if_not_kept
    from minisplat_ref.app.runs.model_source import open_source
    from minisplat_ref.app.runs.notices import warn_of_model
    from minisplat_ref.app.viewer.browser import Content, Viewer, address, open_server, serve
    from minisplat_ref.app.viewer.photographs import load_thumbnails
    from minisplat_ref.io.upright import describe_up

    path: Path = args.input
    source = open_source(
        path,
        args.extension,
        args.environment,
        args.axes,
        args.up,
        background=args.background,
        profile=args.profile,
        backend=args.backend,
    )
    warn_of_model(source.trained.model, path)
    warn_if_not_kept(source.trained.backend)
    film = args.film or source.beside("view.gif")
    check_film(film, ())
    photographs = (lambda: load_thumbnails(path)) if source.cameras else None
    server = open_server(args.port, path.resolve().name)
    viewer = Viewer(server, Content(source.trained, source.cameras, photographs, film, source.up.direction))
    if source.cameras:
        print(describe_up(source.up))
    print(f"open {address(server)} in a browser; Ctrl-C ends", flush=True)
    try:
        serve(viewer)
    finally:
        server.stop()
    return 0
