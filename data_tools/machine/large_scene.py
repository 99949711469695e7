"""Trainings on photographs of 12 megapixels: compare the predicted peak of memory with the measured one.

Each is a training as ``train`` does it, in a separate process: checkpoint, some iterations, PLY and evaluation.
One has all photographs in memory. One has two thousand of them, which would take 72 GB, and as many Gaussians as fit
into 8 GB; it runs as if there were no more memory than that. Photographs are traced small and enlarged, and a few are
repeated under different names to make many views: their memory does not depend on their content.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from data_tools.machine.process_memory import bytes_in_use, forget_peak, peak
from minisplat_ref import memory
from minisplat_ref.app.runs import memory_needs
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.run import Training, run_training
from minisplat_ref.app.runs.settings import configure_recipe, load_photographs
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io.images import resize_image, write_image
from minisplat_ref.io.ply_file import write_vertices
from minisplat_ref.io.scene import rescale_camera
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Gaussians, Scene

SIZE = (4000, 3000)  # pixels
ENLARGED = 10  # times a side, from what is traced
N_TRACED = 8  # views, which larger scenes repeat
N_POINTS = 20_000
N_ITERATIONS = 6  # a PSNR is measured in the fifth and the last
TEST_EVERY = 4
TOLERANCE = 0.2  # of a predicted peak
WITHIN = 8e9  # bytes, of the whole process
SIGMA = 1.5  # pixels: standard deviation of the Gaussians that are given
RESULT = "result.json"
CHILD = "import sys; from data_tools.machine.large_scene import measure; measure(*sys.argv[1:])"
MEGA = 1e6


class Large(NamedTuple):
    """A training to be measured."""

    label: str
    n_photographs: int
    n_gaussians: int | None
    """None to start from the scene's points."""
    within: float | None
    """Bytes of memory to allow; None for those of the machine."""


MODERATE = Large("all in memory", N_TRACED, None, None)
LARGEST = Large("within 8 GB", 2000, 5_000_000, WITHIN)


def large_case(large: Large) -> Case:
    """Measure; the case fails if the peak is not near the prediction, or exceeds the allowed memory.

    Raises
    ------
    InputError
        The system does not say how much memory a process uses, or the process ends prematurely.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_photographs(folder / "small", N_TRACED, 1)
        write_photographs(folder / "large", large.n_photographs, ENLARGED)
        arguments = [name, json.dumps(large.n_gaussians), json.dumps(large.within)]
        done = subprocess.run([sys.executable, "-c", CHILD, *arguments], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            last = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
            raise InputError(f"memory cannot be measured: {last[0]}")
        result = json.loads((folder / RESULT).read_text())
    ratio = result["peak"] / result["foreseen"]
    problems = [] if abs(ratio - 1) <= TOLERANCE else [f"the peak is not within {TOLERANCE:.0%} of the foreseen one"]
    if large.within is not None and result["process"] > large.within:
        problems.append(f"the process took more than {memory.as_text(large.within)}")
    figures: dict[str, Figure] = {
        "photographs": large.n_photographs,
        "GB if all in memory": large.n_photographs * memory.PHOTOGRAPH_BYTES * SIZE[0] * SIZE[1] / 1e9,
        "Gaussians": result["n_gaussians"],
        "foreseen MB": result["foreseen"] / MEGA,
        "peak MB": result["peak"] / MEGA,
        "x foreseen": ratio,
        "whole process MB": result["process"] / MEGA,
    }
    note = "; ".join(problems) or result["note"]
    return Case(f"{large.label}/{large.n_photographs} x {SIZE[0]} x {SIZE[1]}", not problems, figures, note)


def write_photographs(folder: Path, n: int, enlarged: int) -> None:
    """Write a made scene of ``n`` photographs with a transforms.json; beyond N_TRACED they are links to the first."""
    width, height = SIZE[0] // ENLARGED, SIZE[1] // ENLARGED
    scene = make_scene("room", n_views=N_TRACED, width=width, height=height, n_points=N_POINTS, supersampling=1).scene
    views = (*scene.train_views, *scene.test_views)[:N_TRACED]
    (folder / "images").mkdir(parents=True)
    frames: list[dict[str, Any]] = []
    for i in range(n):
        view, name = views[i % N_TRACED], f"images/{i:04d}.jpg"
        if i < N_TRACED:
            write_image(folder / name, resize_image(view.image, width * enlarged, height * enlarged))
        else:
            os.link(folder / frames[i % N_TRACED]["file_path"], folder / name)
        world_from_cam = np.eye(4)
        world_from_cam[:3, :3] = view.camera.cam_from_world_R.T * (1, -1, -1)  # axes of OpenGL: y up, z backward
        world_from_cam[:3, 3] = view.camera.center
        frames.append({"file_path": name, "transform_matrix": world_from_cam.tolist()})
    camera = rescale_camera(views[0].camera, width * enlarged, height * enlarged)
    columns = dict(zip(("x", "y", "z"), scene.points.T, strict=True))
    columns |= dict(zip(("red", "green", "blue"), scene.point_colors.T, strict=True))
    write_vertices(folder / "points.ply", columns)
    content = {
        **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
        **{"w": camera.width, "h": camera.height, "ply_file_path": "points.ply", "frames": frames},
    }
    (folder / "transforms.json").write_text(json.dumps(content))


def measure(folder: str, n_gaussians: str, within: str) -> None:
    """Train on the scenes in a folder, and store there the memory of the larger one; runs in its own process."""
    path, n, most = Path(folder), json.loads(n_gaussians), json.loads(within)
    _train(path / "small", path / "first", None)  # loads the kernels
    note = forget_peak()
    with patch.object(
        memory, "free_bytes", memory.free_bytes if most is None else lambda: memory.RESERVE * (most - bytes_in_use())
    ):
        result = _train(path / "large", path / "run", n)
    (path / RESULT).write_text(json.dumps({**result, "note": note}))


def _train(scene_folder: Path, out: Path, n: int | None) -> dict[str, float]:
    """Train; return predicted and measured peaks, beyond the memory used before, and that of the process."""
    settings = Settings(
        scene=str(scene_folder),
        test_every=TEST_EVERY,
        recipe="3dgs-accel",
        schedule_iterations=N_ITERATIONS,
        iterations=N_ITERATIONS,
    )
    recipe = configure_recipe(settings)._replace(events=())  # the number of Gaussians stays
    scene = load_photographs(settings)
    before = bytes_in_use()
    state = initial_state(scene, recipe, settings.seed) if n is None else _state(scene, n)
    needs = memory_needs.foresee(scene, state, GSPLAT_MAIN, CPU)
    out.mkdir()
    run_training(Training(out, scene, settings, recipe, state))
    return {"foreseen": needs.at_the_peak, "peak": peak() - before, "process": peak(), "n_gaussians": needs.n_rows}


def _state(scene: Scene, n: int) -> TrainState:
    """Return ``n`` Gaussians around the scene's points, a few pixels in size each, as at the end of a training."""
    rng, camera = np.random.default_rng(0), scene.train_views[0].camera
    depth = np.median((scene.points @ camera.cam_from_world_R.T + camera.cam_from_world_t)[:, 2])
    sigma = SIGMA * depth / camera.fx
    means = scene.points.astype(np.float32)[rng.integers(len(scene.points), size=n)]
    means += np.float32(10 * sigma) * rng.standard_normal((n, 3), np.float32)
    gaussians = Gaussians(
        means=means,
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        log_scales=np.full((n, 3), np.log(sigma), np.float32),
        opacity_logits=np.zeros(n, np.float32),
        sh_dc=np.zeros((n, 3), np.float32),
        sh_rest=np.zeros((n, 15, 3), np.float32),
    )
    return TrainState(gaussians, zero_moments(gaussians), 0, [], rng, {})
