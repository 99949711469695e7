"""The worker's side of a job: check that it is of this version and sees the files, run the command, and wait.

A job becomes a command in a separate process, so that its peak memory and its threads are its own, and nothing but
names and paths crosses the network. The process has one Numba thread, unless the worker sets NUMBA_NUM_THREADS. A file
beside the results, the token, exists while the results are awaited: when it is gone, the command is told to save and to
end, as by Ctrl-C.
"""

import hashlib
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np

import minisplat_ref
from minisplat_ref.app.runs.run_folder import hold_folder
from minisplat_ref.errors import InputError

THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
ATTACHED = (sys.executable, "-m", "minisplat_ref.app.runs.attached_process")
COMPILE = "from minisplat_ref.app.runs.first_use import compile_kernels; compile_kernels('cpu')"
POLL_SECONDS = 0.5  # between looks at the token
RELEASE_SECONDS = 30.0  # in which the process of a killed worker has let go of the folder
SAID_BYTES = 8000  # of the end of a command's output, to show if it fails
INTERRUPTED = 130


class Job(NamedTuple):
    """One command to carry out somewhere."""

    name: str
    """For people."""
    choose: Callable[..., Sequence[str] | None]
    """Returns the words after the program's name, or None if there is nothing left to do; called on the worker."""
    arguments: tuple[Any, ...]
    """Of ``choose``: names, numbers and paths."""
    folder: Path | None = None
    """Absolute; the folder that the command holds, which no other process may be writing into when it begins."""
    program: str = "minisplat_ref"
    """The module that is run, which is there in the working folder of the commands or is installed."""


def unless_exists(file: Path, words: Sequence[str]) -> Sequence[str] | None:
    """Return the words of a command, None where the file that it leaves is there: a :attr:`Job.choose`."""
    return None if file.exists() else words


class Site(NamedTuple):
    """The paths that all workers must find on the storage that they share."""

    token: Path
    """Absolute; the file exists as long as the results are awaited."""
    folder: Path
    """Absolute; the working folder of the commands, to which their relative paths belong."""
    inputs: tuple[Path, ...] = ()
    """Absolute; files and folders that the commands read."""


class Outcome(NamedTuple):
    """The end of a job."""

    code: int
    """Exit code of the command; 0 where there was nothing to do, 130 where the results are no longer awaited."""
    said: str = ""
    """The end of its output."""


def versions() -> dict[str, str]:
    """Return the versions on which the bytes of results depend, and a hash of this program's source."""
    package = Path(minisplat_ref.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    program = f"{minisplat_ref.__version__} (source {digest.hexdigest()[:8]})"
    return {"minisplat_ref": program, "numba": numba.__version__, "numpy": np.__version__}


def unseen(site: Site) -> str | None:
    """Return the first path that this machine does not see; None if it sees all."""
    return next((str(path) for path in (site.token, site.folder, *site.inputs) if not path.exists()), None)


def compile_once() -> None:
    """Compile this machine's kernels if none are on disk; errors are reported by the command that needs them."""
    subprocess.run([sys.executable, "-c", COMPILE], stdin=subprocess.DEVNULL, capture_output=True, check=False)


def carry_out(job: Job, site: Site) -> Outcome:
    """Run the command of a job to its end.

    Raises
    ------
    InputError
        This machine does not see a path, another process keeps writing into the folder, or ``choose`` refuses it.
    """
    if not site.token.exists() and site.token.parent.exists():
        return Outcome(INTERRUPTED)
    if (path := unseen(site)) is not None:
        raise InputError(unseen_line(platform.node(), path))
    if job.folder is not None:
        wait_until_free(job.folder)
    words = job.choose(*job.arguments)
    if words is None:
        return Outcome(0)
    environment = {**os.environ, **{name: os.environ.get("NUMBA_NUM_THREADS", "1") for name in THREADS}}
    with tempfile.TemporaryFile() as said:
        code = _run([*ATTACHED, job.program, *words], site, env=environment, stdout=said, stderr=subprocess.STDOUT)
        said.seek(max(0, said.tell() - SAID_BYTES))
        return Outcome(code, said.read().decode("utf-8", errors="replace"))


def unseen_line(worker: str, path: str) -> str:
    """Return the message about a worker that does not see a path."""
    return f"worker {worker} does not see {path}: put it on storage that all workers share under the same path"


def _run(command: Sequence[str], site: Site, **settings: Any) -> int:
    is_told = False
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, cwd=site.folder, start_new_session=True, **settings
    ) as process:
        while True:
            try:
                return process.wait(POLL_SECONDS)
            except subprocess.TimeoutExpired:
                if not is_told and not site.token.exists():
                    process.terminate()  # it saves now, as after Ctrl-C, however long that takes
                    is_told = True


def wait_until_free(folder: Path) -> None:
    """Wait until the process of a killed worker no longer holds a folder.

    Raises
    ------
    InputError
        Another process still holds it after RELEASE_SECONDS.
    """
    deadline = time.monotonic() + RELEASE_SECONDS
    while folder.is_dir():
        try:
            with hold_folder(folder):
                return
        except InputError:
            if time.monotonic() > deadline:
                raise
        time.sleep(POLL_SECONDS)
