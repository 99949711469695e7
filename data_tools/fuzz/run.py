"""Many damaged files, one after the other, read in a separate process: it may crash, hang or take all memory.

``python -m data_tools.fuzz READER --seconds N`` damages the files of one reader, or of all, and prints what came of it.
File number i of a seed is always the same one, so that a finding can be made again.
"""

import multiprocessing
import sys
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import psutil

from data_tools.fuzz.judging import SECONDS_MAX, Verdict, judge
from data_tools.fuzz.mutations import Choose
from data_tools.fuzz.readers import READERS, Mutant, Reader, mutant
from minisplat_ref.interface.arguments import HelpFormatter, Parser, integer
from minisplat_ref.interface.reporting import markdown_table

SILENT_SECONDS = 4 * SECONDS_MAX  # a process that has said nothing for so long is ended
ADDRESS_SPACE = 4 << 30  # bytes that a process may take beyond what it has at its start, where the system can limit it


class Finding(NamedTuple):
    """What must not be, and the first file that shows it."""

    what: str
    number: int
    """Of the file; with the seed it makes the file again."""
    name: str
    """Which of the reader's files was damaged."""
    n_files: int
    """Files that show the same."""


class Outcome(NamedTuple):
    """A run."""

    n_files: int
    n_bytes: int
    """Of the damaged files."""
    seconds: float
    """Wall-clock, the start of processes included."""
    n_refused: int
    findings: tuple[Finding, ...]


class _Judged(NamedTuple):
    """What a process says of one file; ``verdict`` is None before it reads it."""

    number: int
    name: str
    n_bytes: int
    verdict: Verdict | None


def chooser(seed: int, number: int) -> Choose:
    """Return what decides how file ``number`` of a seed is damaged."""
    rng = np.random.default_rng([seed, number])
    return lambda n: int(rng.integers(n))


def fuzz(
    reader: Reader, *, seed: int = 0, first: int = 0, n_files: int | None = None, seconds: float | None = None
) -> Outcome:
    """Have a reader read damaged files.

    Parameters
    ----------
    reader : Reader
    seed, first : int
        Which files: those of the seed from number ``first`` on.
    n_files : int, optional
        How many; as many as time allows by default.
    seconds : float, optional
        How long; without limit by default.
    """
    start, last = time.monotonic(), None if n_files is None else first + n_files
    judged: list[_Judged] = []
    number = first
    while (last is None or number < last) and (seconds is None or time.monotonic() < start + seconds):
        for entry in _judge_in_one_process(reader, seed, number, last, seconds and start + seconds - time.monotonic()):
            judged.append(entry)
        number = judged[-1].number + 1 if judged else number + 1
    by_what: dict[str, list[_Judged]] = {}
    for entry in judged:
        if entry.verdict is not None and entry.verdict.finding:
            by_what.setdefault(entry.verdict.finding, []).append(entry)
    findings = tuple(
        Finding(what, entries[0].number, entries[0].name, len(entries)) for what, entries in by_what.items()
    )
    n_refused = sum(entry.verdict is not None and entry.verdict.is_refused for entry in judged)
    n_bytes = sum(entry.n_bytes for entry in judged)
    return Outcome(len(judged), n_bytes, time.monotonic() - start, n_refused, findings)


def _judge_in_one_process(
    reader: Reader, seed: int, first: int, last: int | None, seconds: float | None
) -> Iterator[_Judged]:
    """Yield a judgement for each file, until the process is done or has died of one."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    with TemporaryDirectory() as folder:
        process = context.Process(target=_work, args=(reader, Path(folder), seed, first, last, seconds, sender))
        process.start()
        sender.close()
        begun: _Judged | None = None
        try:
            while True:
                # The first message waits for imports and for files to be made, which takes as long as it takes.
                if not receiver.poll(SILENT_SECONDS if begun is not None else None):
                    process.kill()
                    assert begun is not None
                    yield begun._replace(verdict=Verdict(False, "hangs"))
                    return
                entry: _Judged = receiver.recv()
                if entry.verdict is not None:
                    yield entry
                begun = entry if entry.verdict is None else begun
        except EOFError:  # the process is done, or dead
            process.join()
            if process.exitcode != 0:
                if begun is None:
                    raise RuntimeError("the process that reads could not be started") from None
                yield begun._replace(verdict=Verdict(False, f"ends the process with exit code {process.exitcode}"))
        finally:
            process.kill()
            process.join()


def _work(
    reader: Reader, folder: Path, seed: int, first: int, last: int | None, seconds: float | None, sender: Connection
) -> None:
    """Judge files ``first`` to ``last`` and say of each that it begins, and then what came of it."""
    reader.write(folder)
    files = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    reader.read(folder, mutant(reader, folder, lambda n: 0).path)  # undamaged: must pass; loads what it needs
    _limit_memory()
    stop = time.monotonic() + (np.inf if seconds is None else seconds)
    number = first
    while (last is None or number < last) and time.monotonic() < stop:
        damaged = mutant(reader, folder, chooser(seed, number))
        entry = _Judged(number, damaged.path.name, len(damaged.content), None)
        sender.send(entry)
        sender.send(entry._replace(verdict=judge(reader, folder, damaged)))
        strange = {path for path in folder.rglob("*") if path.is_file()} - files.keys()
        assert not strange, f"reading has left {strange}"
        number += 1


def _limit_memory() -> None:
    """Limit the address space of this process, where the system can."""
    if psutil.LINUX:
        process = psutil.Process()
        limit = process.memory_info().vms + ADDRESS_SPACE
        process.rlimit(psutil.RLIMIT_AS, (limit, limit))


def keep(reader: Reader, seed: int, number: int, out: Path) -> Mutant:
    """Make a file again and write it to a folder; return it."""
    with TemporaryDirectory() as folder:
        reader.write(Path(folder))
        damaged = mutant(reader, Path(folder), chooser(seed, number))
    path = out / f"{number}-{damaged.path.name}"
    out.mkdir(parents=True, exist_ok=True)
    path.write_bytes(damaged.content)
    return damaged._replace(path=path)


def main() -> None:
    """Fuzz what the command line says; exit with code 1 if there are findings."""
    parser = Parser(
        prog="python -m data_tools.fuzz",
        description="Have readers read damaged files, and print what they must not do.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("readers", nargs="+", choices=(*READERS, "all"), metavar="READER", help=", ".join(READERS))
    parser.add_argument("--seconds", type=integer(1), default=60, metavar="N", help="for each reader (default 60)")
    parser.add_argument("--seed", type=integer(0), default=0, metavar="S", help="of the files (default 0)")
    parser.add_argument("--first", type=integer(0), default=0, metavar="I", help="number of the first file (default 0)")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="write the first file of each finding there")
    args = parser.parse_args()
    names = [name for name in READERS if name in args.readers or "all" in args.readers]
    rows, has_findings = [], False
    for name in names:
        outcome = fuzz(READERS[name], seed=args.seed, first=args.first, seconds=args.seconds)
        for finding in outcome.findings:
            has_findings = True
            print(f"{name}: file {finding.number} ({finding.name}) and {finding.n_files - 1} more: {finding.what}")
            if args.keep is not None:
                print(f"  kept as {keep(READERS[name], args.seed, finding.number, args.keep).path}")
        rows.append(_row(name, outcome))
    print(markdown_table(("reader", "files", "MB", "seconds", "refused", "findings"), rows))
    sys.exit(int(has_findings))


def _row(name: str, outcome: Outcome) -> list[str]:
    n_findings = str(sum(finding.n_files for finding in outcome.findings))
    return [
        name,
        f"{outcome.n_files:,}",
        f"{outcome.n_bytes / 1e6:.1f}",
        f"{outcome.seconds:.0f}",
        f"{outcome.n_refused:,}",
        n_findings,
    ]
