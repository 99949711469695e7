"""The command ``minisplat-ref vdgs bake``: the scene as one view sees it, as a PLY for any viewer."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.types import Gaussians, Model


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "bake",
        help="write the scene as one view sees it, for viewers without a network",
        epilog="example: minisplat-ref vdgs bake runs/pane --view 0003 --out seen.ply",
    )
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a run of recipe vdgs")
    parser.add_argument("--view", required=True, metavar="NAME", help="name of a view of the run's cameras.json")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="PLY to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Evaluate the network for the view's camera, and write the Gaussians that result.

    Raises
    ------
    InputError
        It is no run of this recipe that has ended, or has no such view; a file alone has no network.
    """
    from minisplat_ref.extensions.vdgs.model import VDGS, VIEW_DEPENDENT, modulate_model, opacity_times
    from minisplat_ref.io import viewpoints
    from minisplat_ref.io.checkpoint import load_checkpoint
    from minisplat_ref.io.frames import place_camera, return_fields
    from minisplat_ref.io.ply import read_label, save_ply
    from minisplat_ref.io.run_files import CAMERAS, POINT_CLOUD
    from minisplat_ref.mechanisms.networks.networks import IN_NUMPY
    from minisplat_ref.training.recipe_settings import find_alternatives
    from minisplat_ref.training.saved_state import read_bundles, read_frame, recorded_recipe

    folder, checkpoint = args.run_folder, args.run_folder / "checkpoint.npz"
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder: give that of the run, a PLY alone has no network to evaluate")
    arrays, metadata = load_checkpoint(checkpoint)
    recipe, _ = recorded_recipe(metadata)
    if recipe != VDGS.name:
        raise InputError(f"{folder} was trained by recipe {recipe}, without a network: train with --recipe {VDGS.name}")
    cameras = {view.name: view.camera for view in viewpoints.read(folder / CAMERAS)}
    if args.view not in cameras:
        raise InputError(f"{folder} has no view {args.view}: choose from {', '.join(sorted(cameras))}")
    bundles, frame = read_bundles(checkpoint, arrays, Gaussians), read_frame(checkpoint, metadata)
    chosen = dict(setting.split("=", 1) for setting in read_label(folder / POINT_CLOUD).set)
    modulation = find_alternatives(opacity_times)[chosen.get("modulation", opacity_times.__name__)]
    model = Model(bundles.gaussians, bundles.shared)
    seen, _ = modulate_model(model, place_camera(cameras[args.view], frame), modulation(), IN_NUMPY)
    save_ply(args.out, Gaussians(**return_fields(seen._asdict(), VIEW_DEPENDENT.units, frame)))
    print(f"{len(seen.means):,} Gaussians as view {args.view} sees them in {args.out}; other views see others")
    return 0
