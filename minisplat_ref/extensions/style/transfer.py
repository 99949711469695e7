"""The command ``minisplat-ref style transfer``, which paints a trained scene in the style of an image, and its files.

Extensions are below :mod:`minisplat_ref.app`, so this reads ``config.json`` itself. The output is an ordinary run
without a checkpoint, like that of ``simplify``: ``render``, ``eval``, ``info`` and ``convert`` take it.
"""

import argparse
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.constants import PROFILES, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.arguments import add_number, integer
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io import load_ply, load_scene, save_ply
from minisplat_ref.io.frames import frame_from_json, place_population, place_scene, return_population
from minisplat_ref.io.json_file import read_json
from minisplat_ref.io.label import NO_LABEL
from minisplat_ref.io.run_files import CAMERAS, CONFIG, METRICS, POINT_CLOUD, SHARED
from minisplat_ref.rendering import SPLATTING
from minisplat_ref.training.representation import WORLD_UNITS
from minisplat_ref.types import Gaussians, Scene

DESCRIPTION = """\
Paint a trained scene in the style of an image. First the photographs get the
colours of the image, and large Gaussians are split while these are learned;
then base colours are trained so that renders have the features of the image.

RUN is a run that is rendered as 3DGS, without sky, exposures or poses. NEW is a
run folder for render, eval, info and convert, with a copy of the image. eval
compares it with the photographs, which are not in that style.

The features are classical filters (edges, stripes, colours), not VGG; --weights
takes those of a network, an .npz whose layout is in the docstring of
minisplat_ref/mechanisms/features/network.py.
"""
EPILOG = """\
example:
  minisplat-ref style transfer runs/fox waves.png --out runs/fox-waves"""

OTHER = "give the --out folder of a training that has ended"


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "transfer",
        help="paint a trained scene in the style of an image",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="the --out folder of a training")
    parser.add_argument("image", type=Path, metavar="IMAGE", help="the style")
    parser.add_argument("--out", type=Path, required=True, metavar="NEW", help="new folder for the painted scene")
    add_number(parser, "--iterations", 1000, "of each of the two stages")
    parser.add_argument(
        "--strength",
        type=integer(1),
        default=10,
        metavar="W",
        help="weight of the style: 10 for views all around (default), 100 for views\nthat all face forward",
    )
    parser.add_argument("--weights", type=Path, metavar="NPZ", help="features of a network of your own")
    parser.add_argument("--scene", type=Path, metavar="PATH", help="where the photographs are now, if they have moved")
    add_number(parser, "--seed", 0, "of the trainings", minimum=0, metavar="S")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, paint, write; nothing is left where one of these fails.

    Raises
    ------
    InputError
        The run, the image or the weights cannot be used, or NEW is there already.
    """
    from minisplat_ref.extensions.style.recipe import Plan, check_style, default_weights, read_style, stylise
    from minisplat_ref.io.atomic import making_folder
    from minisplat_ref.io.images import write_image
    from minisplat_ref.mechanisms.features.filters import CLASSICAL
    from minisplat_ref.mechanisms.features.network import load_bank

    if args.out.resolve() == args.run_folder.resolve():
        raise InputError(f"{args.out} is the run itself: give another --out")
    bank = CLASSICAL if args.weights is None else load_bank(args.weights)
    opened = open_run(args.run_folder, args.scene)
    camera = opened.scene.train_views[0].camera
    image = read_style(args.image, max(camera.width, camera.height))
    check_style(image / 255, bank, str(args.image))
    plan = Plan(bank, default_weights(bank, args.strength), args.iterations, args.seed)
    with making_folder(args.out) as folder, progress_bar("painting", "iterations", 2 * args.iterations) as bar:
        styled = stylise(
            opened.gaussians,
            opened.scene,
            image / 255,
            plan,
            conventions=opened.conventions,
            on_step=lambda _: bar.update(),
        )
        about = {
            "run": str(args.run_folder.resolve()),
            "image": str(args.image.resolve()),
            "features": bank.name,
            **plan.weights._asdict(),
            "iterations": args.iterations,
            "seed": args.seed,
        }
        write_run(folder, opened, styled.gaussians, about)
        write_image(folder / "style.png", image)
    print(
        f"{len(opened.gaussians.means):,} Gaussians became {len(styled.gaussians.means):,}; the run in {args.out} is"
        f" shown by minisplat-ref render {args.out}"
    )
    return 0


class OpenRun(NamedTuple):
    """A trained scene with its photographs, in the frame that it was trained in."""

    folder: Path
    config: Mapping[str, Any]
    gaussians: Gaussians
    scene: Scene
    conventions: Conventions


def open_run(folder: Path, scene: Path | None = None) -> OpenRun:
    """Read a run of Gaussians without further parameters.

    Parameters
    ----------
    folder : Path
    scene : Path, optional
        Where the photographs are now; where they were by default.

    Raises
    ------
    InputError
        There is no run, it has not ended, its photographs are not there, or it trains something else or more.
    """
    if not (folder / CONFIG).is_file() or not (folder / POINT_CLOUD).is_file():
        missing = CONFIG if not (folder / CONFIG).is_file() else POINT_CLOUD
        raise InputError(f"{folder} has no {missing}: {OTHER}")
    config = read_json(folder / CONFIG, OTHER)
    try:
        settings = config["settings"]
        name, extension, profile = settings["recipe"], settings["extension"], PROFILES[settings["profile"]]
        reading = {key: settings[key] for key in ("downscale", "test_every", "background", "undistort", "model")}
        reading["offset"] = settings.get("fold", 0)
        path, frame = Path(scene or settings["scene"]), frame_from_json(config.get("frame"))
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{folder / CONFIG} is not the configuration of a training of this version: {error}"
        ) from error
    representation = find_recipe(name, extension=extension).representation
    if (representation.population, representation.renderer) != (Gaussians, SPLATTING):
        raise InputError(f"{folder} is a run of recipe {name}, which is not rendered as 3DGS: give one of 3dgs-accel")
    if (folder / SHARED).exists():
        raise InputError(
            f"{folder} has parameters besides its Gaussians ({SHARED}: a sky, exposures or poses), which painting would"
            " have to undo: train without them, for example by recipe 3dgs-accel"
        )
    if frame is None:
        raise InputError(f"{folder / CONFIG} has a frame without an origin of three numbers and a unit above 0")
    if not path.exists():
        raise InputError(f"{path}, the scene of {folder}, is not there: --scene PATH says where it is now")
    gaussians = load_ply(folder / POINT_CLOUD)
    if len(gaussians.means) == 0:
        raise InputError(f"{folder} holds no Gaussians: {OTHER}")
    photographs = place_scene(load_scene(path, **reading), frame)
    return OpenRun(folder, config, place_population(gaussians, WORLD_UNITS, frame), photographs, profile)


def write_run(folder: Path, run: OpenRun, gaussians: Gaussians, about: Mapping[str, Any]) -> None:
    """Write the files that make a folder a run: configuration, Gaussians, cameras, and the number of Gaussians.

    Parameters
    ----------
    folder : Path
        Empty.
    run : OpenRun
        That was styled.
    gaussians : Gaussians
        In the run's frame.
    about : mapping
        How it was styled, for ``config.json``.
    """
    files = return_population(gaussians, WORLD_UNITS, run.scene.frame)
    save_ply(folder / POINT_CLOUD, files, NO_LABEL)
    _write_json(folder / CONFIG, {**run.config, "styled": dict(about)})
    if (run.folder / CAMERAS).exists():
        shutil.copyfile(run.folder / CAMERAS, folder / CAMERAS)
    metrics = {"n_gaussians": len(gaussians.means), "n_gaussians_before": len(run.gaussians.means)}
    _write_json(folder / METRICS, {**metrics, "iterations": run.config["settings"]["iterations"]})


def _write_json(path: Path, value: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
