"""The trainings of a comparison: each in a separate process, whose peak memory is its own; in turn, or by workers.

A comparison that was cut off continues where it was: finished runs stay, one with a checkpoint continues from it.
"""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from minisplat_ref.app.comparison.plan import Plan, Run, load_plan
from minisplat_ref.app.runs.cluster import Workers, carry_out_all
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.trainings import HEADINGS, Status, find_status, spell_remaining_command, train_here
from minisplat_ref.app.runs.worker import Job
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.arguments import option_name
from minisplat_ref.training.loop import train
from minisplat_ref.types import Scene

WARM_UP = 20  # iterations, to which each recipe is scaled, so that all its events happen
WARM_UP_VIEWS = 4


def warm_up(plan: Plan, scene: Scene) -> None:
    """Train every recipe for a moment, so that the clock of no run includes compilation that the next run is spared."""
    scene = scene._replace(train_views=scene.train_views[:WARM_UP_VIEWS])
    for recipe in plan.recipes:
        # So short a schedule may be impossible; a fault of the recipe itself appears in its own run.
        with contextlib.suppress(InputError):
            train(scene, find_recipe(recipe, WARM_UP), seed=0)


def statuses(plan: Plan) -> list[Status]:
    """Return the status of each of the plan's trainings.

    Raises
    ------
    InputError
        Instead of a run folder there is a run with other settings, or something else.
    """
    return [find_status(run.folder, make_settings(plan, run)) for run in plan.runs]


def train_all(plan: Plan, statuses: Sequence[Status]) -> int:
    """Train every recipe with every seed and fold, as far as it goes.

    Parameters
    ----------
    plan : Plan
    statuses : sequence of Status
        How far each of its trainings has come; see :func:`statuses`.

    Returns
    -------
    int
        Exit code of the first training that fails, 0 if none does.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C or SIGTERM, when the running training has saved its state.
    CalledProcessError
        A training has been killed or has a programming error.
    """
    for number, status in enumerate(statuses):
        print(_name(plan, number) + HEADINGS[status], flush=True)  # before the lines of the other process
        words = next_words(plan, number)
        code = 0 if words is None else train_here(words)
        if code != 0:
            return code
    return 0


def train_by_workers(plan: Plan, statuses: Sequence[Status], workers: Workers) -> int:
    """Train like :func:`train_all`, several at once; when a training fails, the others are still carried out.

    Parameters
    ----------
    plan : Plan
        As ``plan.json`` of its folder has it, which the workers read.
    statuses : sequence of Status
    workers : Workers

    Raises
    ------
    InputError
        The workers cannot be used; see :func:`minisplat_ref.app.runs.cluster.carry_out_all`.
    """
    folder = plan.folder.resolve()
    jobs = []
    for number, status in enumerate(statuses):
        print(_name(plan, number) + HEADINGS[status], flush=True)
        if status != "finished":
            run_of = folder / plan.runs[number].folder.name
            jobs.append(Job(_name(plan, number), stored_words, (folder, number), run_of))
    inputs = [plan.scene, *map(Path, plan.files.values())]
    return carry_out_all(workers, jobs, folder, inputs, lambda job: print(f"{job.name}: ended", flush=True))


def stored_words(folder: Path, number: int) -> list[str] | None:
    """Return :func:`next_words` of the comparison in a folder."""
    return next_words(load_plan(folder), number)


def next_words(plan: Plan, number: int) -> list[str] | None:
    """Return the command that completes a training, as words; None if it has ended.

    Files of a training without a checkpoint are removed.

    Parameters
    ----------
    plan : Plan
    number : int
        Index of the training in ``plan.runs``.
    """
    run = plan.runs[number]
    return spell_remaining_command(run.folder, make_settings(plan, run), _first_words(plan, run))


def _first_words(plan: Plan, run: Run) -> list[str]:
    options = {**_options(plan, run), "out": run.folder}
    texts = [part for name, value in options.items() for part in (option_name(name), str(value))]
    return ["train", str(plan.scene), *texts]


def _name(plan: Plan, number: int) -> str:
    run = plan.runs[number]
    fold = "" if plan.folds is None else f" fold {run.fold},"
    return f"run {number + 1} of {len(plan.runs)}: {run.recipe},{fold} seed {run.seed}, {run.iterations} iterations"


def make_settings(plan: Plan, run: Run) -> Settings:
    """Return the settings with which ``train`` is called for a run, as its config.json has them."""
    return Settings(
        scene=str(plan.scene.resolve()),
        schedule_iterations=run.iterations,
        **_options(plan, run),
    )


def _options(plan: Plan, run: Run) -> dict[str, Any]:
    """Return the options of ``train`` for a run, by the names that they have in Settings."""
    return {
        "recipe": run.recipe,
        "iterations": run.iterations,
        "seed": run.seed,
        "downscale": plan.downscale,
        "test_every": plan.test_every,
        **({} if plan.folds is None else {"fold": run.fold}),
        "eval_every": run.eval_every,
        **plan.files,
        **run.options,
    }
