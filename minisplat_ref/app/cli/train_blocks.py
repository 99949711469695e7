"""``train --blocks``: one scene in blocks, begun or continued."""

import shutil
import sys
from typing import TYPE_CHECKING, Any

from minisplat_ref.app.runs.options import Settings
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import option_name

if TYPE_CHECKING:
    from minisplat_ref.app.blocks.plan import Asked
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


def refuse_options(given: dict[str, Any]) -> None:
    """Refuse options of a training of the whole, unless they say what holds without them, as those of --config may."""
    for name, instead in WHOLE_ONLY.items():
        if name in given and given[name] != getattr(Settings, name, None):
            raise InputError(f"{option_name(name)} does not go with --blocks ({instead}): leave it out")


def start(asked: "Asked", recipe: "Recipe", scene: "Scene", state: "TrainState") -> None:
    """Make the folder of a training in blocks, after everything that can be checked before it has been.

    Parameters
    ----------
    asked : Asked
    recipe, scene, state
        Of a training of the whole.
    """
    import numpy as np

    from minisplat_ref.app.blocks.grid import divide, ground_plane
    from minisplat_ref.app.blocks.plan import begin
    from minisplat_ref.app.blocks.train import check
    from minisplat_ref.app.runs.settings import to_config

    check(asked.settings, recipe, state)
    centers = np.stack([view.camera.center for view in scene.train_views])
    divide(ground_plane(centers).coordinates(centers), asked.shape)
    begin(asked, to_config(asked.settings, recipe, scene))


def go_on(asked: "Asked", workers: "Workers") -> "tuple[Scene, Recipe, TrainState] | int":
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
