"""What training iterations cost, while the number of Gaussians stays the same: by stages, and beside OpenSplat's."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from data_tools.synthetic import make_scene
from minisplat_ref.backends import CPU, Backend
from minisplat_ref.io import load_scene
from minisplat_ref.oracle.bench.opensplat import training_seconds
from minisplat_ref.oracle.bench.profiling import profile_cases, timed
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.recipes import get_recipe
from minisplat_ref.train import train
from minisplat_ref.types import Scene

WARM_UP = 5  # iterations that compile and are not timed
ROOM: dict[str, Any] = {"n_views": 6, "width": 192, "height": 144, "n_points": 8000}  # where no scene is given


def profile(folder: Path | None, downscale: int, iterations: int) -> list[Case]:
    """Train with a stopwatch in every stage.

    Parameters
    ----------
    folder : Path or None
        Photographs; a made room where there are none.
    downscale : int
        Factor by which they are made smaller.
    iterations : int
        To time.
    """
    seconds: dict[str, float] = {}
    total = _train(_scene(folder, downscale), iterations, timed(CPU, seconds), seconds.clear)
    return profile_cases(seconds, total, iterations)


def against_opensplat(program: Path, folder: Path, downscale: int, iterations: int) -> list[Case]:
    """Time training iterations of OpenSplat and ours on the same photographs, from the same points, by turns."""
    n = iterations
    scene = load_scene(folder, downscale=downscale, test_every=0, undistort=True)  # it withholds no view
    first = training_seconds(program, folder, downscale, n)
    ours = _train(scene, n, CPU)
    theirs = training_seconds(program, folder, downscale, 2 * n) - first
    ours = min(ours, _train(scene, n, CPU))
    figures: dict[str, Figure] = {"iteration ms": 1e3 * theirs / n, "x ours": theirs / ours}
    camera = scene.train_views[0].camera
    work = f"of {n} iterations, {len(scene.points):,} Gaussians, {camera.width} x {camera.height}"
    note = f"{work}; what it renders is not compared here" if theirs > 0 else "no time to tell apart"
    return [
        Case(f"{scene.name}/cpu-f32 training", True, {"iteration ms": 1e3 * ours / n}, work),
        Case(f"{scene.name}/opensplat training", theirs > 0, figures, note),
    ]


def _train(scene: Scene, iterations: int, backend: Backend, on_warm: Callable[[], None] = lambda: None) -> float:
    """Return the seconds of some iterations, after some that compile."""
    recipe = get_recipe("3dgs-accel")._replace(iterations=WARM_UP + iterations, events=())
    ends: list[float] = []

    def on_step(step_report: object) -> None:
        ends.append(time.perf_counter())
        if len(ends) == WARM_UP:
            on_warm()

    train(scene, recipe, seed=0, backend=backend, on_step=on_step)
    return ends[-1] - ends[WARM_UP - 1]


def _scene(folder: Path | None, downscale: int) -> Scene:
    """Load the photographs, or make some."""
    if folder is None:
        return make_scene("room", **ROOM).scene
    return load_scene(folder, downscale=downscale, undistort=True)
