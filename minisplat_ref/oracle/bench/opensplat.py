"""OpenSplat, a trainer in C++, timed through its command line.

Only options that its help lists are used, and nothing that it prints is read: it trains twice, for n and for 2n
iterations, and the difference of the two times is that of n iterations, without loading and start. What it renders is
not compared here; ``oracle compare`` does that with its dumps. Its newest version steps the optimiser in some of the
iterations only, so that an iteration of its is less work than one of ours.
"""

import os
import subprocess
import tempfile
import time
from pathlib import Path

from minisplat_ref.errors import InputError


def training_seconds(program: Path, scene: Path, downscale: int, iterations: int) -> float:
    """Return the seconds that a whole run takes, loading included.

    Parameters
    ----------
    program : Path
        OpenSplat's executable.
    scene : Path
        Folder that it can read, as COLMAP leaves it.
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
        options = ["-n", str(iterations), "-d", str(downscale), "--num-downscales", "0", "--cpu"]
        command = [str(program.resolve()), str(scene.resolve()), *options, "-o", str(Path(folder) / "out.ply")]
        start = time.perf_counter()
        try:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        except OSError as error:
            raise InputError(f"{program} cannot be run: {error.strerror}") from error
        seconds = time.perf_counter() - start
    if done.returncode != 0:
        last = (done.stderr or done.stdout).strip().splitlines()[-1:] or ["it says nothing"]
        raise InputError(f"{program} failed with exit code {done.returncode}: {last[0]}")
    return seconds


def check_program(program: Path) -> None:
    """Raise an InputError unless there is something to run, before anything else takes its time."""
    if not program.is_file() or not os.access(program, os.X_OK):
        raise InputError(f"{program} is not a program: give opensplat=PATH of OpenSplat's executable")
