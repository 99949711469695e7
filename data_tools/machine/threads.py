"""The gain of more threads: of a view, and of a training iteration by stages."""

import time
from collections.abc import Sequence
from pathlib import Path

import numba
import numpy as np

from data_tools.machine.contests import Contest
from data_tools.machine.roofline import StraightLines
from minisplat_ref.bench.interleaving import Times, measure_seconds
from minisplat_ref.bench.profiling import REST, WHOLE, time_stages
from minisplat_ref.bench.training_time import WARM_UP, load_or_make_scene
from minisplat_ref.bench.workloads import Workload
from minisplat_ref.methods import get_recipe
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.types import Gaussians

BLOCK = 10  # consecutive iterations on as many threads: after a few, the caches have this training and not the other
LINE = "straight line"


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
    scene, recipe = load_or_make_scene(folder, downscale), get_recipe("3dgs-accel")._replace(events=())
    states = {n: initial_state(scene, recipe, seed=0) for n in (1, n_all)}
    lines = StraightLines(n_all)
    lines.forward()  # compiled
    measured: dict[int, list[dict[str, float]]] = {n: [] for n in states}
    try:
        for first in range(1, WARM_UP + iterations + 1, BLOCK):
            for n, state in states.items():
                numba.set_num_threads(n)
                for step in range(first, min(first + BLOCK, WARM_UP + iterations + 1)):
                    seconds: dict[str, float] = {}
                    start = time.perf_counter()
                    train(
                        scene, recipe._replace(iterations=step), seed=0, state=state, backend=time_stages(CPU, seconds)
                    )
                    total = time.perf_counter() - start
                    line = measure_seconds(lines.forward)
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


def threads(workload: Workload) -> list[Contest]:
    """Return contests of forward and backward on one thread and on all; none if there is only one thread."""
    n_all = numba.get_num_threads()
    if n_all == 1:
        return []
    gaussians, v_image = (
        Gaussians._make(field.astype(np.float32) for field in workload.gaussians),
        workload.v_image.astype(np.float32),
    )

    def gradient(n_threads: int) -> Gaussians:
        numba.set_num_threads(n_threads)
        try:
            return render_vjp(render(gaussians, workload.camera)[1], v_image).gaussians
        finally:
            numba.set_num_threads(n_all)

    def judge(times: Sequence[Times]) -> list[Case]:
        one, all_ = (1e3 * own.minimum for own in times)
        is_same = all(np.array_equal(a, b) for a, b in zip(gradient(1), gradient(n_all), strict=True))
        figures: dict[str, Figure] = {"1 thread ms": one, f"{n_all} threads ms": all_, "x": one / all_}
        note = "" if is_same else "the gradients are not the same bytes"
        return [Case(f"threads/{workload.name}", is_same, figures, note)]

    return [Contest((lambda: gradient(1), lambda: gradient(n_all)), judge)]
