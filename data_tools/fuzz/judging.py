"""Judge a reader of a damaged file: it may read it if nothing shows, or refuse it in one line that names the file.

Everything else is a finding: another exception, a message of several lines or without the file, a warning in Python's
own form, more memory than a small multiple of the files, and time. The process that reads may also die or hang, of
which :mod:`.run` takes care.
"""

import time
import traceback
import tracemalloc
import warnings
from pathlib import Path
from typing import NamedTuple

from data_tools.fuzz.readers import Mutant, Reader
from minisplat_ref.app.runs.run import peak_rss_mb
from minisplat_ref.errors import LINE_MAX, InputError, InputWarning

MEMORY_FACTOR = 32  # times the bytes of all files: the three characters `[],` of JSON become an object of 64 bytes
NATIVE_FREE = 100_000_000  # bytes by which the process may grow besides: threads, and libraries on first use
SECONDS_MAX = 5.0  # a reader of files of some kilobytes that takes as long as this on a busy machine has gone astray


class Verdict(NamedTuple):
    """What became of a damaged file."""

    is_refused: bool
    finding: str = ""
    """What is wrong with how the file was read or refused; empty if nothing is."""


def judge(reader: Reader, folder: Path, mutant: Mutant) -> Verdict:
    """Put a damaged file in its place, read it, and put the right one back.

    Parameters
    ----------
    reader : Reader
    folder : Path
        What ``reader.write`` has left.
    mutant : Mutant
        The damaged file.
    """
    original = mutant.path.read_bytes()
    n_bytes = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) + len(mutant.content)
    mutant.path.write_bytes(mutant.content)
    is_tracing = tracemalloc.is_tracing()
    tracemalloc.start()
    start, resident = time.perf_counter(), peak_rss_mb() or 0.0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", InputWarning)
            verdict = _judge_reading(reader, folder, mutant.path)
        seconds, peak = time.perf_counter() - start, tracemalloc.get_traced_memory()[1]
    finally:
        if not is_tracing:
            tracemalloc.stop()
        mutant.path.write_bytes(original)
    if verdict.finding:
        return verdict
    grown = int(1e6 * ((peak_rss_mb() or 0.0) - resident))
    peak = max(peak, grown - NATIVE_FREE)  # what C++ allocates is seen in the process alone
    if peak > reader.free_memory + MEMORY_FACTOR * n_bytes:
        return verdict._replace(finding=f"takes {peak / 1e6:.0f} MB for files of {n_bytes / 1e6:.2f} MB")
    if seconds > SECONDS_MAX:
        return verdict._replace(finding=f"takes more than {SECONDS_MAX:.0f} s")
    return verdict


def _judge_reading(reader: Reader, folder: Path, file: Path) -> Verdict:
    try:
        reader.read(folder, file)
    except InputError as error:
        return Verdict(True, _fault_of(error, folder))
    except Exception as error:  # whatever it is, it is what is looked for
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return Verdict(True, f"{type(error).__name__} in {Path(frame.filename).name}, {frame.name}")
    return Verdict(False)


def _fault_of(error: InputError, folder: Path) -> str:
    """What is wrong with a refusal; empty if nothing is."""
    message = str(error)
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return "asks for more memory than there is before it refuses"
        cause = cause.__context__
    shown = message.replace(str(folder), "FOLDER")[:60]
    if not message.isprintable() or len(message) > LINE_MAX:
        return f"refuses, but not in one line: {shown!r}"
    return "" if str(folder) in message else f"refuses without the name of the file: {shown!r}"
