"""The time of training iterations with a constant number of Gaussians: by stages, and in comparison with OpenSplat."""

import statistics
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

from minisplat_ref.bench.opensplat import iteration_seconds
from minisplat_ref.bench.profiling import profile_cases, time_stages
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.io import load_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.rendering.backends import CPU, Backend
from minisplat_ref.training.loop import train
from minisplat_ref.types import Scene

WARM_UP = 5  # iterations that compile and are not time_stages
TURNS = 2  # of each trainer
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
    total = sum(_train(load_or_make_scene(folder, downscale), iterations, time_stages(CPU, seconds), seconds.clear))
    return profile_cases(seconds, total, iterations)


def compare_opensplat(program: Path, folder: Path, downscale: int, iterations: int) -> list[Case]:
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
    """Return the median and the minimum of the iterations' times."""
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


def load_or_make_scene(folder: Path | None, downscale: int) -> Scene:
    """Load the photographs, or make a synthetic scene."""
    if folder is None:
        return make_scene("room", **ROOM).scene
    return load_scene(folder, downscale=downscale, undistort=True)
