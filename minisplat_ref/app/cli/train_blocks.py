"""``train --blocks``: one scene in blocks, begun or continued."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.app.runs.options import NEW_ON_RESUME, Settings
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import option_name

if TYPE_CHECKING:
    from minisplat_ref.app.blocks.plan import BlockTraining
    from minisplat_ref.app.cli.train import TrainOptions
    from minisplat_ref.app.runs.cluster import Workers
    from minisplat_ref.training.schedule import Recipe
    from minisplat_ref.training.state import TrainState
    from minisplat_ref.types import Scene

WHOLE_ONLY = {
    "init": "blocks start from a coarse model",
    "minutes": "give --iterations",
    "budget": "minisplat-ref simplify makes the result smaller",
    "max_drop": "minisplat-ref simplify does that to the result",
    "max_bytes": "minisplat-ref simplify does that to the result",
    "eval_every": "the whole is there only in the end",
    "lpips_weights": "minisplat-ref eval measures the result by it",
    "preview": "the whole is there only in the end",
    "view": "minisplat-ref view shows the result",
}
"""Options that a training in blocks refuses, and what to do or why."""


def begin(folder: Path, settings: Settings, shape: tuple[int, int], options: "TrainOptions") -> int:
    """Begin a training in blocks in a new folder; return the exit code."""
    import numpy as np

    from minisplat_ref.app.blocks.grid import divide, ground_plane
    from minisplat_ref.app.blocks.plan import BlockTraining, create_folder
    from minisplat_ref.app.blocks.train import check
    from minisplat_ref.app.runs import run_folder
    from minisplat_ref.app.runs.preparation import prepare
    from minisplat_ref.app.runs.settings import to_config
    from minisplat_ref.training.calibration import EXPOSURE, NONE

    _refuse_options(settings, options)
    run_folder.check_free(folder)
    if EXPOSURE.name not in settings.set:  # every block has a mean exposure of its own
        settings = replace(settings, set={**settings.set, EXPOSURE.name: NONE})
    whole = prepare(folder, settings)
    recipe, scene = whole.recipe, whole.scene
    check(settings, recipe, whole.state)
    centers = np.stack([view.camera.center for view in scene.train_views])
    divide(ground_plane(centers).coordinates(centers), shape)
    training = BlockTraining(folder, settings, shape)
    create_folder(training, to_config(settings, recipe, scene))
    return _complete(training, options)


def _refuse_options(settings: Settings, options: "TrainOptions") -> None:
    """Refuse options of a training of the whole, unless they say what holds without them, as those of --config may."""
    given = {**vars(settings), "preview": options.preview or None, "view": options.view}
    for name, instead in WHOLE_ONLY.items():
        if given[name] != getattr(Settings, name, None):
            raise InputError(f"{option_name(name)} does not go with --blocks ({instead}): leave it out")


def resume(folder: Path, options: "TrainOptions") -> int:
    """Continue the training in blocks in a folder; return the exit code."""
    from minisplat_ref.app.blocks.plan import load_block_training

    surplus = [option_name(name) for name in NEW_ON_RESUME if name in options.given]
    surplus += ["--scene"] if options.moved is not None else []
    surplus += ["--rescale"] if options.rescale else []
    if surplus:
        raise InputError(f"the blocks of {folder} have not ended: leave out {surplus[0]}")
    return _complete(load_block_training(folder), options)


def _complete(training: "BlockTraining", options: "TrainOptions") -> int:
    """Train in blocks from where that is, and end like a run of the whole; return the exit code."""
    from minisplat_ref.app.cli.train_whole import complete
    from minisplat_ref.app.runs.cluster import Workers
    from minisplat_ref.app.runs.run import Training
    from minisplat_ref.app.runs.run_folder import hold_folder

    end = _train_blocks(training, Workers(options.workers, options.cluster))
    if isinstance(end, int):
        return end
    with hold_folder(training.folder):
        scene, recipe, state = end
        return complete(Training(training.folder, scene, training.settings, recipe, state), options)


def _train_blocks(training: "BlockTraining", workers: "Workers") -> "tuple[Scene, Recipe, TrainState] | int":
    """Do what is left of the four phases; return what the run of the whole ends with, or an exit code."""
    from minisplat_ref.app.blocks.train import merge_blocks, plan_blocks, train_blocks, train_coarse
    from minisplat_ref.app.runs.worker import INTERRUPTED

    try:
        code = train_coarse(training, workers)
        if code == 0:
            plan = plan_blocks(training)
            code = train_blocks(training, plan, workers)
            if code == 0:
                return merge_blocks(training, plan)
    except KeyboardInterrupt:
        code = INTERRUPTED
    if code == INTERRUPTED:
        how = f"minisplat-ref train --resume {training.folder}"
        print(f"minisplat-ref: interrupted; to continue: {how}", file=sys.stderr)
    else:
        _remove_if_unused(training)
    return code


def _remove_if_unused(training: "BlockTraining") -> None:
    """Take back the folder if even the coarse training was refused."""
    from minisplat_ref.app.blocks.plan import COARSE, PLAN

    if training.run_folder_for(COARSE).exists():
        return
    (training.folder / PLAN).unlink()
    shutil.rmtree(training.blocks_folder)
    training.folder.rmdir()
