"""The time of training iterations with a constant number of Gaussians.

It is measured by stages, on one thread and on all, and in comparison with OpenSplat.
"""

import statistics
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numba
import numpy as np

from minisplat_ref.backends import CPU, Backend
from minisplat_ref.bench.interleaving import seconds_of
from minisplat_ref.bench.opensplat import iteration_seconds
from minisplat_ref.bench.profiling import REST, WHOLE, profile_cases, time_stages
from minisplat_ref.bench.roofline import StraightLines
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.io import load_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.types import Scene

WARM_UP = 5  # iterations that compile and are not timed
TURNS = 2  # of each trainer
TURN = 10  # consecutive iterations on as many threads: after a few, the caches have this training and not the other
LINE = "straight line"
ROOM: dict[str, Any] = {"n_views": 6, "width": 192, "height": 144, "n_points": 8000}  # where no scene is given


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
    total = sum(_train(_scene(folder, downscale), iterations, time_stages(CPU, seconds), seconds.clear))
    return profile_cases(seconds, total, iterations)


def thread_cases(folder: Path | None, downscale: int, iterations: int) -> list[Case]:
    """Train twice, alternating every few iterations, on one thread and on all; return nothing if there is only one.

    In between, straight-line loops run as well, equal and independent ones for all threads: their speed-up is what the
    processor can give.

    Returns
    -------
    list of Case
        The least time of every stage and of the whole iteration. A stage with a factor near 1 does not run in parallel.
        All fail if the two trainings do not end with the same bytes.
    """
    n_all = numba.get_num_threads()
    if n_all == 1:
        return []
    scene, recipe = _scene(folder, downscale), get_recipe("3dgs-accel")._replace(events=())
    states = {n: initial_state(scene, recipe, seed=0) for n in (1, n_all)}
    lines = StraightLines(n_all)
    lines.forward()  # compiled
    measured: dict[int, list[dict[str, float]]] = {n: [] for n in states}
    try:
        for first in range(1, WARM_UP + iterations + 1, TURN):
            for n, state in states.items():
                numba.set_num_threads(n)
                for step in range(first, min(first + TURN, WARM_UP + iterations + 1)):
                    seconds: dict[str, float] = {}
                    start = time.perf_counter()
                    train(
                        scene, recipe._replace(iterations=step), seed=0, state=state, backend=time_stages(CPU, seconds)
                    )
                    total = time.perf_counter() - start
                    line = seconds_of(lines.forward)
                    measured[n].append({**seconds, REST: total - sum(seconds.values()), WHOLE: total, LINE: line})
    finally:
        numba.set_num_threads(n_all)
    one, all_ = (state.gaussians for state in states.values())
    is_same = all(np.array_equal(a, b) for a, b in zip(one, all_, strict=True))
    note = "" if is_same else "the trained Gaussians are not the same bytes"
    cases = []
    for stage in measured[1][0]:
        times = [min(seconds[stage] for seconds in measured[n][WARM_UP:]) for n in states]
        figures: dict[str, Figure] = {
            "1 thread ms": 1e3 * times[0],
            f"{n_all} threads ms": 1e3 * times[1],
            "x": times[0] / times[1],
        }
        cases.append(Case(f"threads/iteration/{stage}", is_same, figures, note))
    return cases


def against_opensplat(program: Path, folder: Path, downscale: int, iterations: int) -> list[Case]:
    """Time training iterations of OpenSplat and ours alternately, on the same photographs from the same points."""
    scene = load_scene(folder, downscale=downscale, test_every=0, undistort=True)  # it withholds no view
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(TURNS):
        theirs += iteration_seconds(program, folder, downscale, WARM_UP + iterations)[WARM_UP - 1 :]
        ours += _train(scene, iterations, CPU)
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


def _figures(seconds: list[float]) -> dict[str, Figure]:
    """Return the median of the iterations, and the least of them."""
    return {"iteration ms": 1e3 * statistics.median(seconds), "least ms": 1e3 * min(seconds)}


def _train(scene: Scene, iterations: int, backend: Backend, on_warm: Callable[[], None] = lambda: None) -> list[float]:
    """Return the seconds of each iteration, after some that compile."""
    recipe = get_recipe("3dgs-accel")._replace(iterations=WARM_UP + iterations, events=())
    ends: list[float] = []

    def on_step(step_report: object) -> None:
        ends.append(time.perf_counter())
        if len(ends) == WARM_UP:
            on_warm()

    train(scene, recipe, seed=0, backend=backend, on_step=on_step)
    return [end - start for start, end in pairwise(ends[WARM_UP - 1 :])]


def _scene(folder: Path | None, downscale: int) -> Scene:
    """Load the photographs, or make a synthetic scene."""
    if folder is None:
        return make_scene("room", **ROOM).scene
    return load_scene(folder, downscale=downscale, undistort=True)
