"""``render``: images of a trained scene from a run's cameras, an orbit or a camera file."""

import argparse
import math
import re
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import (
    Commands,
    HelpFormatter,
    add_background,
    add_renderer_arguments,
    add_up_argument,
    add_worker_arguments,
    drop_workers,
    integer,
    positive,
)
from minisplat_ref.interface.progress import with_progress

if TYPE_CHECKING:
    from minisplat_ref.app.runs.cluster import Workers
    from minisplat_ref.app.runs.model_source import Source
    from minisplat_ref.io.viewpoints import Viewpoint

DESCRIPTION = """\
Render a run (its --out folder), a PLY or a compact file (.spz and others) that
any program wrote. Cameras, by --cameras:
  test, train, all   those of the run (default test)
  orbit              along the training cameras, there and back unless they
                     stand all around; a circle around a PLY (its default)
  FILE.json          cameras.json of 3DGS (docs/GUIDE.md), camera_path.json,
                     transforms.json, SuperSplat's poses, base_cam.json
  FOLDER             of a COLMAP model
"""
EPILOG = """\
examples:
  minisplat-ref render runs/fox --cameras orbit --film fox.gif
  minisplat-ref render runs/fox --cameras orbit --arc 360 --frames 120 --depth
  minisplat-ref render point_cloud.ply --size 640x360 --profile INRIA
"""
RUN_CAMERAS = ("test", "train", "all")
LIST = "pictures.json"  # what a rendering has left in its folder, so that the next one can take it away
ENDS = (".png", "_depth.png", "_depth.npy", "_albedo.png", "_metallic.png", "_roughness.png", "_normal.png")
MAPS = ("albedo", "metallic", "roughness", "normal")
PART = 25  # images that a worker renders before it is given others
ORBIT_SIZE = (640, 480)  # pixels, unless the run has another size


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "render",
        help="render a run or a PLY to images",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("input", type=Path, metavar="DIR|PLY", help="run folder, PLY or compact file")
    parser.add_argument("--cameras", metavar="WHICH", help="see above")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to write (default: beside the input)")
    parser.add_argument(
        "--time", type=_moment, metavar="T", help="render every image at time T (default: its camera's)"
    )
    parser.add_argument("--depth", action="store_true", help="also NAME_depth.npy (camera z) and its image")
    parser.add_argument(
        "--map", choices=MAPS, metavar="MAP", help="also NAME_MAP.png: albedo, metallic, roughness, normal"
    )
    parser.add_argument(
        "--environment", type=Path, metavar="FILE", help="other light by latitude and longitude: image or .npy"
    )
    parser.add_argument("--extension", metavar="E", help="draws a file; core is 3DGS; --axes A: of an .spz")
    parser.add_argument("--axes", metavar="A", help=argparse.SUPPRESS)
    parser.add_argument(
        "--frames", type=integer(1), default=60, metavar="N", help="number of images of an orbit (default 60)"
    )
    parser.add_argument("--arc", type=_arc, metavar="A", help="degrees of an orbit (default: what was photographed)")
    parser.add_argument(
        "--size",
        type=_size,
        metavar="WxH",
        help="where cameras have none (default: the run's, or 640x480)",
    )
    parser.add_argument(
        "--film", type=Path, metavar="FILE", help="also a film: .gif, .mp4 (imageio[ffmpeg]); --fps F (25)"
    )
    parser.add_argument("--fps", type=positive, default=25.0, metavar="F", help=argparse.SUPPRESS)
    add_worker_arguments(parser, "in N processes at once; --cluster ADDRESS: elsewhere", argparse.SUPPRESS)
    parser.add_argument("--part", type=_part, help=argparse.SUPPRESS)  # A:B of the images, which a worker is told
    add_background(parser)
    add_up_argument(parser)
    add_renderer_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Render every camera to a PNG; what an earlier rendering has left in the folder goes."""
    import numpy as np

    from minisplat_ref import memory
    from minisplat_ref.app.film import check_film
    from minisplat_ref.app.reports.images import depth_image, depth_range
    from minisplat_ref.app.runs.cluster import Workers
    from minisplat_ref.app.runs.first_use import warn_if_not_kept
    from minisplat_ref.app.runs.model_source import open_source
    from minisplat_ref.app.runs.notices import warn_of_model
    from minisplat_ref.io import write_image
    from minisplat_ref.io.names import file_names
    from minisplat_ref.mechanisms.gbuffer.maps import map_image
    from minisplat_ref.reference.depth import expected_depth
    from minisplat_ref.types import view_from

    source = open_source(
        args.input,
        args.extension,
        args.environment,
        args.axes,
        args.up,
        background=args.background,
        profile=args.profile,
        backend=args.backend,
    )
    warn_of_model(source.trained.model, args.input)
    warn_if_not_kept(source.trained.backend)
    views = _choose_views(args, source)
    out: Path = args.out or source.beside("views")
    largest = max((view.camera for view in views), key=lambda camera: camera.width * camera.height)
    memory.check_render_size(largest.width, largest.height, args.depth)
    if args.film is not None and args.part is None:
        check_film(args.film, [(view.camera.width, view.camera.height) for view in views])
    names = file_names([view.name for view in views])
    wants = frozenset({"depth"} if args.depth else ()) | frozenset({args.map} if args.map else ())
    channels = _channels(args, source, wants)
    part = slice(None) if args.part is None else slice(*args.part)
    outputs = (
        source.trained.render(view_from(view.camera, time=view.time if args.time is None else args.time), wants)
        for view in views[part]
    )
    first = next(outputs)  # what cannot be rendered is refused before the folder is touched
    if args.part is None:
        _make_room(out, names)
    workers = Workers(args.workers, args.cluster)
    if workers.is_used:
        return _hand_out(workers, args, out, names)
    rendered = with_progress(chain([first], outputs), "rendering", "views", total=len(views[part]))
    for name, output in zip(names[part], rendered, strict=True):
        write_image(out / f"{name}.png", output.image[..., :3])
        if args.depth:
            sums = output.image[..., channels["depth"].start]
            depth = source.frame.unit * expected_depth(sums, output.alpha)  # [H, W] as in the files
            np.save(out / f"{name}_depth.npy", depth)
            write_image(out / f"{name}_depth.png", depth_image(depth, *depth_range(depth)))
        if args.map:
            shown = map_image(args.map, output.image[..., channels[args.map]], output.alpha)
            write_image(out / f"{name}_{args.map}.png", shown)
    if args.part is None:
        _finish(args, out, names)
    return 0


def _finish(args: argparse.Namespace, out: Path, names: Sequence[str]) -> None:
    """Print where the images are, and make the film of them."""
    from minisplat_ref.app.film import write_film

    print(f"{len(names)} images in {out}")
    if args.film is not None:
        write_film(args.film, [out / f"{name}.png" for name in names], args.fps)
        print(f"film: {args.film}")


def _hand_out(workers: "Workers", args: argparse.Namespace, out: Path, names: Sequence[str]) -> int:
    """Have the images rendered by workers, some by each command; return the exit code."""
    from minisplat_ref.app.runs.cluster import carry_out_all
    from minisplat_ref.app.runs.worker import Job

    words = [*drop_workers(args.words), "--out", str(out)]
    parts = [f"{start}:{min(start + PART, len(names))}" for start in range(0, len(names), PART)]
    jobs = [Job(f"images {part}", _words_of_part, (words, part)) for part in parts]
    inputs = [path for path in (args.input, args.environment) if path is not None]
    code = carry_out_all(workers, jobs, out, inputs)
    if code == 0:
        _finish(args, out, names)
    return code


def _words_of_part(words: Sequence[str], part: str) -> list[str]:
    return [*words, "--part", part]


def _channels(args: argparse.Namespace, source: "Source", wants: frozenset[str]) -> dict[str, slice]:
    """Return the rendered channels, by name.

    Raises
    ------
    InputError
        The renderer has no map of that name.
    """
    renderer = source.trained.renderer
    channels = renderer.channels(wants)
    if args.map and args.map not in channels:
        raise InputError(f"{args.input} has no map {args.map}: it is drawn as {renderer.name}; leave --map out")
    return channels


def _make_room(out: Path, names: Sequence[str]) -> None:
    """Make the folder, and remove the images of an earlier rendering, which it lists; others are not touched.

    Raises
    ------
    InputError
        There are images that no rendering has listed and this one would not replace.
    """
    from minisplat_ref.app.runs import run_folder

    listed = run_folder.read_json_object(out / LIST).get("pictures") if (out / LIST).exists() else []
    if not isinstance(listed, list):
        raise InputError(f"{out / LIST} does not list the images of a rendering: give another --out")
    found = {path.name for path in out.glob("*.png")} if out.is_dir() else set()
    strange = sorted(found - {f"{name}{end}" for name in (*listed, *names) for end in ENDS})
    if strange:
        raise InputError(
            f"{out} holds images other than those of a rendering, such as {strange[0]}: give another --out, or remove"
            " them"
        )
    run_folder.create(out)
    for path in (out / f"{name}{end}" for name in listed for end in ENDS):
        if path.parent == out:
            path.unlink(missing_ok=True)
    run_folder.write_json(out / LIST, {"pictures": list(names)})


def _choose_views(args: argparse.Namespace, source: "Source") -> "list[Viewpoint]":
    from minisplat_ref.app.runs.model_source import place_viewpoints
    from minisplat_ref.io import orbits
    from minisplat_ref.io.camera_files import read_cameras
    from minisplat_ref.io.upright import describe_up

    which: str = args.cameras or ("test" if any(view.split == "test" for view in source.cameras) else "orbit")
    if which == "orbit":
        like = source.cameras[0].camera if source.cameras else None
        width, height = args.size or ((like.width, like.height) if like else ORBIT_SIZE)
        followed = [view for view in source.cameras if view.split != "test"] or source.cameras
        means = source.trained.model.gaussians.means
        if source.cameras:
            print(describe_up(source.up))
        return orbits.orbit(means, followed, args.frames, width, height, args.arc, source.up.direction)
    if which not in RUN_CAMERAS:
        like = source.cameras[0].camera if source.cameras else None
        size = args.size or ((like.width, like.height) if like else ORBIT_SIZE)
        return place_viewpoints(read_cameras(Path(which), size), source.frame)
    if not source.cameras:
        raise InputError(f"--cameras {which} needs a run folder: give --cameras orbit or a JSON file with {args.input}")
    views = [view for view in source.cameras if which in ("all", view.split)]
    if not views:
        raise InputError(f"{args.input} has no {which} views: give --cameras train, orbit or a JSON file")
    return views


def _moment(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a time, a finite number")
    return value


def _arc(text: str) -> float:
    try:
        degrees = float(text)
    except ValueError:
        degrees = 0.0
    if not 0 < degrees <= 360:
        raise argparse.ArgumentTypeError(f"{text!r} is not an angle above 0 and at most 360 degrees")
    return math.radians(degrees)


def _part(text: str) -> tuple[int, int]:
    start, _, stop = text.partition(":")
    if not (start.isdecimal() and stop.isdecimal() and int(start) < int(stop)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a part of the images such as 0:25")
    return int(start), int(stop)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d*)[xX]([1-9]\d*)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a width and height in pixels such as 640x480")
    return int(match[1]), int(match[2])
