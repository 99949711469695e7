"""The command ``minisplat-ref cus features``, which writes the features that the views of a run read."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "features",
        help="write the features that each view reads, as NAME.npy of [H, W, D]",
        epilog="example: minisplat-ref cus features runs/anchors --out maps",
    )
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a run of recipe cus")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for a file per view")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Blend the queries of every view of the run, read the memory, and write the maps.

    Raises
    ------
    InputError
        It is no run of this recipe that has ended, or the folder exists.
    """
    from minisplat_ref.extensions.cus.model import Anchors
    from minisplat_ref.extensions.cus.recipe import CUS, blended_queries, read_memory
    from minisplat_ref.io import viewpoints
    from minisplat_ref.io.atomic import making_folder
    from minisplat_ref.io.checkpoint import load_checkpoint
    from minisplat_ref.io.frames import place_camera
    from minisplat_ref.io.run_files import CAMERAS
    from minisplat_ref.rendering import Request
    from minisplat_ref.training.saved_state import read_bundles, read_frame, recorded_recipe
    from minisplat_ref.types import Model, view_from

    folder, checkpoint = args.run_folder, args.run_folder / "checkpoint.npz"
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder: give that of the run, a PLY alone has no memory to read")
    arrays, metadata = load_checkpoint(checkpoint)
    recipe, _ = recorded_recipe(metadata)
    if recipe != CUS.name:
        raise InputError(f"{folder} was trained by recipe {recipe}, without features: train with --recipe {CUS.name}")
    bundles, frame = read_bundles(checkpoint, arrays, Anchors), read_frame(checkpoint, metadata)
    model = Model(bundles.gaussians, bundles.shared)
    found = viewpoints.read(folder / CAMERAS)
    with making_folder(args.out) as out:
        for viewpoint in found:
            view = view_from(place_camera(viewpoint.camera, frame), name=viewpoint.name)
            image, _ = blended_queries(model, view, Request())
            features, _ = read_memory(image.reshape(-1, image.shape[2]), model.shared)
            path = out / f"{viewpoint.name}.npy"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.save(path, features.reshape(*image.shape[:2], -1).astype(np.float32))
    print(f"features of {len(found)} views, {features.shape[1]} channels, in {args.out}")
    return 0
