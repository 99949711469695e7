"""``sfm``: finds out from which places photographs were taken."""

import argparse
from pathlib import Path

from minisplat_ref.arguments import Commands, HelpFormatter

MATCHINGS = ("exhaustive", "sequential")
CAMERA_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")

DESCRIPTION = """\
Estimate cameras and sparse points from photographs (structure from motion, by
COLMAP, on the CPU). SCENE will be a COLMAP scene: images/, upright, shrunk and
without lens distortion, and sparse/0/. Photographs that cannot be placed are
named and left out; if hardly any can be placed, no scene is made.

It needs at least two photographs that overlap, of something with texture.
"""
EPILOG = """\
examples:
  minisplat-ref sfm holiday/fountain --out scenes/fountain
  minisplat-ref train scenes/fountain --out runs/fountain"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "sfm",
        help="make a scene from photographs: find their cameras",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("photos", type=Path, metavar="PHOTOS", help="folder of photographs")
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE", help="new folder for the scene")
    parser.add_argument(
        "--long-side", type=int, default=1600, metavar="PX", help="shrink larger photographs to this (default 1600)"
    )
    parser.add_argument(
        "--matching",
        choices=MATCHINGS,
        default=MATCHINGS[0],
        metavar="M",
        help="exhaustive: every pair (default), or sequential: neighbours, for frames of a video",
    )
    parser.add_argument(
        "--camera-model",
        choices=CAMERA_MODELS,
        default=CAMERA_MODELS[0],
        metavar="NAME",
        help="lens to estimate: SIMPLE_RADIAL (default), RADIAL or OPENCV",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Make the scene, and say how many photographs have found a place."""
    from minisplat_ref.datasets.sfm import advice, run_sfm

    result = run_sfm(
        args.photos, args.out, long_side=args.long_side, matching=args.matching, camera_model=args.camera_model
    )
    n_placed = result.n_photos - len(result.left_out)
    placed = f"{n_placed} of {result.n_photos} photographs ({n_placed / result.n_photos:.0%})"
    print(f"{args.out}: {placed}, {result.n_points} points, reprojection error {result.error:.2f} px")
    if result.left_out:
        print(f"without a place: {', '.join(result.left_out)}")
        if result.other_groups:
            groups = " and of ".join(map(str, result.other_groups))
            print(f"groups that fit together, but not with the scene: of {groups} photographs")
        print(advice(args.matching))
    return 0
