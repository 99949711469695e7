"""``sfm``: finds the cameras of photographs."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.interface.arguments import Commands, HelpFormatter, add_up_argument, integer

if TYPE_CHECKING:
    from minisplat_ref.datasets.sfm import SfmResult
    from minisplat_ref.datasets.sfm.mapping import Mapped
    from minisplat_ref.datasets.sfm.photographs import Group

LONG_SIDE = 1600  # pixels
FEATURES = ("auto", "standard", "dense")
MATCHINGS = ("auto", "exhaustive", "sequential")
CAMERA_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")

DESCRIPTION = """\
Estimate cameras and sparse points from photographs (structure from motion, by
COLMAP, on the CPU). SCENE will be a COLMAP scene: images/, upright, shrunk and
without lens distortion, sparse/0/, and masks/ if photographs are transparent
or have masks in PHOTOS/masks/ (white counts). Photographs that cannot be
placed are named and left out; if hardly any can be placed, no scene is made.

It needs at least two photographs that overlap, of something with texture.
Photographs of another size, camera or focal length may be mixed in.
"""
EPILOG = """\
examples:
  minisplat-ref sfm holiday/fountain --out scenes/fountain
  minisplat-ref sfm holiday/walk.mp4 --every 10 --out scenes/walk
  minisplat-ref train scenes/fountain --downscale 3 --out runs/fountain"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "sfm",
        help="make a scene from photographs: find their cameras",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("photos", type=Path, metavar="PHOTOS", help="folder of photographs, or a video")
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE", help="new folder for the scene")
    parser.add_argument(
        "--long-side",
        type=int,
        default=LONG_SIDE,
        metavar="PX",
        help=f"shrink larger photographs to this (default {LONG_SIDE})",
    )
    parser.add_argument(
        "--features",
        choices=FEATURES,
        default=FEATURES[0],
        metavar="F",
        help="standard; dense: more of them, matched more thoroughly, in about ten times the time; or auto (default):"
        " also dense if standard ones leave photographs without a place",
    )
    parser.add_argument(
        "--matching",
        choices=MATCHINGS,
        metavar="M",
        help="exhaustive: every pair; sequential: neighbours in time (default of a video); or auto (default):"
        " neighbours, and every pair of few photographs, or if neighbours leave some without a place",
    )
    parser.add_argument(
        "--every",
        type=integer(1),
        metavar="N",
        help="of each N frames of a video take the sharpest (default: of half a second)",
    )
    parser.add_argument(
        "--camera-model",
        choices=CAMERA_MODELS,
        default=CAMERA_MODELS[0],
        metavar="NAME",
        help="lens to estimate: SIMPLE_RADIAL (default), RADIAL or OPENCV",
    )
    add_up_argument(parser)
    parser.set_defaults(run=run, recommends=True)


def run(args: argparse.Namespace) -> int:
    """Make the scene, print how it was found, and how to train on it."""
    from minisplat_ref.datasets.sfm import default_matching, run_sfm

    matching = args.matching or default_matching(args.photos)
    result = run_sfm(
        args.photos,
        args.out,
        long_side=args.long_side,
        matching=matching,
        every=args.every,
        features=args.features,
        camera_model=args.camera_model,
        up=args.up,
    )
    print("\n".join(_summarize(result, args.out, matching)))
    return 0


def _summarize(result: "SfmResult", out: Path, matching: str) -> list[str]:
    """Return the lines that are printed."""
    from minisplat_ref.datasets.sfm import advice
    from minisplat_ref.datasets.sfm.zoom import describe_found
    from minisplat_ref.io.upright import describe_up

    n_placed = result.n_photos - len(result.left_out)
    placed = f"{n_placed} of {result.n_photos} photographs ({n_placed / result.n_photos:.0%})"
    lines = [f"{out}: {placed}, {result.n_points} points, reprojection error {result.error:.2f} px"]
    lines.append(f"kept: {_describe(result.kept, result.n_matches)}")
    lines += [f"not kept: {_describe(other, result.n_matches)}" for other in result.others]
    if result.left_out:
        lines.append(f"without a place: {', '.join(result.left_out)}")
        if result.kept.other_groups:
            groups = " and of ".join(map(str, result.kept.other_groups))
            lines.append(f"groups that fit together, but not with the scene: of {groups} photographs")
        lines.append(advice(matching))
    if len(result.groups) > 1:
        cameras = "; ".join(f"{len(names)} of {_describe_group(group)}" for group, names in result.groups.items())
        lines.append(f"one camera for each size, camera and focal length: {cameras}")
    if found := describe_found(result.groups):
        lines.append(f"the focal length is in no EXIF data; the photographs show that it is {found}")
    if result.n_masks:
        lines.append(f"masks: of {result.n_masks} photographs; no features were looked for where they are black")
    lines.append(describe_up(result.up))
    return [*lines, _describe_exposures(out), *_propose_training(result, out)]


def _describe_exposures(out: Path) -> str:
    """Return what the tracks of the scene show about the exposures of its photographs."""
    from minisplat_ref.app.runs.notices import describe_exposures
    from minisplat_ref.io import load_scene

    return f"exposures of the photographs {describe_exposures(load_scene(out, undistort=True))}"


def _describe(mapped: "Mapped", n_matches: int) -> str:
    """Return what a mapper has made of the photographs."""
    name = f"{mapped.mapper} mapper with {mapped.features} features"
    if mapped.n_placed == 0:
        return f"{name}, which places no photographs"
    return (
        f"{name}: {mapped.n_placed} photographs, {mapped.n_points} points; explains"
        f" {mapped.n_explained / n_matches:.0%} of the matches"
    )


def _describe_group(group: "Group") -> str:
    """Return what the photographs of a group have in common."""
    parts = [f"{group.width} x {group.height}", group.camera]
    parts.append("" if group.focal is None else f"{group.focal:g} mm")
    parts.append("" if group.found is None else f"{group.found:.2f} times the width")
    parts.append("" if group.focal_35 is None else f"{group.focal_35:g} mm on 35 mm film")
    return ", ".join(filter(None, parts))


def _propose_training(result: "SfmResult", out: Path) -> list[str]:
    """Return the sizes of the photographs, a size at which a laptop trains soon, and the next command."""
    from minisplat_ref.app.reports.commands import command
    from minisplat_ref.app.runs.notices import describe_sizes
    from minisplat_ref.app.runs.proposed_size import comfortable_factor
    from minisplat_ref.io.images import downscaled_size

    width, height = max(result.sizes, key=max)
    factor = comfortable_factor(width, height)
    smaller = " x ".join(map(str, downscaled_size(width, height, factor)))
    options = ("--downscale", str(factor)) if factor > 1 else ()
    sizes = f"photographs of {describe_sizes(result.sizes)} pixels"
    if factor > 1:
        sizes += f"; begin at {smaller}, which a laptop trains in minutes"
    return [sizes, f"next: {command('train', out, *options, '--out', Path('runs', out.resolve().name))}"]
