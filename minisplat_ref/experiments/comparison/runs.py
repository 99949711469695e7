"""The trainings of a comparison: one after the other, each in a process of its own, whose peak memory is its own."""

import contextlib
import signal
import subprocess
import sys

from minisplat_ref.errors import InputError
from minisplat_ref.experiments.comparison.plan import Plan, Run, eval_every
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.training.loop import train
from minisplat_ref.types import Scene

WARM_UP = 20  # iterations, to which each recipe is scaled, so that all its events happen
WARM_UP_VIEWS = 4
SAVING_SECONDS = 5.0  # after Ctrl-C; a training that goes on for longer has not been told

REPORTED_CODES = (0, 2, 130)  # after which the training has said all there is to say


def warm_up(plan: Plan, scene: Scene) -> None:
    """Train every recipe for a moment: no run's clock is to count compiling what the next run finds compiled."""
    scene = scene._replace(train_views=scene.train_views[:WARM_UP_VIEWS])
    for recipe in plan.recipes:
        # So short a schedule may ask for what cannot be; a fault of the recipe itself shows in its own run.
        with contextlib.suppress(InputError):
            train(scene, find_recipe(recipe, WARM_UP), seed=0)


def train_all(plan: Plan) -> int:
    """Train every recipe with every seed, as far as it goes.

    Returns
    -------
    int
        Exit code of the first training that fails, 0 if none does.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C, when the running training has saved what there is.
    CalledProcessError
        A training has been killed or has a programming error.
    """
    runs = plan.runs
    for number, run in enumerate(runs, start=1):
        heading = f"run {number} of {len(runs)}: {run.recipe}, seed {run.seed}, {run.iterations} iterations"
        print(heading, flush=True)  # before the lines of the other process
        code = _train(_command(plan, run))
        if code != 0:
            return code
    return 0


def _command(plan: Plan, run: Run) -> list[str]:
    options = {
        "recipe": run.recipe,
        "iterations": run.iterations,
        "seed": run.seed,
        "downscale": plan.downscale,
        "test_every": plan.test_every,
        "eval_every": eval_every(run.iterations),
        "out": run.folder,
        **{name: file for name, file in plan.files.items() if file is not None},
        **run.options,
    }
    texts = [part for name, value in options.items() for part in (f"--{name.replace('_', '-')}", str(value))]
    return [sys.executable, "-m", "minisplat_ref", "train", str(plan.scene), *texts]


def _train(command: list[str]) -> int:
    with subprocess.Popen(command) as process:
        try:
            code = process.wait()
        except KeyboardInterrupt:
            # A terminal's Ctrl-C has reached the training, too, which saves now and is better left alone.
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(SAVING_SECONDS)
            process.send_signal(signal.SIGINT)  # does nothing when the training has ended
            process.wait()
            raise
    if code not in REPORTED_CODES:
        raise subprocess.CalledProcessError(code, command)
    return code
