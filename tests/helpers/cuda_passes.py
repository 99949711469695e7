"""Run both passes of the backend cuda in Numba's simulator: their results, and what they ask of the device.

``NUMBA_ENABLE_CUDASIM=1 python cuda_passes.py FILE`` writes a pickle. The cases and their inputs are functions of this
file, so that the tests can give the same inputs to the reference.
"""

import pickle
import sys
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN, INRIA, Conventions
from minisplat_ref.types import Camera, Gaussians
from scenes import as_dtype, make_camera, make_gaussians

A_MILLION, FULL_HD = 1_000_000, (1920, 1080)


class Case(NamedTuple):
    """A scene and how it is rendered."""

    dtype: type
    conventions: Conventions
    size: tuple[int, int]
    n_gaussians: int
    is_deterministic: bool
    with_stats: bool
    is_mixed: bool
    """Whether Gaussians differ in their degrees, and some are not rendered."""


CASES = {
    "plain": Case(np.float32, GSPLAT_MAIN._replace(is_antialiased=True), (18, 17), 34, True, False, False),
    "mixed": Case(np.float64, INRIA, (12, 9), 9, False, False, True),
}
SMALL = Case(np.float32, GSPLAT_MAIN, (12, 9), 6, True, True, False)


def make_inputs(case: Case) -> tuple[Gaussians, Camera, dict[str, Any]]:
    """The Gaussians, the camera, and the keyword arguments of ``render`` and of the gradient."""
    rng = np.random.default_rng(case.n_gaussians)
    width, height = case.size
    camera = make_camera(width, height, fx=1.2 * width, fy=1.3 * width, cx=0.45 * width, rng=rng)
    g = make_gaussians(rng, case.n_gaussians)
    g.means[2:4, 2] = -1  # behind the camera
    g.sh_dc[:] *= 3  # some colours are negative in one channel
    given: dict[str, Any] = {"background": rng.uniform(size=3), "sh_degree": 3, "is_visible": None}
    if case.is_mixed:
        given["sh_degree"] = np.arange(case.n_gaussians) % 4
        given["is_visible"] = np.arange(case.n_gaussians) % 5 > 0
    given["v"] = rng.normal(size=(height, width, 3)), rng.normal(size=(height, width))
    given["v"] = tuple(x.astype(case.dtype) for x in given["v"])
    given["background"] = given["background"].astype(case.dtype)
    return as_dtype(g, case.dtype), camera, given


def run_case(case: Case, capacity: int | None = None) -> dict[str, Any]:
    """The image, the statistics and the gradient, in a second attempt if there was no room in the first."""
    from minisplat_ref.cuda import tiling
    from minisplat_ref.cuda.arrays import to_device, to_host
    from minisplat_ref.cuda.passes import Options, Passes

    g, camera, given = make_inputs(case)
    passes = Passes(case.is_deterministic)
    passes._capacity = capacity or 0
    rules = given["background"], given["sh_degree"], case.conventions, given["is_visible"], case.with_stats
    attempts = []
    while True:
        tape = passes.render(to_device(g), camera, Options(*rules))
        v = passes.render_vjp(tape, *map(to_device, given["v"]))
        output = to_host(tape.output._replace(extras={}))
        found = {"output": output, "radii": to_host(tape.footprints.radii), "v": to_host(v)}
        held = sum(array.size * array.dtype.itemsize for array in passes._workspace._memory.values())
        with patch.object(tiling, "check_room") as room:
            n_pairs = passes.count_pairs(tape)
        asked = [call.args[0] for call in room.call_args_list]
        attempts.append({**found, "n_pairs": n_pairs, "capacity": tape.capacity, "held": held, "asked": asked})
        if attempts[-1]["n_pairs"] <= tape.capacity:
            return {**attempts[-1], "attempts": attempts}


def count_in_steady_state(n: int, size: tuple[int, int], *, runs: bool) -> list[list[Any]]:
    """What both passes ask of the device, in a first round and in a second."""
    from data_tools.device_work import count_rounds, rounds_of_passes

    return count_rounds(rounds_of_passes(n, size, 0.1 if runs else None), runs=runs)


def main(path):
    """Write what came out to a file."""
    results = {name: run_case(case) for name, case in CASES.items()}
    small = run_case(SMALL)
    again = run_case(SMALL, small["n_pairs"] - 1)
    counts = count_in_steady_state(4, (9, 7), runs=True), count_in_steady_state(A_MILLION, FULL_HD, runs=False)
    Path(path).write_bytes(pickle.dumps((results, (small, again), counts)))


if __name__ == "__main__":
    main(sys.argv[1])
