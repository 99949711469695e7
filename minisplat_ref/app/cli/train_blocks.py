"""``train --blocks``: one scene in blocks, begun or continued."""

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.app.runs.options import NEW_ON_RESUME, Settings
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import option_name

if TYPE_CHECKING:
    from minisplat_ref.app.blocks.plan import Asked
    from minisplat_ref.app.cli.train import Request
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


def begin(folder: Path, settings: Settings, shape: tuple[int, int], request: "Request") -> int:
    """Begin a training in blocks in a new folder; return the exit code."""
    import numpy as np

    from minisplat_ref.app.blocks.grid import divide, ground_plane
    from minisplat_ref.app.blocks.plan import Asked, create_folder
    from minisplat_ref.app.blocks.train import check
    from minisplat_ref.app.runs import run_folder
    from minisplat_ref.app.runs.preparation import prepare
    from minisplat_ref.app.runs.settings import to_config

    _refuse_options(settings, request)
    run_folder.check_free(folder)
    training = prepare(folder, settings)
    recipe, scene = training.recipe, training.scene
    check(settings, recipe, training.state)
    centers = np.stack([view.camera.center for view in scene.train_views])
    divide(ground_plane(centers).coordinates(centers), shape)
    asked = Asked(folder, settings, shape)
    create_folder(asked, to_config(settings, recipe, scene))
    return _complete(asked, request)


def _refuse_options(settings: Settings, request: "Request") -> None:
    """Refuse options of a training of the whole, unless they say what holds without them, as those of --config may."""
    given = {**vars(settings), "preview": request.preview or None, "view": request.view}
    for name, instead in WHOLE_ONLY.items():
        if given[name] != getattr(Settings, name, None):
            raise InputError(f"{option_name(name)} does not go with --blocks ({instead}): leave it out")


def resume(folder: Path, request: "Request") -> int:
    """Continue the training in blocks in a folder; return the exit code."""
    from minisplat_ref.app.blocks.plan import load_asked

    surplus = [option_name(name) for name in NEW_ON_RESUME if name in request.given]
    surplus += ["--scene"] if request.moved is not None else []
    surplus += ["--rescale"] if request.rescale else []
    if surplus:
        raise InputError(f"the blocks of {folder} have not ended: leave out {surplus[0]}")
    return _complete(load_asked(folder), request)


def _complete(asked: "Asked", request: "Request") -> int:
    """Train in blocks from where that is, and end like a run of the whole; return the exit code."""
    from minisplat_ref.app.cli.train_whole import complete
    from minisplat_ref.app.runs.cluster import Workers
    from minisplat_ref.app.runs.run import Training
    from minisplat_ref.app.runs.run_folder import hold_folder

    end = _train_blocks(asked, Workers(request.workers, request.cluster))
    if isinstance(end, int):
        return end
    with hold_folder(asked.folder):
        scene, recipe, state = end
        return complete(Training(asked.folder, scene, asked.settings, recipe, state), request)


def _train_blocks(asked: "Asked", workers: "Workers") -> "tuple[Scene, Recipe, TrainState] | int":
    """Do what is left of the four phases; return what the run of the whole ends with, or an exit code."""
    from minisplat_ref.app.blocks.train import merged, plan_blocks, train_blocks, train_coarse
    from minisplat_ref.app.runs.worker import INTERRUPTED

    try:
        code = train_coarse(asked, workers)
        if code == 0:
            plan = plan_blocks(asked)
            code = train_blocks(asked, plan, workers)
            if code == 0:
                return merged(asked, plan)
    except KeyboardInterrupt:
        code = INTERRUPTED
    if code == INTERRUPTED:
        how = f"minisplat-ref train --resume {asked.folder}"
        print(f"minisplat-ref: interrupted; to continue: {how}", file=sys.stderr)
    else:
        _remove_if_unused(asked)
    return code


def _remove_if_unused(asked: "Asked") -> None:
    """Take back the folder if even the coarse training was refused."""
    from minisplat_ref.app.blocks.plan import COARSE, PLAN

    if asked.run_folder_of(COARSE).exists():
        return
    (asked.folder / PLAN).unlink()
    shutil.rmtree(asked.blocks_folder)
    asked.folder.rmdir()
