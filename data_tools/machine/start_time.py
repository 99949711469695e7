"""The time from program start to the end of the first training iteration, just after installation and later.

The command ``train`` runs on a small synthetic scene, with an empty folder for its kernels and then again with the same
one; its log tells when the first iteration is over.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.progress import read_log
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.oracle.cases import Case
from minisplat_ref.oracle.tolerances import BENCH_FLOAT32_LOSS
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.training.loop import train
from minisplat_ref.types import Scene

ROOM: dict[str, Any] = {"n_views": 2, "width": 48, "height": 36, "n_points": 300}
RECIPE = "3dgs-accel"
WARM_STARTS = 3  # the least of them is reported
POLL_SECONDS = 0.01


def start_cases() -> list[Case]:
    """Start cold, then warm.

    Returns
    -------
    list of Case
        A case fails if the loss of the iteration differs from the reference's, or if cold and warm differ in a byte.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_scene(make_scene("room", supersampling=1, **ROOM), folder / "room", ROOM)
        scene = load_scene(folder / "room", test_every=0)
        expected = _reference_loss(scene)
        seconds, losses, models = [], [], []
        for i in range(1 + WARM_STARTS):
            run = folder / f"run{i}"
            seconds.append(_start(folder / "room", run, folder / "kernels"))
            losses.append(read_log(run / run_folder.LOG)[-1]["loss"])
            models.append((run / run_folder.POINT_CLOUD).read_bytes())
    cases = []
    for label, time_, loss, model in (
        ("cold", seconds[0], losses[0], models[0]),
        ("warm", min(seconds[1:]), losses[1], models[1]),
    ):
        error = abs(loss - expected)
        note = "" if error <= BENCH_FLOAT32_LOSS else f"loss is off by {error:.1e}, more than {BENCH_FLOAT32_LOSS:.1e}"
        if model != models[-1]:
            note = "the trained Gaussians are not the same bytes every time"
        cases.append(Case(f"start/{label}", not note, {"first iteration s": time_, "error of loss": error}, note))
    return cases


def _reference_loss(scene: Scene) -> float:
    losses: list[float] = []
    recipe = get_recipe(RECIPE)._replace(iterations=1)
    train(scene, recipe, seed=0, backend=REFERENCE, on_step=lambda report: losses.append(report.loss))
    return losses[0]


def _start(scene: Path, run: Path, kernels: Path) -> float:
    """Train for one iteration; return the seconds until it was in the log."""
    options = ["--recipe", RECIPE, "--iterations", "1", "--test-every", "0", "--out", str(run)]
    command = [sys.executable, "-m", "minisplat_ref", "train", str(scene), *options]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(kernels)}
    start = time.perf_counter()
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        log = run / run_folder.LOG
        while process.poll() is None and not (log.exists() and log.stat().st_size):
            time.sleep(POLL_SECONDS)
        seconds = time.perf_counter() - start
        _, errors = process.communicate()
    if process.returncode != 0:
        last = errors.decode(errors="replace").strip().splitlines()[-1:] or ["it says nothing"]
        raise InputError(f"train failed with exit code {process.returncode}: {last[0]}")
    return seconds
