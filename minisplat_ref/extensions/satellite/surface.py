"""The command ``satellite dsm``: a digital surface model, the altitudes that a camera in the zenith shows."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.satellite.cameras import make_affine_camera
from minisplat_ref.extensions.satellite.model import SATELLITE
from minisplat_ref.extensions.satellite.rasters import import_rasterio
from minisplat_ref.extensions.satellite.scene import read_frame
from minisplat_ref.interface.arguments import HelpFormatter, positive
from minisplat_ref.io import write_image
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.json_file import read_json
from minisplat_ref.io.ply import load_ply
from minisplat_ref.io.run_files import CONFIG, POINT_CLOUD
from minisplat_ref.rendering import Request
from minisplat_ref.types import Floats, Model, view_from

MIN_ALPHA = 0.5  # below, the model has no surface there
DESCRIPTION = """\
Write a digital surface model: for each cell of a grid the altitude in metres
that a camera in the zenith sees, NaN where there is no surface. North is up.
A picture of it, NAME.png, is written beside.
"""


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
    A = np.array([[width / (2 * half), 0, 0], [0, -height / (2 * half), 0]])
    camera = make_affine_camera(A, np.array([width / 2, height / 2]), scale, (width, height))
    output, _ = SATELLITE.render(model, view_from(camera), Request(wants=frozenset({"altitude"})))
    altitudes: Floats = np.where(output.alpha < min_alpha, np.nan, output.image[..., 3])
    return altitudes


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "dsm",
        help="write a digital surface model of a run",
        description=DESCRIPTION,
        epilog="example:\n  minisplat-ref satellite dsm runs/city --out dsm.npy",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="RUN", help="folder of a training by --recipe satellite")
    parser.add_argument("--scene", type=Path, metavar="PATH", help="where the run's scene is now")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=".npy, or .tif with its place on earth")
    parser.add_argument("--gsd", type=positive, default=0.5, metavar="M", help="metres per cell (default 0.5)")
    parser.set_defaults(run=write_surface_model)


def write_surface_model(args: argparse.Namespace) -> int:
    """Render the altitudes and write them.

    Raises
    ------
    InputError
        The folder is no run of a scene of ``satellite scene``, or the file has another suffix or needs rasterio.
    """
    suffix, out = args.out.suffix.lower(), args.out
    if suffix not in (".npy", ".tif"):
        raise InputError(f"--out {out}: a surface model is a .npy or a .tif; choose one")
    rasterio = import_rasterio(out) if suffix == ".tif" else None
    frame = read_frame(args.scene or find_scene(args.model))
    size = max(1, round(2 * frame.scale / args.gsd))
    found = surface_model(Model(load_ply(args.model / POINT_CLOUD)), (size, size), frame.scale)
    heights = (found + frame.origin[2]).astype(np.float32)
    if not np.isfinite(heights).any():
        raise InputError(f"{args.model}: nothing is opaque from above; train it longer")
    with replacing(out) as part:
        if rasterio is None:
            with part.open("wb") as file:
                np.save(file, heights)
        else:
            east, north = frame.origin[0] - frame.scale, frame.origin[1] + frame.scale
            cell = 2 * frame.scale / size
            profile = {
                "driver": "GTiff",
                "width": size,
                "height": size,
                "count": 1,
                "dtype": "float32",
                "nodata": float("nan"),
                "crs": f"EPSG:{(32700 if frame.is_south else 32600) + frame.zone}",
                "transform": rasterio.Affine(cell, 0, east, 0, -cell, north),
            }
            with rasterio.open(part, "w", **profile) as file:
                file.write(heights, 1)
    low, high = np.nanpercentile(heights, [1, 99])
    shade = np.nan_to_num(np.clip((heights - low) / max(high - low, 1e-6), 0, 1))
    write_image(out.with_suffix(".png"), np.repeat((255 * shade[..., None]).astype(np.uint8), 3, axis=2))
    print(f"{out}: {size} x {size} cells, altitudes {np.nanmin(heights):.1f} to {np.nanmax(heights):.1f} m")
    return 0


def find_scene(run: Path) -> Path:
    """Return the path of the scene that a run was trained on.

    Raises
    ------
    InputError
        The folder is no run.
    """
    config: Any = read_json(run / CONFIG, "give the folder of a training") if (run / CONFIG).is_file() else None
    try:
        return Path(config["settings"]["scene"])
    except (KeyError, TypeError):
        raise InputError(f"{run}: holds no run; give the folder of a training by --recipe satellite") from None
