"""The memory that training takes: a few iterations on 200,000 Gaussians in 1920 x 1080, in a separate process.

There are several iterations, because moments are first written at the end of the first, and some memory passes from one
iteration to the next. The figure is the peak of that process beyond its memory before the Gaussians existed, with all
kernels loaded. The bound is what every training needs (:mod:`minisplat_ref.memory`): the model, Adam's two moments, the
gradients, the images of an iteration, 150 bytes for the intermediate values of every Gaussian in a view, and 48 for
every pair (tile, Gaussian).
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.machine.process_memory import bytes_in_use, forget_peak, peak
from data_tools.machine.slopes import FOCAL_OF_WIDTH, LARGE, flipped_pixels
from minisplat_ref import memory
from minisplat_ref.bench.workloads import synth
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.oracle.tolerances import BENCH_FLIPPED_PIXELS
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Camera, Gaussians

N, SIZE = 200_000, LARGE
N_ITERATIONS = 4
N_REST = 15  # coefficients of degree 3 beyond the constant
INPUTS, IMAGE, RESULT = "inputs.npz", "image.npy", "result.json"
CHILD = "import sys; from data_tools.machine.peak_memory import measure; measure(sys.argv[1])"
MEGA = 1e6


def memory_case() -> Case:
    """Measure; the case fails if the image of the first iteration is not that of the float64 kernels.

    Raises
    ------
    InputError
        The system does not say how much memory a process uses, or the process ends prematurely.
    """
    width, height = SIZE
    workload = synth(N, width, height, FOCAL_OF_WIDTH * width)
    sh_rest = 0.05 * np.random.default_rng(2).normal(size=(N, N_REST, 3))
    gaussians = Gaussians._make(f.astype(np.float32) for f in workload.gaussians._replace(sh_rest=sh_rest))
    with tempfile.TemporaryDirectory() as folder:
        camera: dict[str, Any] = {
            f"camera_{name}": value for name, value in zip(Camera._fields[:8], workload.camera, strict=False)
        }
        np.savez(Path(folder) / INPUTS, **gaussians._asdict(), **camera)
        done = subprocess.run([sys.executable, "-c", CHILD, folder], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            last = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
            raise InputError(f"memory cannot be measured: {last[0]}")
        result = json.loads((Path(folder) / RESULT).read_text())
        image = np.load(Path(folder) / IMAGE)

    exact = Gaussians._make(field.astype(np.float64) for field in gaussians)
    output, tape = render(exact, workload.camera, sh_degree=0, backend=CPU)
    n_pairs = len(tape.splats.bins.gaussian_ids)
    model = sum(field.nbytes for field in gaussians)
    terms = {
        "model": model,
        "moments": 2 * model,
        "gradients": model,
        "images": (memory.PHOTOGRAPH_BYTES + memory.IMAGE_BYTES) * width * height,
        "Gaussians": memory.BYTES_PER_GAUSSIAN * N,
        "pairs": memory.BYTES_PER_PAIR * n_pairs,
    }
    bound = sum(terms.values())
    figures: dict[str, Figure] = {
        "peak MB": result["bytes"] / MEGA,
        "bound MB": bound / MEGA,
        "x bound": result["bytes"] / bound,
        **{f"{name} MB": n_bytes / MEGA for name, n_bytes in terms.items()},
        "pairs": n_pairs,
    }
    passed = flipped_pixels(image, output.image) <= BENCH_FLIPPED_PIXELS
    note = result["note"] if passed else "the image is not that of float64"
    return Case(f"memory/{N:,} Gaussians, {width} x {height}", passed, figures, note)


def measure(folder: str) -> None:
    """Train on the inputs in a folder, and store the first image and the peak there; runs in its own process."""
    from minisplat_ref.methods import get_recipe
    from minisplat_ref.training.adam import zero_moments
    from minisplat_ref.training.loop import train
    from minisplat_ref.training.state import StepReport, TrainState
    from minisplat_ref.types import Scene, View

    recipe = get_recipe("3dgs-accel")._replace(iterations=N_ITERATIONS, events=())
    path = Path(folder)

    def iterate(gaussians: Gaussians, camera: Camera) -> None:
        photograph = np.zeros((camera.height, camera.width, 3), np.uint8)
        views = (View("view", camera, photograph, None),)
        scene = Scene("synth", views, (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)
        state = TrainState(gaussians, zero_moments(gaussians), 0, [], np.random.default_rng(0), {})

        def on_step(report: StepReport) -> None:
            if report.step == 1:
                np.save(path / IMAGE, report.output.image)

        train(scene, recipe, seed=0, state=state, on_step=on_step)

    small = synth(500, 64, 48, 50.0)
    iterate(Gaussians._make(field.astype(np.float32) for field in small.gaussians), small.camera)  # loads the kernels
    note = forget_peak()
    before = peak() if note else bytes_in_use()
    with np.load(path / INPUTS) as inputs:
        gaussians = Gaussians._make(inputs[name] for name in Gaussians._fields)
        camera = Camera(*(_plain(inputs[f"camera_{name}"]) for name in Camera._fields[:8]))
    iterate(gaussians, camera)
    n_bytes = peak() - before
    (path / RESULT).write_text(json.dumps({"bytes": n_bytes, "note": note}))


def _plain(value: np.ndarray) -> Any:
    return value.item() if value.ndim == 0 else value
