"""The commands ``satellite train``, from images with RPCs to a model and the frame of its world, and ``satellite dsm``.

A digital surface model has the altitudes that a camera in the zenith shows.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.satellite.cameras import (
    check_altitudes,
    choose_frame,
    fit_rpc,
    import_rasterio,
    make_affine_camera,
    read_rpc,
)
from minisplat_ref.extensions.satellite.model import SATELLITE
from minisplat_ref.interface.arguments import HelpFormatter, integer, list_of, positive
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io import save_ply, write_image
from minisplat_ref.io.atomic import making_folder, replacing
from minisplat_ref.io.images import image_size, read_image
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import load_ply
from minisplat_ref.rendering import Request
from minisplat_ref.types import Floats, Frame, Model, Scene, View, view_from

SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
SUNS = "suns.json"
N_POINTS = 20_000
TRAIN_DESCRIPTION = """\
Train on satellite images of 8 bits per channel. Each has an RPC: in its
metadata (GeoTIFF), or beside it as NAME_RPC.TXT or NAME.RPB. The first by name
is the reference. suns.json beside them gives {"NAME": [azimuth, elevation]} in
degrees, clockwise from north; without it there are no shadows.
"""

FRAME = "satellite.json"  # beside a run's model: origin, scale, zone, is_south
MIN_ALPHA = 0.5  # below, the model has no surface there
DSM_DESCRIPTION = """\
Write a digital surface model: for each cell of a grid the altitude in metres
that a camera in the zenith sees, NaN where there is no surface. North is up.
A picture of it, NAME.png, is written beside.
"""


def add_parser(commands: Any) -> None:
    """Add both commands."""
    add_train(commands)
    add_dsm(commands)


def add_train(commands: Any) -> None:
    """Add the command ``train``."""
    parser = commands.add_parser(
        "train",
        help="train on images with RPCs",
        description=TRAIN_DESCRIPTION,
        epilog="example:\n  minisplat-ref satellite train city --altitudes 0,80 --out runs/city",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("images", type=Path, metavar="IMAGES", help="folder of the images")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="new folder")
    parser.add_argument("--altitudes", type=list_of(float), metavar="LOW,HIGH", help="of the scene, metres (required)")
    parser.add_argument("--iterations", type=integer(1), default=5000, metavar="N", help="default 5000")
    parser.add_argument("--points", type=integer(1), default=N_POINTS, metavar="N", help="at the start (default 20000)")
    parser.add_argument("--seed", type=integer(0), default=0, metavar="S", help="default 0")
    parser.set_defaults(run=train_on_images)


def train_on_images(args: argparse.Namespace) -> int:
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
    frame = choose_frame(rpcs, image_size(paths[0]), altitudes)
    views = []
    for k, (path, rpc) in enumerate(zip(paths, rpcs, strict=True)):
        image = read_image(path)
        size = image.shape[1], image.shape[0]
        fit = fit_rpc(rpc, frame, size, altitudes, path.name)
        print(f"{path.name}: the affine camera is off by at most {fit.worst:.2f} px")
        camera = make_affine_camera(fit.A, fit.b, *size, suns.get(path.stem))
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


def surface_model(
    model: Model, shape: tuple[int, int], scale: float, *, half: float = 1.0, min_alpha: float = MIN_ALPHA
) -> Floats:
    """Return altitudes [H, W] of the square of ``-half`` to ``half`` world units, NaN where alpha is below one half.

    Parameters
    ----------
    model : Model
    shape : (height, width)
        Cells.
    scale : float
        Metres per world unit.
    half : float
        World units.
    """
    height, width = shape
    A = np.diag([width / (2 * half), -height / (2 * half), scale])
    camera = make_affine_camera(A, np.array([width / 2, height / 2, 0.0]), width, height)
    output, _ = SATELLITE.render(model, view_from(camera), Request(wants=frozenset({"altitude"})))
    altitudes: Floats = np.where(output.alpha < min_alpha, np.nan, output.image[..., 3])
    return altitudes


def add_dsm(commands: Any) -> None:
    """Add the command ``dsm``."""
    parser = commands.add_parser(
        "dsm",
        help="write a digital surface model of a run",
        description=DSM_DESCRIPTION,
        epilog="example:\n  minisplat-ref satellite dsm runs/city --out dsm.npy",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="RUN", help="folder that satellite train wrote")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=".npy, or .tif with its place on earth")
    parser.add_argument("--gsd", type=positive, default=0.5, metavar="M", help="metres per cell (default 0.5)")
    parser.set_defaults(run=write_surface_model)


def write_surface_model(args: argparse.Namespace) -> int:
    """Render the altitudes and write them.

    Raises
    ------
    InputError
        The folder is not a run of ``satellite train``, or the file has another suffix or needs rasterio.
    """
    suffix, out = args.out.suffix.lower(), args.out
    if suffix not in (".npy", ".tif"):
        raise InputError(f"--out {out}: a surface model is a .npy or a .tif; choose one")
    rasterio = import_rasterio(out) if suffix == ".tif" else None
    frame = read_frame(args.model)
    size = max(1, round(2 * frame["scale"] / args.gsd))
    found = surface_model(Model(load_ply(args.model / "point_cloud.ply")), (size, size), frame["scale"])
    heights = (found + frame["origin"][2]).astype(np.float32)
    if not np.isfinite(heights).any():
        raise InputError(f"{args.model}: nothing is opaque from above; train it longer")
    with replacing(out) as part:
        if rasterio is None:
            with part.open("wb") as file:
                np.save(file, heights)
        else:
            east, north = frame["origin"][0] - frame["scale"], frame["origin"][1] + frame["scale"]
            cell = 2 * frame["scale"] / size
            profile = {
                "driver": "GTiff",
                "width": size,
                "height": size,
                "count": 1,
                "dtype": "float32",
                "nodata": float("nan"),
                "crs": f"EPSG:{(32700 if frame['is_south'] else 32600) + frame['zone']}",
                "transform": rasterio.Affine(cell, 0, east, 0, -cell, north),
            }
            with rasterio.open(part, "w", **profile) as file:
                file.write(heights, 1)
    low, high = np.nanpercentile(heights, [1, 99])
    shade = np.nan_to_num(np.clip((heights - low) / max(high - low, 1e-6), 0, 1))
    write_image(out.with_suffix(".png"), np.repeat((255 * shade[..., None]).astype(np.uint8), 3, axis=2))
    print(f"{out}: {size} x {size} cells, altitudes {np.nanmin(heights):.1f} to {np.nanmax(heights):.1f} m")
    return 0


def read_frame(folder: Path) -> dict[str, Any]:
    """Return the frame of a run's world.

    Raises
    ------
    InputError
        There is none.
    """
    path = folder / FRAME
    try:
        frame: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        (_, _, _), _ = frame["origin"], (frame["scale"], frame["zone"], frame["is_south"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no frame of a world; give the folder that `satellite train` wrote") from error
    return frame
