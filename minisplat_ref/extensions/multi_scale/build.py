"""The command ``minisplat-ref multi-scale build``, which adds levels to a scene that was trained without any."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.multi_scale.model import Plan, add_levels, level_zero
from minisplat_ref.extensions.multi_scale.recipe import COVERAGE_MIN, FACTOR, N_LEVELS, finest_densities
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import further_properties, load_ply, save_ply


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "build",
        help="add coarser levels to a scene that was trained without any",
        epilog="example: minisplat-ref multi-scale build runs/fox/point_cloud.ply --out levels.ply",
    )
    parser.add_argument("ply", type=Path, metavar="PLY", help="point_cloud.ply of a run")
    parser.add_argument("--cameras", type=Path, metavar="FILE", help="cameras (default cameras.json beside the PLY)")
    parser.add_argument("--factor", type=float, default=FACTOR, metavar="F", help=f"ratio of sizes (default {FACTOR})")
    parser.add_argument("--levels", type=int, default=N_LEVELS, metavar="N", help=f"levels to add (default {N_LEVELS})")
    parser.add_argument(
        "--min-coverage",
        type=float,
        default=COVERAGE_MIN,
        metavar="PX",
        help=f"merge Gaussians that cover fewer pixels (default {COVERAGE_MIN:g})",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="PLY to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Merge level after level, and write all levels.

    Raises
    ------
    InputError
        The PLY or the cameras cannot be used, or a number is out of range.
    """
    from minisplat_ref.io.run_files import read_cameras

    if not (1 < args.factor <= 1024 and 1 <= args.levels <= 16 and args.min_coverage > 0):
        raise InputError("give a --factor above 1, 1 to 16 --levels, and a --min-coverage above 0")
    gaussians = load_ply(args.ply)
    if "cells_0" in further_properties(args.ply):
        raise InputError(f"{args.ply} has levels already: give a scene that was trained without any")
    views = read_cameras(args.ply, args.cameras)
    cameras = [view.camera for view in views if view.split != "test"]
    levels = level_zero(gaussians, np.random.default_rng(0))
    if len(gaussians.means) > 0:
        plan = Plan(args.factor, args.levels, args.min_coverage)
        levels = add_levels(levels, finest_densities(gaussians.means, cameras), plan, GSPLAT_MAIN)
    save_ply(args.out, levels, Label("multi-scale"))
    added = len(levels.means) - len(gaussians.means)
    print(f"{added:,} coarser Gaussians beside {len(gaussians.means):,} in {args.out}")
    return 0
