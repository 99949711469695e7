"""Survey which command of the oracle notices which error: errors are planted one at a time, every command is run.

A planted error is a changed line of one function (:mod:`data_tools.survey_errors`). In a function of
Python it is planted in the running program, and the commands are called; kernels that contain it are recompiled, in
a copy of the package, by separate processes, which takes minutes. A command notices an error if its exit code is
not 0, or if it ends in an exception.

All of it takes hours. ``--out DIR`` keeps what has been found, so that the same command continues; ``--workers N`` and
``--cluster ADDRESS`` hand errors out, one a process, and the table is the same. Workers of a scheduler see this
repository under the same path.
"""

import hashlib
import inspect
import os
import shutil
import subprocess
import sys
import textwrap
from argparse import SUPPRESS
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout
from fnmatch import fnmatch
from importlib import import_module
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FunctionType
from typing import NamedTuple

import numpy as np

import minisplat_ref
from data_tools.claims.kit.records import hand_out, handing_out, one_job, resume
from data_tools.survey_errors import ERRORS, PlantedLine
from minisplat_ref.app.runs.cluster import Workers
from minisplat_ref.app.runs.worker import versions
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import HelpFormatter, Parser, add_worker_arguments, drop_workers, integer
from minisplat_ref.interface.reporting import markdown_table

PACKAGE = Path(minisplat_ref.__file__).parent
COMMANDS = {
    "compare cpu": ("compare", "cpu"),
    "compare reference": ("compare", "reference"),
    "compare float32": ("compare", "cpu", "--dtype", "float32"),
    "gradients": ("gradients",),
    "hard-cases": ("hard-cases",),
}
"""Arguments of ``minisplat-ref oracle``, by the heading of the table."""


class Outcome(NamedTuple):
    """What the commands say about one error."""

    error: PlantedLine
    notices: dict[str, bool]
    """By heading of the table."""


@contextmanager
def plant_in_function(error: PlantedLine) -> Iterator[None]:
    """Give a function of Python other code for a while, wherever it is referenced.

    Raises
    ------
    InputError
        If the line is not there, or not once: the source has changed, and the list of errors has to follow.
    """
    module, name = error.where.split(":")
    function = inspect.unwrap(getattr(import_module(f"minisplat_ref.{module}"), name))
    changed = _change_source(error, textwrap.dedent(inspect.getsource(function)))
    names = dict(function.__globals__)
    exec(compile(changed, inspect.getfile(function), "exec"), names)
    wrong = inspect.unwrap(names[name])
    assert isinstance(function, FunctionType) and isinstance(wrong, FunctionType)
    right = function.__code__
    function.__code__ = wrong.__code__
    try:
        yield
    finally:
        function.__code__ = right


def plant_in_copy(error: PlantedLine, folder: Path) -> None:
    """Copy the package into a folder, with the line changed; raises as :func:`plant_in_function` does."""
    shutil.copytree(PACKAGE, folder / PACKAGE.name, ignore=shutil.ignore_patterns("__pycache__"))
    file = (folder / PACKAGE.name).joinpath(*error.where.partition(":")[0].split(".")).with_suffix(".py")
    file.write_text(_change_source(error, file.read_text(encoding="utf-8")), encoding="utf-8")


def _change_source(error: PlantedLine, source: str) -> str:
    if (n := source.count(error.right)) != 1:
        raise InputError(f"{error.what}: {error.right!r} stands {n} times in {error.where}; mend survey_errors.py")
    return source.replace(error.right, error.wrong)


def survey(error: PlantedLine, commands: Sequence[str]) -> Outcome:
    """Plant an error and run commands.

    Parameters
    ----------
    error : PlantedLine
        What to plant.
    commands : sequence of str
        Keys of :data:`COMMANDS`.

    Returns
    -------
    Outcome
        Which of them notice it.
    """
    if error.is_compiled:
        with TemporaryDirectory() as folder:
            plant_in_copy(error, Path(folder))
            return Outcome(error, {heading: _fails_apart(COMMANDS[heading], folder) for heading in commands})
    with plant_in_function(error):
        return Outcome(error, {heading: _fails(COMMANDS[heading]) for heading in commands})


def _fails(arguments: Sequence[str]) -> bool:
    """Whether a command, called here, fails."""
    from minisplat_ref.app.cli import main as minisplat_ref_main

    with redirect_stdout(StringIO()), np.errstate(all="ignore"):
        try:
            return minisplat_ref_main(["oracle", *arguments]) != 0
        except Exception:  # whatever a broken formula raises
            return True


def _fails_apart(arguments: Sequence[str], folder: str) -> bool:
    """Whether a command fails with the package of a folder, whose kernels are kept there."""
    environment = {**os.environ, "PYTHONPATH": folder, "NUMBA_CACHE_DIR": str(Path(folder) / "kernels")}
    call = [sys.executable, "-m", "minisplat_ref", "oracle", *arguments]
    return subprocess.run(call, env=environment, cwd=folder, capture_output=True, check=False).returncode != 0


def as_markdown(outcomes: Sequence[Outcome]) -> str:
    """Return a table with a line for each error, and a last one that counts."""
    headings = list(dict.fromkeys(heading for outcome in outcomes for heading in outcome.notices))
    rows = [
        [o.error.what, f"`{o.error.where}`", *("noticed" if o.notices[heading] else "" for heading in headings)]
        for o in outcomes
    ]
    counts = [sum(outcome.notices[heading] for outcome in outcomes) for heading in headings]
    n_noticed = sum(any(outcome.notices.values()) for outcome in outcomes)
    rows.append([f"{n_noticed} of {len(outcomes)} are noticed", "", *map(str, counts)])
    return markdown_table(["planted error", "where", *headings], rows)


def survey_all(errors: Sequence[PlantedLine], commands: Sequence[str], folder: Path) -> list[Outcome]:
    """Survey the errors of which a folder has no record yet, here or by workers; return all, in their order.

    Raises
    ------
    InputError
        The folder has records of other commands or of another source.
    """
    by_name = {error.what: error for error in errors}

    def measure(what: str) -> list[dict[str, dict[str, bool]]]:
        notices = survey(by_name[what], commands).notices
        noticed = ", ".join(heading for heading, is_noticed in notices.items() if is_noticed)
        print(f"{what}: {noticed or 'PASSES EVERY COMMAND'}", file=sys.stderr, flush=True)
        return [{"notices": notices}]

    lines = hashlib.sha256(repr(ERRORS).encode()).hexdigest()[:8]
    settings = {"commands": list(commands), "errors": lines, **versions()}
    records = resume(folder, settings, [{"what": what} for what in by_name], measure, nouns="errors")
    found = {record["what"]: record["notices"] for record in records}
    return [Outcome(error, found[error.what]) for error in errors]


def main(words: Sequence[str]) -> int:
    """Survey what the command line says; return 1 if an error passes every command."""
    parser = Parser(
        prog="python -m data_tools.survey",
        description="Plant errors one at a time, run the oracle's commands, and print which of them notice which.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument(
        "--only", default="", metavar="PATTERN", help="errors whose words hold this; * and ? are wildcards"
    )
    parser.add_argument(
        "--commands",
        nargs="+",
        choices=tuple(COMMANDS),
        default=tuple(COMMANDS),
        metavar="NAME",
        help=f"{', '.join(COMMANDS)} (default all)",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="new folder for what is found, or one to continue")
    add_worker_arguments(parser, "survey N errors at once (default 0: in turn)", "by the workers of a Dask scheduler")
    parser.add_argument("--job", type=integer(0), help=SUPPRESS)  # what a worker is told
    args = parser.parse_args(words)
    errors = [error for error in ERRORS if fnmatch(error.what, f"*{args.only}*")]
    if not errors:
        parser.error(f"no error's words hold {args.only!r}")
    workers = Workers(args.workers, args.cluster)
    if workers.is_used and args.out is None:
        parser.error("workers leave what they find in a folder: give --out DIR")
    with ExitStack() as stack:
        folder = args.out or Path(stack.enter_context(TemporaryDirectory())) / "survey"
        if args.job is not None:
            with one_job(args.job):
                survey_all(errors, args.commands, folder)
            return 0
        elsewhere = hand_out(workers, drop_workers(words), "data_tools.survey", "survey")
        with handing_out(elsewhere if workers.is_used else None):
            outcomes = survey_all(errors, args.commands, folder)
    print(as_markdown(outcomes))
    return int(not all(any(outcome.notices.values()) for outcome in outcomes))


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except InputError as error:
        print(f"python -m data_tools.survey: {error}", file=sys.stderr)
        sys.exit(2)
