"""Phase 4: the Gaussians of all blocks, each from the block in whose core it lies, as an ordinary run.

Where blocks continue the training of the whole, so does the merged model: with the moments and statistics that its
Gaussians have in their blocks, it is trained for the last iterations on whole photographs.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from minisplat_ref.app.blocks.plan import COARSE, BlockTraining, Plan, Planned
from minisplat_ref.app.runs import checkpoints, run_folder
from minisplat_ref.app.runs.model_file import describe_parts
from minisplat_ref.app.runs.progress import read_log, write_log
from minisplat_ref.app.runs.scene_part import keep_rows
from minisplat_ref.app.runs.settings import (
    configure_recipe,
    find_owner,
    load_frame,
    load_model,
    place_model,
    return_model,
)
from minisplat_ref.io.frames import return_points
from minisplat_ref.strategy.ops import concat, contiguous, n_rows, take
from minisplat_ref.training.adam import AdamState, zero_moments
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.pace import Pace
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Bools, Floats, Scene


def merge(training: BlockTraining, plan: Plan, scene: Scene) -> tuple[TrainState, list[str]]:
    """Return the state of the merged model, and sentences about what is left out of it.

    It is that after the last iteration, or, where blocks are continued, after that at which they stop.

    Parameters
    ----------
    training : BlockTraining
    plan : Plan
        All of whose blocks are trained.
    scene : Scene
        The whole.
    """
    owner = find_owner(training.settings)
    recipe = configure_recipe(training.settings)._replace(starts_densely=False)
    parts, states, steps, notices = [], [], [], []
    for planned in plan.blocks:
        folder = training.run_folder_for(planned.block.name)
        settings, frame = plan.make_settings(training, planned), load_frame(folder)
        model = load_model(folder, settings)
        rows = find_core_rows(plan, planned, return_points(model.gaussians.means, frame))
        kept = model._replace(gaussians=take(model.gaussians, rows))
        placed = place_model(return_model(kept, owner, frame), owner, scene.frame)
        parts.append(placed.gaussians)
        steps.append(run_folder.measured_step(folder) or 0)
        if training.is_continued:
            states.append(keep_rows(checkpoints.load(folder, settings), rows))
        if model.shared:
            notices.append(f"block {planned.block.name} has {describe_parts(sorted(model.shared))} of its own")
    state = initial_state(scene, recipe, training.settings.seed)
    state.gaussians = contiguous(concat(*parts))
    state.adam = zero_moments(state.gaussians)
    state.rng = np.random.default_rng(training.settings.seed)
    state.step = training.settings.iterations - training.joint_iterations
    if states:
        state.adam = AdamState(_join(states, "first"), _join(states, "second"), state.step)
        state.stats = {name: np.concatenate([part.stats[name] for part in states]) for name in states[0].stats}
    if recipe.cooling is not None:
        state.step = max(steps)
        state.pace = Pace(cooling_from=state.step, last_step=state.step)
    return state, notices


def _join(states: Sequence[TrainState], moment: str) -> Any:
    """Return a moment of the Gaussians of all blocks."""
    return contiguous(concat(*(getattr(state.adam, moment) for state in states)))


def find_core_rows(plan: Plan, planned: Planned, points: Floats) -> Bools:
    """Return [P]: which points [P, 3], in the frame of the files, lie in the core of a block."""
    return planned.block.core.contains(plan.plane.coordinates(points))


def write_history(training: BlockTraining, plan: Plan, state: TrainState) -> None:
    """Write the log of the whole: the coarse training's, and a record of the end with the time of all trainings.

    Loss and PSNR of that record are the means of those in the blocks' own last records, over their pixels.
    """
    coarse = read_log(training.run_folder_for(COARSE) / run_folder.LOG)
    last = [read_log(training.run_folder_for(planned.block.name) / run_folder.LOG)[-1] for planned in plan.blocks]
    end = {
        "step": state.step,
        **{key: float(np.mean([record[key] for record in last])) for key in ("loss", "psnr")},
        "n_gaussians": n_rows(state.gaussians),
        "model_mb": sum(field.nbytes for field in state.gaussians) / 1e6,
        **{key: sum(record[key] for record in (coarse[-1], *last)) for key in ("seconds", "cpu_seconds")},
    }
    write_log(training.folder / run_folder.LOG, [*(record for record in coarse if record["step"] < state.step), end])
