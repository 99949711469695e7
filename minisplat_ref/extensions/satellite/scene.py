"""The command ``satellite scene``: from images with RPCs to a scene that all commands read, a transforms.json.

A photograph keeps its 8 bits. Deeper ones have no agreed white: 11 bits of 16 are usual, and haze lifts what is black.
They are scaled to 8 bits by one line for all photographs and channels, through percentiles of the whole set, so that
their differences in light stay, which the radiometry of each photograph is there for. ``levels`` in the
transforms.json has the two values that become black and white, and ``utm`` the place of the world on earth. Pixels
without data are masked.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError, one_line
from minisplat_ref.extensions.satellite.cameras import (
    Frame,
    check_altitudes,
    choose_frame,
    fit_rpc,
    make_affine_camera,
)
from minisplat_ref.extensions.satellite.rasters import RASTERS, open_raster
from minisplat_ref.extensions.satellite.rpc import read_rpc
from minisplat_ref.extensions.satellite.utm import sun_direction
from minisplat_ref.interface.arguments import HelpFormatter, integer, list_of
from minisplat_ref.io import write_image
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.images import MASK_THRESHOLD, read_image
from minisplat_ref.io.json_file import read_json
from minisplat_ref.io.names import file_names
from minisplat_ref.io.ply_file import write_vertices
from minisplat_ref.io.transforms import OPENCV_FROM_OPENGL, SINGLE_FILE
from minisplat_ref.types import Bools, Camera, Floats

SUFFIXES = (".png", ".jpg", ".jpeg", *RASTERS)
SUNS, UTM = "suns.json", "utm"
N_POINTS = 20_000
PERCENTILES = 0.5, 99.5  # of deep pixels, which become black and white
N_SAMPLED = 2**20  # values of an image that percentiles are taken of; of larger ones every k-th
DESCRIPTION = """\
Make a scene of satellite images. Each has an RPC: in its metadata (GeoTIFF), or
beside it as NAME_RPC.TXT or NAME.RPB. suns.json beside them gives
{"NAME": [azimuth, elevation]} in degrees, clockwise from true north; without it
there are no shadows. More than 8 bits are scaled by percentiles of the set.
"""
EPILOG = """\
example:
  minisplat-ref satellite scene city --altitudes 0,80 --out scenes/city
  minisplat-ref train scenes/city --recipe satellite"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "scene",
        help="make a scene of images with RPCs",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("images", type=Path, metavar="IMAGES", help="folder of the images")
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE", help="new folder")
    parser.add_argument("--altitudes", type=list_of(float), metavar="LOW,HIGH", help="of the scene, metres (required)")
    parser.add_argument("--bands", type=list_of(integer(1)), metavar="R,G,B", help="numbers from 1 (default: by name)")
    parser.add_argument("--points", type=integer(1), default=N_POINTS, metavar="N", help="at the start (default 20000)")
    parser.add_argument("--seed", type=integer(0), default=0, metavar="S", help="of their places (default 0)")
    parser.set_defaults(run=write_scene)


def write_scene(args: argparse.Namespace) -> int:
    """Fit the cameras and write the scene.

    Raises
    ------
    InputError
        There are no altitudes, an image has no RPC or its fit leaves more than a pixel, a sun is not one, or images of
        8 bits and of more are mixed.
    """
    if args.altitudes is not None and len(args.altitudes) != 2:
        raise InputError(f"--altitudes has {len(args.altitudes)} number(s): give LOW,HIGH in metres")
    if args.bands is not None and len(args.bands) != 3:
        raise InputError(f"--bands has {len(args.bands)} number(s): give R,G,B")
    altitudes = check_altitudes(args.altitudes)
    paths = list_images(args.images)
    suns = read_suns(args.images / SUNS, [path.stem for path in paths])
    rpcs = [read_rpc(path) for path in paths]
    levels = find_levels(paths, args.bands)
    with making_folder(args.out) as folder:
        (folder / "images").mkdir()
        frame, frames = None, []
        for path, rpc, name in zip(paths, rpcs, file_names([path.stem for path in paths]), strict=True):
            pixels = read_pixels(path, args.bands)
            size = pixels.values.shape[1], pixels.values.shape[0]
            frame = frame or choose_frame(rpcs, size, altitudes)
            fit = fit_rpc(rpc, frame, size, altitudes, path.name)
            print(f"{path.name}: the affine camera is off by at most {fit.worst:.2f} px")
            sun = None if path.stem not in suns else sun_direction(*suns[path.stem], frame.convergence)
            try:
                camera = make_affine_camera(fit.A[:2], fit.b[:2], frame.scale, size, sun)
            except InputError as error:
                raise InputError(f"{path.name}: {error}") from None
            entries = {"file_path": f"images/{name}.png"}
            write_image(folder / entries["file_path"], to_bytes(pixels, levels))
            if pixels.mask is not None and not pixels.mask.all():
                entries["mask_path"] = f"masks/{name}.png"
                (folder / "masks").mkdir(exist_ok=True)
                write_image(folder / entries["mask_path"], pixels.mask)
            frames.append({**entries, **to_entries(camera)})
        assert frame is not None
        points = make_points(frame, altitudes, args.points, args.seed)
        places = dict(zip("xyz", points.T.astype(np.float32), strict=True))
        gray = dict.fromkeys(("red", "green", "blue"), np.full(args.points, 128, np.uint8))
        write_vertices(folder / "points.ply", {**places, **gray})
        content = {"camera_model": "AFFINE", "ply_file_path": "points.ply", UTM: frame.to_json(), "levels": levels}
        (folder / SINGLE_FILE).write_text(json.dumps({**content, "frames": frames}, indent=1), encoding="utf-8")
    scaled = "8 bits" if levels is None else f"{levels[0]:g} is black and {levels[1]:g} white"
    shaded = f"{len(suns)} with a sun" if suns else f"no sun, as there is no {SUNS}"
    across = f"{2 * frame.scale:.0f} m across"
    print(f"{args.out}: {len(paths)} images ({scaled}; {shaded}), {args.points:,} points, {across}")
    print(f"to train: minisplat-ref train {args.out} --recipe satellite")
    return 0


def list_images(folder: Path) -> list[Path]:
    """Return the images of a folder by name.

    Raises
    ------
    InputError
        There are fewer than two, or two of one name.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give the one of the images")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.name[0] != ".")
    if len(paths) < 2:
        raise InputError(f"{folder}: {len(paths)} image(s) ({', '.join(SUFFIXES)}); surfaces need at least two")
    stems = [path.stem for path in paths]
    if twice := next((stem for stem in stems if stems.count(stem) > 1), None):
        raise InputError(f"{folder}: two images are called {twice}; remove the one that is a preview")
    return paths


def read_suns(path: Path, names: list[str]) -> dict[str, tuple[float, float]]:
    """Return azimuth and elevation in degrees by the image's name; none without a file.

    Raises
    ------
    InputError
        It is not a mapping of names to two angles, or names an image that is not there.
    """
    if not path.exists():
        return {}
    angles = read_json(path, "mend it")
    form = '{"NAME": [azimuth, elevation], ...} in degrees'
    try:
        suns = {name: (float(azimuth), float(elevation)) for name, (azimuth, elevation) in angles.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not {form}; mend it") from error
    for name, (azimuth, elevation) in suns.items():
        if name not in names:
            raise InputError(f"{path}: there is no image {name}; names have no suffix: {', '.join(names[:3])}")
        if not (np.isfinite(azimuth) and 0 < elevation <= 90):
            raise InputError(f"{path}: the sun of {name} is not above the horizon; needed is {form}")
    return suns


class Pixels(NamedTuple):
    """An image as it is stored."""

    values: NDArray[Any]
    """[H, W, 3] of any real type."""
    mask: Bools | None
    """[H, W] whether a pixel has data; None where all do."""

    @property
    def is_deep(self) -> bool:
        """Whether it has more than 8 bits."""
        return self.values.dtype != np.uint8


def read_pixels(path: Path, bands: tuple[int, ...] | None) -> Pixels:
    """Read an image; a single band becomes gray.

    Parameters
    ----------
    path : Path
    bands : (int, int, int), optional
        Numbers from 1 of red, green and blue. By default the file says it, else they are the first three.

    Raises
    ------
    InputError
        It cannot be read, or has no such band; or rasterio is needed, for GeoTIFFs and 16 bits, and not installed.
    """
    if path.suffix.lower() in RASTERS or bands is not None or _is_deep_png(path):
        return _read_raster(path, bands)
    image = read_image(path)
    mask = image[..., 3] >= MASK_THRESHOLD if image.shape[2] == 4 else None
    return Pixels(np.ascontiguousarray(image[..., :3]), mask)


def _is_deep_png(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(25)
    return head[:8] == b"\x89PNG\r\n\x1a\n" and head[24:] == b"\x10"  # bits of a channel


def _read_raster(path: Path, bands: tuple[int, ...] | None) -> Pixels:
    with open_raster(path) as file:
        names = [interpretation.name for interpretation in file.colorinterp]
        if bands is None and {"red", "green", "blue"} <= set(names):
            bands = tuple(names.index(name) + 1 for name in ("red", "green", "blue"))
        bands = bands or ((1, 2, 3) if file.count >= 3 else (1, 1, 1))
        if max(bands) > file.count:
            raise InputError(f"{path}: has {file.count} band(s), and no band {max(bands)}; choose others by --bands")
        values = np.moveaxis(file.read(bands), 0, -1)
        mask = (file.read_masks(bands) > 0).any(axis=0)
    if values.dtype.kind not in "uif":
        raise InputError(f"{path}: pixels of type {values.dtype} are no levels of light; export real numbers")
    mask &= np.isfinite(values).all(axis=2)
    return Pixels(np.ascontiguousarray(values), None if mask.all() else mask)


def find_levels(paths: list[Path], bands: tuple[int, ...] | None) -> tuple[float, float] | None:
    """Return the values that become black and white: percentiles of all images; None where all have 8 bits.

    Raises
    ------
    InputError
        Images of 8 bits and of more are mixed, or there is one value only.
    """
    samples, deep = [], []
    for path in paths:
        pixels = read_pixels(path, bands)
        deep.append(pixels.is_deep)
        values = pixels.values.reshape(-1) if pixels.mask is None else pixels.values[pixels.mask].reshape(-1)
        samples.append(values[:: max(1, -(-values.size // N_SAMPLED))].astype(np.float64))
    if not any(deep):
        return None
    if not all(deep):
        shallow, other = paths[deep.index(False)].name, paths[deep.index(True)].name
        raise InputError(f"{shallow} has 8 bits and {other} more, and one scale cannot fit both: give images of a kind")
    values = np.concatenate(samples)
    low, high = np.percentile(values, PERCENTILES).tolist() if len(values) else (0.0, 0.0)
    if not low < high:
        raise InputError(f"{paths[0].parent}: all pixels are {low:g}, which is no image; export them again")
    return low, high


def to_bytes(pixels: Pixels, levels: tuple[float, float] | None) -> NDArray[np.uint8]:
    """Return an image of 8 bits, between levels that are black and white; pixels without data are black."""
    if levels is None:
        return pixels.values
    low, high = levels
    values = pixels.values.astype(np.float64)
    if pixels.mask is not None:
        values[~pixels.mask] = low
    return np.rint(np.clip((values - low) / (high - low), 0, 1) * 255).astype(np.uint8)


def make_points(frame: Frame, altitudes: tuple[float, float], n: int, seed: int) -> Floats:
    """Return random points [N, 3] that fill the world's square between the altitudes."""
    top = (altitudes[1] - altitudes[0]) / frame.scale
    return np.random.default_rng(seed).uniform([-1, -1, 0], [1, 1, top], size=(n, 3))


def to_entries(camera: Camera) -> dict[str, Any]:
    """Return the entries of a frame of a transforms.json for a camera with affine optics."""
    assert camera.optics is not None
    shear, metres, *sun = camera.optics.coefficients
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = camera.cam_from_world_R.T * OPENCV_FROM_OPENGL, camera.center
    intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    rays = {"shear": shear, "metres_per_unit": metres, **({"sun": sun} if any(sun) else {})}
    return {**intrinsics, "w": camera.width, "h": camera.height, **rays, "transform_matrix": matrix.tolist()}


def read_frame(scene: Path) -> Frame:
    """Return the place on earth of a scene that this command wrote.

    Raises
    ------
    InputError
        There is none.
    """
    file = scene if scene.is_file() else scene / SINGLE_FILE
    if not file.is_file():
        raise InputError(f"{scene}: no scene of `satellite scene`, {SINGLE_FILE} is missing; give one")
    try:
        return Frame.from_json(read_json(file, "make the scene again")[UTM])
    except (KeyError, TypeError, ValueError) as error:
        reason = f"{file}: has no place on earth ({error}); give a scene of `satellite scene`"
        raise InputError(one_line(reason)) from None
