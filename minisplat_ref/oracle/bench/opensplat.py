"""OpenSplat, a trainer in C++, timed through its command line; the options are those of version 1.2.

Nothing that it prints is read: it trains twice, for n and for 2n iterations, and the difference of the two times is
that of n iterations, without loading and start. What it renders is not compared here; ``oracle compare`` does that with
its dumps.

Its iteration is made as like ours as its options allow. The number of Gaussians stays, because it never comes to a
refinement. It counts as densifying all the while, because afterwards it would step its optimiser in every 32nd or 64th
iteration only. What remains different: it steps the SH coefficients above degree 0 in every 16th iteration, all other
parameters of all Gaussians in every one, and it adds up the statistics that a refinement would use.
"""

import os
import subprocess
import tempfile
import time
from pathlib import Path

from minisplat_ref.errors import InputError
from minisplat_ref.io.colmap import find_model, read_model

NEVER = 10**9  # iterations
FIXED_POPULATION = ("--num-downscales", "0", "--refine-every", str(NEVER), "--densify-until", str(NEVER))


def training_seconds(program: Path, scene: Path, downscale: int, iterations: int) -> float:
    """Return the seconds that a whole run takes, loading included.

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

    Raises
    ------
    InputError
        It cannot be run, or fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        options = ["-n", str(iterations), "-d", str(downscale), *FIXED_POPULATION, "--cpu"]
        laid_out = _lay_out(scene.resolve(), Path(folder) / "scene")
        command = [str(program.resolve()), str(laid_out), *options, "-o", str(Path(folder) / "out.ply")]
        start = time.perf_counter()
        try:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        except OSError as error:
            raise InputError(f"{program} cannot be run: {error.strerror}") from error
        seconds = time.perf_counter() - start
    if done.returncode != 0:
        first = (done.stderr or done.stdout).strip().splitlines()[:1] or ["it says nothing"]
        raise InputError(f"{program} failed with exit code {done.returncode}: {first[0]}")
    return seconds


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
