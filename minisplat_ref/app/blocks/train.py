"""The four phases of a training in blocks, each from where it was: coarse, plan, blocks, merge.

The trainings are processes, one by one or by workers; plan and merge are done here. Everything that a phase needs is on
disk, so that a run that was killed anywhere continues, and ends with the same bytes.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from minisplat_ref.app.blocks.merge import merge, write_history
from minisplat_ref.app.blocks.picture import draw_plan
from minisplat_ref.app.blocks.plan import (
    COARSE,
    PLAN,
    BlockTraining,
    Plan,
    describe,
    load_block_training,
    load_coarse,
    load_plan,
    make_plan,
    save_plan,
    too_large,
)
from minisplat_ref.app.runs.cluster import Workers, carry_out_all
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.run_folder import BLOCK_PLAN, has_begun
from minisplat_ref.app.runs.settings import configure_recipe, list_photographs, load_frame, load_photographs
from minisplat_ref.app.runs.trainings import HEADINGS, find_status, spell_command, spell_remaining_command, train_here
from minisplat_ref.app.runs.worker import Job
from minisplat_ref.errors import InputError
from minisplat_ref.io.frames import return_camera
from minisplat_ref.memory import free_bytes
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Scene


def check(settings: Settings, recipe: Recipe, state: TrainState) -> None:
    """Refuse a recipe whose model is more than Gaussians that can be concatenated.

    Parameters
    ----------
    settings : Settings
    recipe : Recipe
    state : TrainState
        Before the first iteration.

    Raises
    ------
    InputError
        It trains parameters that belong to no Gaussian, or reads photographs of other lenses as they are.
    """
    representation = recipe.representation
    if state.shared:
        raise InputError(
            f"--blocks merges Gaussians, and recipe {settings.recipe} also trains {', '.join(sorted(state.shared))} of"
            " the whole scene: take another recipe, or leave out what switches that on"
        )
    if representation.takes_optics and not settings.undistort:
        raise InputError(f"--blocks needs photographs without distortion, not recipe {settings.recipe}: --undistort")
    if representation.from_file is not None:
        raise InputError(f"--blocks starts from a coarse model, which recipe {settings.recipe} cannot")


def train_coarse(training: BlockTraining, workers: Workers) -> int:
    """Train the coarse model to its end; return the exit code."""
    return _train(training, {COARSE: training.coarse}, workers)


def plan_blocks(training: BlockTraining) -> Plan:
    """Return the plan; make it, and its picture, if there is none yet.

    Raises
    ------
    InputError
        See :func:`.plan.make_plan`.
    """
    plan = load_plan(training.folder)
    if plan is not None:
        return plan
    frame = load_frame(training.run_folder_for(COARSE))
    listing = list_photographs(training.coarse)
    scene = load_photographs(training.coarse, frame, listing)
    coarse = load_coarse(training, scene)
    centers = np.stack([return_camera(view.camera, frame).center for view in scene.train_views])  # [V, 3]
    plan = make_plan(training, listing, scene, coarse, centers)
    draw_plan(plan, centers, coarse.means, training.folder / BLOCK_PLAN)
    save_plan(training, plan)
    print(describe(training, plan))
    return plan


def train_blocks(training: BlockTraining, plan: Plan, workers: Workers) -> int:
    """Train all blocks to their ends; return the exit code."""
    warning = too_large(training, plan, max(workers.n, 1), free_bytes())
    if workers.address is None and warning is not None:
        print(f"minisplat-ref: {warning}", file=sys.stderr)
    return _train(
        training, {planned.block.name: plan.make_settings(training, planned) for planned in plan.blocks}, workers
    )


def merge_blocks(training: BlockTraining, plan: Plan) -> tuple[Scene, Recipe, TrainState]:
    """Return the end of the run of the whole; parts that a merge leaves out are reported."""
    scene = load_photographs(training.settings)
    state, left_out = merge(training, plan, scene)
    for sentence in left_out:
        print(f"minisplat-ref: {sentence}, which the merged model does not have")
    write_history(training, plan, state)
    return scene, configure_recipe(training.settings), state


def is_unfinished(folder: Path) -> bool:
    """Return whether a folder holds a training in blocks that has not been merged."""
    return (folder / PLAN).exists() and not has_begun(folder)


def _train(training: BlockTraining, trainings: dict[str, Settings], workers: Workers) -> int:
    """Complete trainings, one by one or by workers; return the exit code."""
    jobs, folder = [], training.folder.resolve()
    for name, settings in trainings.items():
        run = training.run_folder_for(name)
        status = find_status(run, settings)
        print(f"{_title(name)}, {settings.iterations} iterations{HEADINGS[status]}", flush=True)
        if status == "finished":
            continue
        if workers.is_used:
            jobs.append(Job(_title(name), next_words, (folder, name), run.resolve()))
            continue
        words = spell_remaining_command(run, settings, spell_command(settings, run))
        code = 0 if words is None else train_here(words)
        if code != 0:
            return code
    inputs = [Path(training.settings.scene)]
    return carry_out_all(workers, jobs, folder, inputs, lambda job: print(f"{job.name}: ended", flush=True))


def _title(name: str) -> str:
    return "coarse model" if name == COARSE else f"block {name}"


def next_words(folder: Path, name: str) -> Sequence[str] | None:
    """Return the command that completes the training of a folder; called on the worker."""
    training = load_block_training(folder)
    if name == COARSE:
        settings = training.coarse
    else:
        plan = load_plan(folder)
        assert plan is not None
        settings = next(plan.make_settings(training, p) for p in plan.blocks if p.block.name == name)
    run = training.run_folder_for(name)
    return spell_remaining_command(run, settings, spell_command(settings, run))
