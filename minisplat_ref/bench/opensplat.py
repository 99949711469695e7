"""OpenSplat, a trainer in C++, timed through its command line; the options are those of version 1.2.

It prints a line in every iteration, and when a line comes is all that is read of it: times of single iterations have a
median, which survives that other programs run now and then, and the difference of two whole runs does not. What it
renders is not compared here; ``oracle compare`` does that with its dumps.

Its iteration is made as like ours as its options allow. The number of Gaussians stays, because it never comes to a
refinement. It counts as densifying all the while, because afterwards it would step its optimiser in every 32nd or 64th
iteration only. What remains different: it steps the SH coefficients above degree 0 in every 16th iteration, all other
parameters of all Gaussians in every one, and it adds up the statistics that a refinement would use.

It draws with threads of its own, while those of OpenMP, which its libtorch calculates with, spin while they wait
for more and take the cores from them, which on a busy machine costs it a multiple of its time. They are told to sleep.
"""

import os
import subprocess
import tempfile
import time
from itertools import pairwise
from pathlib import Path

from minisplat_ref.errors import InputError
from minisplat_ref.io.colmap import find_model, read_model

NEVER = 10**9  # iterations
FIXED_POPULATION = ("--num-downscales", "0", "--refine-every", str(NEVER), "--densify-until", str(NEVER))
SLEEPING_THREADS = {"OMP_WAIT_POLICY": "PASSIVE"}


def iteration_seconds(program: Path, scene: Path, downscale: int, iterations: int) -> list[float]:
    """Train, and return the seconds from each iteration to the next.

    Parameters
    ----------
    program : Path
        OpenSplat's executable.
    scene : Path
        Folder of a COLMAP scene. Any other is handed over as it is.
    downscale : int
        Factor by which the photographs are made smaller.
    iterations : int
        Of the training, on the processor.

    Returns
    -------
    seconds : list of float
        ``iterations - 1`` of them.

    Raises
    ------
    InputError
        It cannot be run, or fails, or does not say when an iteration is over.
    """
    with tempfile.TemporaryDirectory() as folder:
        options = ["-n", str(iterations), "-d", str(downscale), *FIXED_POPULATION, "--cpu"]
        laid_out = _lay_out(scene.resolve(), Path(folder) / "scene")
        command = [str(program.resolve()), str(laid_out), *options, "-o", str(Path(folder) / "out.ply")]
        with (Path(folder) / "errors").open("w+") as errors:
            try:
                process = subprocess.Popen(
                    command,
                    cwd=folder,
                    env={**SLEEPING_THREADS, **os.environ},
                    stdout=subprocess.PIPE,
                    stderr=errors,
                    text=True,
                )
            except OSError as error:
                raise InputError(f"{program} cannot be run: {error.strerror}") from error
            with process:
                assert process.stdout is not None
                times = [time.perf_counter() for line in process.stdout if line.startswith("Step ")]
            errors.seek(0)
            first = errors.read().strip().splitlines()[:1] or ["it says nothing"]
    if process.returncode != 0:
        raise InputError(f"{program} failed with exit code {process.returncode}: {first[0]}")
    if len(times) != iterations:
        raise InputError(f"{program} printed {len(times)} lines for {iterations} iterations: OpenSplat 1.2 prints each")
    return [later - earlier for earlier, later in pairwise(times)]


def _lay_out(scene: Path, folder: Path) -> Path:
    """Return a folder from which it reads the cameras and points that we read.

    It takes a transforms.json before a COLMAP model, and stops where that names no points; and of COLMAP's two formats
    it reads the binary one. So it gets a folder with a binary model and links to the pictures, and nothing else.
    """
    if find_model(scene) is None:
        return scene
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    read_model(scene).write_binary(str(model))
    for pictures in ("images", "masks"):
        if (scene / pictures).is_dir():
            (folder / pictures).symlink_to(scene / pictures, target_is_directory=True)
    return folder


def check_program(program: Path) -> None:
    """Raise an InputError unless there is something to run, before anything else takes its time."""
    if not program.is_file() or not os.access(program, os.X_OK):
        raise InputError(f"{program} is not a program: give opensplat=PATH of OpenSplat's executable")
