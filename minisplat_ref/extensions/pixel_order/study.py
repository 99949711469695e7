"""The studies ``pixel-order/rotation``, ``pixel-order/projection`` and ``pixel-order/order``."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.shared_studies import add_out, check_at_least, write
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.reporting import markdown_table
from minisplat_ref.studies.study import Study

if TYPE_CHECKING:
    from minisplat_ref.types import Camera, Floats, Primitives


def _add_cloud(parser: argparse.ArgumentParser, n: int) -> None:
    add_out(parser)
    parser.add_argument("--gaussians", type=int, default=n, metavar="N", help=f"number of Gaussians (default {n})")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the Gaussians (default 0)")


def add_rotation_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--gaussians``, ``--steps``, ``--seed`` and ``--out``."""
    _add_cloud(parser, 100)
    parser.add_argument("--steps", type=int, default=80, metavar="N", help="steps of the yaw (default 80)")


def run_rotation(args: argparse.Namespace) -> None:
    """Turn and move a camera, write the results, and print a table.

    Raises
    ------
    InputError
        There is nothing to measure, or the output folder cannot be used.
    """
    from minisplat_ref.extensions.pixel_order import clouds

    check_at_least(1, gaussians=args.gaussians, steps=args.steps)
    with making_folder(args.out) as folder:
        found = clouds.rotation(args.gaussians, args.steps, args.seed)
        write(folder, {"gaussians": args.gaussians, "seed": args.seed, "ways": found}, clouds.draw_rotation(found))
    print(f"Largest change of fixed rays' colours in a step of {40 / args.steps:g} degrees, or of a sideways walk\n")
    keys = ("walk_worst", "walk_in_tenths_worst", "walk_mean", "walk_in_tenths_mean")
    rows = [[method, f"{max(v['yaw']):.1e}", *(f"{v[key]:.1e}" for key in keys)] for method, v in found.items()]
    heads = ["worst ray, yaw", "worst ray, walk", "tenth of a step", "mean of rays, walk", "tenth of a step"]
    print(markdown_table(["method", *heads], rows))


def add_projection_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--gaussians``, ``--seed`` and ``--out``."""
    _add_cloud(parser, 20)


def run_projection(args: argparse.Namespace) -> None:
    """Measure footprints against the peak along the ray, write the results, and print a table.

    Raises
    ------
    InputError
        There is nothing to measure, or the output folder cannot be used.
    """
    from minisplat_ref.extensions.pixel_order import clouds

    check_at_least(1, gaussians=args.gaussians)
    with making_folder(args.out) as folder:
        found = clouds.projection_errors(args.gaussians, args.seed)
        result = {"gaussians": args.gaussians, "seed": args.seed, "angles": clouds.ANGLES, "errors": found}
        write(folder, result, clouds.draw_projection(found))
    print("Error of a footprint against the peak along each ray, sum |G - peak| / sum peak\n")
    rows = [[name, *(f"{error:.3f}" for error in errors)] for name, errors in found.items()]
    print(markdown_table(["projection", *(f"{angle:g} degrees" for angle in clouds.ANGLES)], rows))


def add_order_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--ply``, ``--gaussians``, ``--every``, ``--seed`` and ``--out``."""
    _add_cloud(parser, 300)
    parser.add_argument("--ply", type=Path, metavar="FILE", help="use the PLY of a run, seen by its first test camera")
    parser.add_argument("--every", type=int, default=4, metavar="N", help="N-th pixels along both axes (default 4)")


def run_order(args: argparse.Namespace) -> None:
    """Count pairs of hits out of order, write the results, and print a table.

    Raises
    ------
    InputError
        There is nothing to measure, or a file or the output folder cannot be used.
    """
    from minisplat_ref.extensions.pixel_order import clouds

    check_at_least(1, gaussians=args.gaussians, every=args.every)
    if args.ply is None:
        primitives, colors = clouds.cloud(args.gaussians, np.random.default_rng(args.seed))
        camera, source = clouds.wide_camera(70.0), f"{args.gaussians} random Gaussians"
    else:
        primitives, colors, camera = _of_run(args.ply)
        source = f"{len(colors):,} Gaussians of {args.ply}"
    with making_folder(args.out) as folder:
        rows = clouds.orders(primitives, colors, camera, clouds.grid_centers(camera, args.every))
        write(folder, {"source": source, "orders": rows}, clouds.draw_orders(rows))
    print(f"{source}: pairs of hits of a pixel out of order, and colours against the exact order\n")
    table = [
        [row["order"], f"{100 * row['misordered']:.2f}", f"{row['mean_error']:.1e}", f"{row['largest_error']:.1e}"]
        for row in rows
    ]
    print(markdown_table(["order", "pairs (%)", "mean error", "largest error"], table))


def _of_run(ply: Path) -> "tuple[Primitives, Floats, Camera]":
    """Read Gaussians, their colours of degree 0, and the first test camera.

    Raises
    ------
    InputError
        The PLY or the cameras beside it cannot be used.
    """
    from minisplat_ref.constants import SH_C0
    from minisplat_ref.io import viewpoints
    from minisplat_ref.io.ply import load_ply
    from minisplat_ref.rendering import activate

    gaussians = load_ply(ply)
    cameras = [view.camera for view in viewpoints.read(ply.parent / "cameras.json") if view.split == "test"]
    if not cameras or not len(gaussians.means):
        raise InputError(f"{ply} has no Gaussians, or its cameras.json no test views: give the PLY of a run")
    wide = gaussians._make(field.astype(np.float64) for field in gaussians)
    return activate(wide), np.maximum(0.5 + SH_C0 * wide.sh_dc, 0), cameras[0]


ROTATION = Study(
    "rotation", "colours of fixed rays while the camera turns and moves", add_rotation_arguments, run_rotation
)
PROJECTION = Study(
    "projection", "footprints against the peak along rays, off the axis", add_projection_arguments, run_projection
)
ORDER = Study("order", "hits out of order in a list and in buffers", add_order_arguments, run_order)
