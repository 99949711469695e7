"""``train``: from photographs with cameras to a folder with Gaussians, metrics and images."""

import argparse
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from minisplat_ref.app.runs.options import HIDDEN, N_ITERATIONS, NEW_ON_RESUME, OPTIONS, Settings, add_settings
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import (
    VIEWER_PORT,
    Commands,
    HelpFormatter,
    add_worker_arguments,
    integer,
    option_name,
)

DESCRIPTION = """\
Train Gaussians on SCENE, the folder of a COLMAP scene or of a transforms.json.
DIR will hold report.html, point_cloud.ply, metrics.json, renders/, checkpoints.
"""
EPILOG = """\
example:
  minisplat-ref train photos/fox --downscale 2 --minutes 5 --preview"""


def add_parser(commands: Commands) -> None:
    """Add the command. Options that are not given are absent, so that ``--resume`` can tell."""
    parser = commands.add_parser(
        "train",
        help="train Gaussians on photographs with cameras",
        usage="minisplat-ref train [-h] SCENE [options]\n       minisplat-ref train --resume DIR [--iterations N]",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    parser.add_argument("scene", nargs="?", metavar="SCENE", help=HIDDEN)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="new folder for the results (default runs/SCENE-RECIPE)"
    )
    parser.add_argument(
        "--resume", type=Path, metavar="DIR", help="continue the run in DIR; Ctrl-C saves what there is"
    )
    parser.add_argument("--scene", dest="moved", metavar="PATH", help="with --resume: where its photographs are now")
    parser.add_argument("--rescale", action="store_true", help="with --resume: stretch its schedule to --iterations")

    parser.add_argument("--preview", action="store_true", help="keep DIR/preview.png up to date; --view: in a browser")
    parser.add_argument(
        "--blocks", type=_shape, metavar="AxB", help="in A x B parts; at once: --workers N, --cluster ADDRESS"
    )
    add_settings(parser, "block", "whole_iterations")  # one of them
    add_worker_arguments(parser, argparse.SUPPRESS, argparse.SUPPRESS)
    parser.add_argument("--view", nargs="?", type=integer(0), const=VIEWER_PORT, metavar="PORT", help=HIDDEN)

    data = parser.add_argument_group("photographs")
    add_settings(data, "downscale", "test_every", "fold", "background", "undistort", "model")
    training = parser.add_argument_group("training")
    add_settings(training, "recipe")
    training.add_argument("--config", type=Path, metavar="RUN", help="run, or its config.json, whose settings to take")
    add_settings(training, "init", "iterations", "minutes", "budget")
    add_settings(training.add_mutually_exclusive_group(), "max_drop", "max_bytes")
    add_settings(training, "simplify", "scene_type", "extension", "set", "eval_every", "lpips_weights", "seed")
    training.add_argument(
        "--check-every", type=integer(1), metavar="K", help="look for NaN every K steps (10); --drop-bad-steps: skip"
    )
    add_settings(training, "drop_bad_steps", "profile", "backend")
    parser.set_defaults(run=run, recommends=True)


@dataclass(frozen=True)
class TrainOptions:
    """The arguments of ``train``, read from the command line once."""

    given: Mapping[str, Any]
    """Settings of the run that are given, by the names of their fields."""
    scene: str | None = None
    out: Path | None = None
    resume: Path | None = None
    """The run that is continued."""
    moved: str | None = None
    """Where its photographs are now."""
    rescale: bool = False
    config: Path | None = None
    blocks: tuple[int, int] | None = None
    workers: int = 0
    cluster: str | None = None
    preview: bool = False
    view: int | None = None
    """Port of the viewer in the browser."""
    check_every: int | None = None
    server: Any = None
    """The viewer's, which takes the port before the scene is read."""

    def with_config(self) -> "TrainOptions":
        """Return the options with the settings of --config where the command line has none."""
        if self.config is None:
            return self
        from minisplat_ref.app.runs.run_folder import CONFIG
        from minisplat_ref.app.runs.settings import load

        config = load(self.config.parent if self.config.name == CONFIG else self.config)
        given = {name: getattr(config, name) for name in OPTIONS} | dict(self.given)
        given["set"] = [*config.set.items(), *self.given.get("set", ())]
        return replace(self, given=given, scene=config.scene if self.scene is None else self.scene)

    def new_settings(self) -> Settings:
        """Return the settings of a run that begins; what is not given has its default."""
        if self.scene is None:
            raise InputError("give a SCENE to train on, or --resume DIR to continue a run")
        if self.moved is not None or self.rescale:
            surplus = "--rescale" if self.moved is None else "--scene"
            raise InputError(f"{surplus} is for a run that is continued: leave it out, or give --resume DIR")
        values = {**self.given, "set": dict(self.given.get("set", ()))}  # of equal names the last
        iterations = values.pop("iterations", None) or _default_iterations(values.get("recipe", Settings.recipe))
        return Settings(
            scene=str(Path(self.scene).resolve()), iterations=iterations, schedule_iterations=iterations, **values
        )

    def continued_settings(self, settings: Settings) -> Settings:
        """Return the settings with which a run that has these is continued."""
        settings = replace(settings, **self.given)
        if self.moved is not None:
            settings = replace(settings, scene=str(Path(self.moved).resolve()))
        return replace(settings, schedule_iterations=settings.iterations) if self.rescale else settings


def read_options(args: argparse.Namespace) -> TrainOptions:
    """Return the options of parsed arguments."""
    given = {name: getattr(args, name) for name in OPTIONS if name in args}
    return TrainOptions(given, **{f.name: getattr(args, f.name) for f in fields(TrainOptions) if f.name in args})


def run(args: argparse.Namespace) -> int:
    """Train, or continue a training; nothing is written before the input has been read and found good."""
    from minisplat_ref.training.interruption import terminated_like_interrupted

    options = read_options(args)
    if options.view is not None:
        from minisplat_ref.app.viewer.browser import open_server

        options = replace(options, server=open_server(options.view, "training"))
    with terminated_like_interrupted():
        return _begin(options.with_config()) if options.resume is None else _resume(options.resume, options)


def _begin(options: TrainOptions) -> int:
    """Begin a training, of the whole scene or in blocks."""
    settings = options.new_settings()
    assert options.scene is not None
    if options.blocks is not None and settings.block is not None:
        raise InputError("--block is one part of a training in --blocks: give one of the two")
    scene = Path(options.scene)
    scene_folder = scene.parent if scene.is_file() else scene
    folder = options.out or Path("runs") / f"{scene_folder.resolve().name}-{settings.recipe}"

    from minisplat_ref.app.cli import train_blocks, train_whole

    if options.blocks is not None:
        return train_blocks.begin(folder, settings, options.blocks, options)
    if options.workers or options.cluster:
        raise InputError("--workers and --cluster train blocks at once: give --blocks AxB, too, or leave them out")
    return train_whole.begin(folder, settings, options)


def _resume(folder: Path, options: TrainOptions) -> int:
    """Continue a training, of the whole scene or in blocks."""
    surplus = [name for name in ("scene", "out", "config") if getattr(options, name) is not None]
    surplus += [name for name in OPTIONS if name in options.given and name not in NEW_ON_RESUME]
    if surplus:
        raise InputError(
            f"--resume takes the run's own settings: leave out {', '.join(option_name(name) for name in surplus)}"
        )

    from minisplat_ref.app.blocks.train import is_unfinished
    from minisplat_ref.app.cli import train_blocks, train_whole

    return train_blocks.resume(folder, options) if is_unfinished(folder) else train_whole.resume(folder, options)


def _default_iterations(name: str) -> int:
    """Return how long a recipe is trained unless told otherwise: one that decides it itself, as long as it takes."""
    from minisplat_ref.extensions.extension import find_recipe

    recipe = find_recipe(name)
    return N_ITERATIONS if recipe.cooling is None else recipe.iterations


def _shape(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d{0,3})[xX]([1-9]\d{0,3})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of blocks along two axes such as 2x2")
    return int(match[1]), int(match[2])
