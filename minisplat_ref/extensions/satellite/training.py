"""The command ``minisplat-ref satellite train``: from images with RPCs to a model and the frame of its world."""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.satellite.affine_fit import camera_of, check_altitudes, fit_rpc, frame_of
from minisplat_ref.extensions.satellite.rpc import read_rpc
from minisplat_ref.extensions.satellite.surface_model import FRAME
from minisplat_ref.interface.arguments import HelpFormatter, integer, list_of
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io import save_ply
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.images import image_size, read_image
from minisplat_ref.io.label import Label
from minisplat_ref.types import Frame, Scene, View

SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
SUNS = "suns.json"
N_POINTS = 20_000
DESCRIPTION = """\
Train on satellite images of 8 bits per channel. Each has an RPC: in its
metadata (GeoTIFF), or beside it as NAME_RPC.TXT or NAME.RPB. The first by name
is the reference. suns.json beside them gives {"NAME": [azimuth, elevation]} in
degrees, clockwise from north; without it there are no shadows.
"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "train",
        help="train on images with RPCs",
        description=DESCRIPTION,
        epilog="example:\n  minisplat-ref satellite train city --altitudes 0,80 --out runs/city",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("images", type=Path, metavar="IMAGES", help="folder of the images")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="new folder")
    parser.add_argument("--altitudes", type=list_of(float), metavar="LOW,HIGH", help="of the scene, metres (required)")
    parser.add_argument("--iterations", type=integer(1), default=5000, metavar="N", help="default 5000")
    parser.add_argument("--points", type=integer(1), default=N_POINTS, metavar="N", help="at the start (default 20000)")
    parser.add_argument("--seed", type=integer(0), default=0, metavar="S", help="default 0")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Fit the cameras, train, write.

    Raises
    ------
    InputError
        There are no altitudes, an image has no RPC or its fit leaves more than a pixel, or a sun is not one.
    """
    from minisplat_ref.extensions.extension import find_recipe
    from minisplat_ref.training.loop import train

    if args.altitudes is not None and len(args.altitudes) != 2:
        raise InputError(f"--altitudes has {len(args.altitudes)} number(s): give LOW,HIGH in metres")
    low, high = check_altitudes(None if args.altitudes is None else tuple(args.altitudes))
    scene, frame = read_images(args.images, (low, high), args.points, args.seed)
    recipe = find_recipe("satellite", args.iterations)
    with making_folder(args.out) as folder:
        with progress_bar("training", "iterations", recipe.iterations) as bar:
            state = train(scene, recipe, seed=args.seed, on_step=lambda _: bar.update())
        save_ply(folder / "point_cloud.ply", state.gaussians, Label("satellite"))
        arrays: dict[str, Any] = dict(state.shared)
        np.savez(folder / "shared.npz", **arrays)
        (folder / FRAME).write_text(json.dumps(frame) + "\n", encoding="utf-8")
    print(f"{args.out}: {len(state.gaussians.means):,} Gaussians")
    return 0


def read_images(folder: Path, altitudes: tuple[float, float], n_points: int, seed: int) -> tuple[Scene, dict[str, Any]]:
    """Return the scene of a folder, with random points in its volume, and the frame for :data:`FRAME`."""
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES)
    if len(paths) < 2:
        raise InputError(f"{folder}: {len(paths)} images; surfaces need at least two")
    rpcs, suns = [read_rpc(path) for path in paths], read_suns(folder / SUNS)
    frame = frame_of(rpcs, image_size(paths[0]), altitudes)
    views = []
    for k, (path, rpc) in enumerate(zip(paths, rpcs, strict=True)):
        image = read_image(path)
        size = image.shape[1], image.shape[0]
        fit = fit_rpc(rpc, frame, size, altitudes, path.name)
        print(f"{path.name}: the affine camera is off by at most {fit.worst:.2f} px")
        camera = camera_of(fit.A, fit.b, *size, suns.get(path.stem))
        views.append(View(path.stem, camera, image[..., :3], None, view_id=k))
    top = (altitudes[1] - altitudes[0]) / frame.scale
    points = np.random.default_rng(seed).uniform([-1, -1, 0], [1, 1, top], size=(n_points, 3))
    place = Frame((float(frame.origin[0]), float(frame.origin[1]), float(frame.origin[2])), frame.scale)
    gray = np.full((n_points, 3), 128, np.uint8)
    scene = Scene(folder.name, tuple(views), (), points, gray, np.zeros(3), 1.0, place)
    described = {**frame._asdict(), "origin": frame.origin.tolist()}
    return scene, described


def read_suns(path: Path) -> dict[str, Any]:
    """Return directions towards the sun (east, north, up) by the image's name; none without a file.

    Raises
    ------
    InputError
        It is not a mapping of names to two angles, or a sun is not above the horizon.
    """
    if not path.exists():
        return {}
    try:
        angles = {name: np.radians([float(a), float(e)]) for name, (a, e) in json.loads(path.read_text()).items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f'{path}: not {{"NAME": [azimuth, elevation], ...}} in degrees; mend it') from error
    return {n: np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)]) for n, (a, e) in angles.items()}
