"""The command ``minisplat-ref rays render``: a trained scene among lights, mirrors, glass and meshes."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.rays import surroundings
from minisplat_ref.extensions.rays.lights import World, shade
from minisplat_ref.extensions.rays.method import tracer_for, whiten_model
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io import orbits, viewpoints, write_image
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.label import warn_of_another
from minisplat_ref.io.names import file_names
from minisplat_ref.io.ply import load_ply, read_label
from minisplat_ref.io.run_files import CAMERAS, model_file
from minisplat_ref.mechanisms.rays.pixel_rays import pixel_rays
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Floats, Model

ORBIT_SIZE = (320, 240)  # pixels
DESCRIPTION = """\
Trace a scene together with lights, mirrors, glass and meshes, which a JSON file
describes:

  {"lights": [[0, -3, 1]], "ambient": 0.3, "bias": 0.02, "surfaces": [
    {"kind": "mirror", "corner": [-1, -1, 4], "sides": [[2, 0, 0], [0, 2, 0]]},
    {"kind": "glass", "mesh": "block.ply", "index": 1.5},
    {"kind": "diffuse", "mesh": "chair.ply", "color": [0.8, 0.6, 0.4]}]}

A surface is a parallelogram, or the triangles of a PLY, whose path is relative
to the folder of the JSON. Glass is a closed mesh whose normals point outwards.
"ambient" is the fraction of light that casts no shadow, "bias" the fraction of
the way from a Gaussian to a lamp on which nothing shadows it.
"""
EPILOG = """\
example:
  minisplat-ref rays render runs/fox --scene lamp_and_mirror.json --out lit"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "render",
        help="render a scene among lights, mirrors, glass and meshes",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians, or the folder of a run")
    parser.add_argument("--scene", type=Path, required=True, metavar="JSON", help="lights and surfaces, see above")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the images")
    parser.add_argument("--cameras", type=Path, metavar="JSON", help="cameras.json (default: the run's test views)")
    parser.add_argument("--frames", type=int, default=12, metavar="N", help="of an orbit without cameras (default 12)")
    parser.add_argument(
        "--background", type=float, nargs=3, default=(0.0, 0.0, 0.0), metavar=("R", "G", "B"), help="0 to 1 each"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Trace an image for each camera.

    Raises
    ------
    InputError
        The model, the surroundings or the cameras cannot be used.
    """
    if args.frames < 1:
        raise InputError(f"--frames is {args.frames}: give at least 1")
    background = np.array(args.background)
    if not ((background >= 0) & (background <= 1)).all():
        raise InputError(f"--background is {' '.join(f'{x:g}' for x in background)}: give three numbers from 0 to 1")
    around = surroundings.read(args.scene)
    file = model_file(args.model)
    gaussians = load_ply(file)
    warn_of_another(file, read_label(file), "rays", "rays render")
    whitened = whiten_model(Model(gaussians))
    surroundings.check_lights(around, whitened, args.scene)
    views = _views(args, gaussians.means)
    world = World(gaussians, tracer_for(whitened, GSPLAT_MAIN, CPU), around, background, GSPLAT_MAIN)
    with making_folder(args.out) as folder:
        names = file_names([view.name for view in views])
        for name, view in zip(names, with_progress(views, "tracing", "views"), strict=True):
            image = shade(world, pixel_rays(view.camera, GSPLAT_MAIN))
            write_image(folder / f"{name}.png", image.reshape(view.camera.height, view.camera.width, 3))
    print(f"{len(views)} images in {args.out}")
    return 0


def _views(args: argparse.Namespace, means: Floats) -> list[viewpoints.Viewpoint]:
    """Return the cameras that are given, those of the run's test views, or an orbit."""
    if args.cameras is not None:
        return viewpoints.read(args.cameras)
    path = args.model / CAMERAS
    if args.model.is_dir() and path.exists():
        known = viewpoints.read(path)
        return [view for view in known if view.split == "test"] or known
    return orbits.orbit(means, [], args.frames, *ORBIT_SIZE)
