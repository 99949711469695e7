"""The time of training iterations with a constant number of primitives.

By stages, in comparison with OpenSplat, and of other recipes in comparison with ``3dgs-accel``.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from minisplat_ref.bench.opensplat import iteration_seconds
from minisplat_ref.bench.profiling import profile_cases, time_stages
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.io import load_scene
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.rendering.backends import CPU, Backend
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import StepReport
from minisplat_ref.types import Scene

WARM_UP = 5  # iterations that compile and are not time_stages
TURNS = 2  # of each trainer
BASELINE = "3dgs-accel"
ROOM: dict[str, Any] = {"n_views": 6, "width": 192, "height": 144, "n_points": 8000}  # where no scene is given
DENSE_ROOM: dict[str, Any] = {"n_views": 4, "width": 270, "height": 480, "n_points": 50_000, "supersampling": 1}
"""The same where recipes are compared: as many primitives as a training has after its density control."""


def profile(folder: Path | None, downscale: int, iterations: int) -> list[Case]:
    """Train with a timer around every stage.

    Parameters
    ----------
    folder : Path or None
        Photographs; a synthetic room if None.
    downscale : int
        Factor by which they are reduced.
    iterations : int
        To time.
    """
    seconds: dict[str, float] = {}
    scene, backend = load_or_make_scene(folder, downscale), time_stages(CPU, seconds)
    total = sum(_train(scene, find_recipe(BASELINE), iterations, backend=backend, on_warm=seconds.clear))
    return profile_cases(seconds, total, iterations)


def compare_opensplat(program: Path, folder: Path, downscale: int, iterations: int) -> list[Case]:
    """Time training iterations of OpenSplat and ours alternately, on the same photographs from the same points."""
    scene = load_scene(folder, downscale=downscale, test_every=0, undistort=True)  # it withholds no view
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(TURNS):
        theirs += iteration_seconds(program, folder, downscale, WARM_UP + iterations)[WARM_UP - 1 :]
        ours += _train(scene, find_recipe(BASELINE), iterations)
    camera = scene.train_views[0].camera
    work = f"of {len(ours)} iterations, {len(scene.points):,} Gaussians, {camera.width} x {camera.height}"
    ratio: dict[str, Figure] = {"x ours": statistics.median(theirs) / statistics.median(ours)}
    return [
        Case(f"{scene.name}/cpu-f32 training", True, _figures(ours), work),
        Case(
            f"{scene.name}/opensplat training",
            True,
            {**_figures(theirs), **ratio},
            f"{work}; what it renders is not compared here",
        ),
    ]


def compare_recipes(names: Sequence[str], folder: Path | None, downscale: int, iterations: int) -> list[Case]:
    """Time training iterations of recipes beside those of ``3dgs-accel``, in processor time summed over the threads.

    All begin with the same points. None has events, and all terms of a loss count from the first iteration on, so that
    an iteration does what it does late in a training.

    Parameters
    ----------
    names : sequence of str
        Recipes.
    folder : Path or None
        Photographs; a synthetic room if None.
    downscale : int
        Factor by which they are reduced.
    iterations : int
        To time, in each of two turns.

    Raises
    ------
    InputError
        There is no such recipe, or the photographs cannot be used.
    """
    recipes = [find_recipe(name) for name in dict.fromkeys((BASELINE, *names))]
    scene = load_or_make_scene(folder, downscale, DENSE_ROOM)
    seconds: dict[str, list[float]] = {recipe.name: [] for recipe in recipes}
    counts: dict[str, int] = {}
    for _ in range(TURNS):
        for recipe in recipes:
            losses = tuple(term._replace(start=0, stop=None) for term in recipe.losses)

            def count(report: StepReport, name: str = recipe.name) -> None:
                counts[name] = report.n_gaussians

            undated = recipe._replace(losses=losses)
            seconds[recipe.name] += _train(scene, undated, iterations, clock=time.process_time, on_step=count)
    baseline = min(seconds[BASELINE])
    return [
        Case(
            f"{scene.name}/{name}",
            True,
            {**_figures(times), f"x {BASELINE}": min(times) / baseline, "primitives": counts[name]},
        )
        for name, times in seconds.items()
    ]


def _figures(seconds: list[float]) -> dict[str, Figure]:
    """Return the median and the minimum of the iterations' times."""
    return {"iteration ms": 1e3 * statistics.median(seconds), "least ms": 1e3 * min(seconds)}


def _train(
    scene: Scene,
    recipe: Recipe,
    iterations: int,
    *,
    backend: Backend = CPU,
    clock: Callable[[], float] = time.perf_counter,
    on_warm: Callable[[], None] = lambda: None,
    on_step: Callable[[StepReport], None] = lambda _: None,
) -> list[float]:
    """Return the seconds of each iteration without events, after some that compile."""
    ends: list[float] = []

    def end_step(report: StepReport) -> None:
        ends.append(clock())
        if len(ends) == WARM_UP:
            on_warm()
        on_step(report)

    timed = recipe._replace(iterations=WARM_UP + iterations, events=())
    train(scene, timed, seed=0, backend=backend, on_step=end_step)
    return [end - start for start, end in pairwise(ends[WARM_UP - 1 :])]


def load_or_make_scene(folder: Path | None, downscale: int, room: dict[str, Any] | None = None) -> Scene:
    """Load the photographs, or make a synthetic room: ``ROOM`` by default."""
    if folder is None:
        return make_scene("room", **(ROOM if room is None else room)).scene
    return load_scene(folder, downscale=downscale, undistort=True)
