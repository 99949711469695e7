"""Records of what a claim has measured so far, one for each job, so that it continues where it was interrupted.

A job is a training, or a few, with the measurements of what comes out. Jobs are carried out here one after the other;
or :data:`HAND_OUT` says who carries them out, each in a process of its own, which is the same command with :data:`JOB`
set: it measures that job, leaves its records in a file, and ends.
"""

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NoReturn

from minisplat_ref.app.runs import cluster
from minisplat_ref.app.runs.cluster import Workers
from minisplat_ref.app.runs.worker import Job, unless_exists
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.atomic import replacing

RUNS = "runs.jsonl"  # what has been measured so far, below the settings

Measured = Mapping[str, Any] | Iterable[Mapping[str, Any]]
"""One record, or several."""

HandOut = Callable[[Path, Sequence[int]], None]
"""Has jobs carried out, by their numbers, which leave their records in the folder."""

HAND_OUT: ContextVar[HandOut | None] = ContextVar("HAND_OUT", default=None)
JOB: ContextVar[int | None] = ContextVar("JOB", default=None)


class JobDone(BaseException):
    """The one job of this process has been measured; there is no report here."""


@contextmanager
def handing_out(hand_out: HandOut | None) -> Iterator[None]:
    """Have the jobs of a claim carried out elsewhere; None: here."""
    token = HAND_OUT.set(hand_out)
    try:
        yield
    finally:
        HAND_OUT.reset(token)


@contextmanager
def one_job(number: int) -> Iterator[None]:
    """Carry out one job of a claim, and end when it is done."""
    token = JOB.set(number)
    try:
        yield
    except JobDone:
        pass
    finally:
        JOB.reset(token)


def hand_out(workers: Workers, words: list[str], program: str, noun: str = "training") -> HandOut:
    """Return what has the jobs of a command that continues in its folder carried out by workers.

    Parameters
    ----------
    workers : Workers
    words : list of str
        Of the command, after the program's name; ``--job N`` is added for one job.
    program : str
        Module of the command.
    noun : str
        What a job is called.

    Raises
    ------
    InputError
        From the function that is returned: a job has failed, or as for
        :func:`minisplat_ref.app.runs.cluster.carry_out_all`.
    """

    def carry_out(folder: Path, numbers: Sequence[int]) -> None:
        where = folder.resolve()
        jobs = [
            Job(f"{noun} {n + 1}", unless_exists, (job_file(where, n), [*words, "--job", str(n)]), program=program)
            for n in numbers
        ]
        code = cluster.carry_out_all(workers, jobs, folder, on_done=lambda job: print(f"{job.name}: ended", flush=True))
        if code:
            raise InputError(
                f"a {noun} has failed; what others measured is in {folder}, and the same command continues"
            )

    return carry_out


def job_file(folder: Path, number: int) -> Path:
    """Return where the records of a job are that was carried out elsewhere."""
    return folder / f"job-{number}.jsonl"


def resume(
    folder: Path,
    settings: Mapping[str, Any],
    jobs: Sequence[Mapping[str, Any]],
    measure: Callable[..., Measured],
    warm_up: Callable[[list[Mapping[str, Any]]], None] = lambda missing: None,
    nouns: str = "trainings",
) -> list[dict[str, Any]]:
    """Measure the jobs that have no record in the folder, and return the records of all jobs, in the folder's order.

    Left out are records of jobs that the folder has besides, and those whose entries are others than their job's.
    Parameters are those of :func:`resume_all`.
    """
    records = resume_all(folder, settings, jobs, measure, warm_up, nouns)
    return [record for record in records if any(job.items() <= record.items() for job in jobs)]


def resume_all(
    folder: Path,
    settings: Mapping[str, Any],
    jobs: Sequence[Mapping[str, Any]],
    measure: Callable[..., Measured],
    warm_up: Callable[[list[Mapping[str, Any]]], None] = lambda missing: None,
    nouns: str = "trainings",
) -> list[dict[str, Any]]:
    """Measure the jobs that have no record in the folder, and return all its records.

    Parameters
    ----------
    folder : Path
        Made if it is not there.
    settings : dict
        On which all records depend.
    jobs : sequence of dict
        Keyword arguments of ``measure``, which a record has, too.
    measure : callable
        Returns the further entries of the record of a job, or of each of its records.
    warm_up : callable
        Called with the missing jobs before the first, so that none counts the time of compiling.
    nouns : str
        What the jobs are called where their progress is shown.

    Raises
    ------
    InputError
        The folder belongs to other settings, or contains something else; or a job has failed elsewhere.
    """
    if (number := JOB.get()) is not None:
        _measure_one(folder, number, jobs[number], measure, warm_up)
    records = _read_records(folder, settings, nouns)
    records += _take_in(folder, range(len(jobs)), jobs)  # of a call that was interrupted
    missing = [n for n, job in enumerate(jobs) if not any(job.items() <= record.items() for record in records)]
    if missing and (hand_out := HAND_OUT.get()) is not None:
        hand_out(folder, missing)
        return records + _take_in(folder, missing, jobs)
    warm_up([jobs[number] for number in missing])
    for number in with_progress(missing, nouns):
        job = jobs[number]
        for measured in _each(measure(**job)):
            records.append({**job, **measured})
            _append(folder, records[-1:])
    return records


def jobs_of(**choices: Iterable[Any]) -> list[dict[str, Any]]:
    """Return a job for each combination of choices, which are named in the order of loops, the outermost first."""
    return [dict(zip(choices, chosen, strict=True)) for chosen in itertools.product(*choices.values())]


def _each(measured: Measured) -> Iterable[Mapping[str, Any]]:
    return [measured] if isinstance(measured, Mapping) else measured


def _measure_one(
    folder: Path,
    number: int,
    job: Mapping[str, Any],
    measure: Callable[..., Measured],
    warm_up: Callable[[list[Mapping[str, Any]]], None],
) -> NoReturn:
    warm_up([job])
    lines = [json.dumps({**job, **measured}) + "\n" for measured in _each(measure(**job))]
    with replacing(job_file(folder, number)) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")
    raise JobDone


def _take_in(folder: Path, numbers: Sequence[int], jobs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Move the records of jobs that were carried out elsewhere to the others, in the order of the jobs."""
    records: list[dict[str, Any]] = []
    for number in numbers:
        path = job_file(folder, number)
        if not path.exists():
            continue
        found = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        if any(jobs[number].items() <= record.items() for record in found):  # else of other arguments
            _append(folder, found)
            records += found
        path.unlink()
    return records


def _append(folder: Path, records: Iterable[Mapping[str, Any]]) -> None:
    with open(folder / RUNS, "a", encoding="utf-8") as file:
        file.writelines(json.dumps(record) + "\n" for record in records)


def _read_records(folder: Path, settings: Mapping[str, Any], nouns: str) -> list[dict[str, Any]]:
    path = folder / RUNS
    if not folder.exists():
        folder.mkdir(parents=True)
        path.write_text(json.dumps(settings) + "\n", encoding="utf-8")
        return []
    if not path.is_file():
        raise InputError(f"{folder} exists and is not of this claim: give another --out")
    first, *lines = path.read_text(encoding="utf-8").splitlines()
    if json.loads(first) != json.loads(json.dumps(settings)):  # a tuple is a list there
        raise InputError(f"{folder} holds {nouns} of {first}: give another --out, or the same settings")
    return [json.loads(line) for line in lines]
