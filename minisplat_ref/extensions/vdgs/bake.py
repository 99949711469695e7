"""The command ``minisplat-ref vdgs bake``, which writes the scene as one view sees it as a PLY for any viewer."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError


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
        It is no run of this extension, or has no such view; a file alone has no network.
    """
    from minisplat_ref.extensions.extension import load_extension, owner_of
    from minisplat_ref.extensions.vdgs.method import VIEW_DEPENDENT, as_seen
    from minisplat_ref.io import viewpoints
    from minisplat_ref.io.frames import place_camera
    from minisplat_ref.io.ply import save_ply
    from minisplat_ref.mechanisms.networks.networks import IN_NUMPY
    from minisplat_ref.runs import settings as run_settings
    from minisplat_ref.runs.checkpoints import newest_model
    from minisplat_ref.runs.run_folder import CAMERAS

    if not args.run_folder.is_dir():
        raise InputError(f"{args.run_folder} is no folder: give the run, a PLY alone has no network to evaluate")
    settings = run_settings.load(args.run_folder)
    owner = owner_of(settings.recipe, settings.extension)
    if owner is None or owner.name != "vdgs":
        raise InputError(f"{args.run_folder} has no network: train it with --recipe vdgs")
    cameras = {view.name: view.camera for view in viewpoints.read(args.run_folder / CAMERAS)}
    if args.view not in cameras:
        raise InputError(f"{args.run_folder} has no view {args.view}: choose from {', '.join(sorted(cameras))}")
    frame = run_settings.load_frame(args.run_folder)
    modulation = run_settings.recipe_of(settings).representation.renderer.render.keywords["modulation"]
    model = newest_model(args.run_folder, settings).model
    seen, _ = as_seen(model, place_camera(cameras[args.view], frame), modulation(), IN_NUMPY)
    extension = load_extension("vdgs")._replace(representation=VIEW_DEPENDENT)
    returned = run_settings.return_model(model._replace(gaussians=seen), extension, frame)
    save_ply(args.out, returned.gaussians)
    print(f"{len(seen.means):,} Gaussians as view {args.view} sees them in {args.out}; other views see others")
    return 0
