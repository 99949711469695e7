"""Time OpenSplat, a trainer in C++, through its command line; the options are those of version 1.2.

It prints a line in every iteration, and only the arrival times of these lines are used: the median over single
iterations is robust against other programs that run now and then, unlike the difference of two whole runs. Its
renderings are not compared here; ``oracle compare`` does that with its dumps.

Its iteration is made as similar to ours as its options allow. The number of Gaussians is constant, because it never
reaches a refinement. It stays in its densifying phase, because afterwards it would step its optimiser only in every
32nd or 64th iteration. These differences remain: it steps the SH coefficients above degree 0 in every 16th iteration,
all other parameters of all Gaussians in every one, and it accumulates the statistics that a refinement would use.

It renders with its own threads, while the OpenMP threads of its libtorch spin as they wait and take the cores from
them, which on a busy machine multiplies its time. They are told to sleep.
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
        Folder of a COLMAP scene. Any other is passed on as it is.
    downscale : int
        Factor by which the photographs are reduced.
    iterations : int
        Of the training, on the processor.

    Returns
    -------
    seconds : list of float
        ``iterations - 1`` of them.

    Raises
    ------
    InputError
        It cannot be run, fails, or does not report iterations.
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
    """Return a folder from which it reads the same cameras and points as we do.

    It prefers a transforms.json to a COLMAP model, and stops if that names no points; of COLMAP's two formats it reads
    only the binary one. So it gets a folder with a binary model and links to the photographs, and nothing else.
    """
    if find_model(scene) is None:
        return scene
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    read_model(scene).write_binary(str(model))
    for images in ("images", "masks"):
        if (scene / images).is_dir():
            (folder / images).symlink_to(scene / images, target_is_directory=True)
    return folder


def check_program(program: Path) -> None:
    """Raise an InputError unless the program can be run, before anything else takes time."""
    if not program.is_file() or not os.access(program, os.X_OK):
        raise InputError(f"{program} is not a program: give opensplat=PATH of OpenSplat's executable")
