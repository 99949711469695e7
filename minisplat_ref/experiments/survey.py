"""Which command of the oracle notices which error: errors are planted one at a time, and every command is run.

A planted error is a changed line in a copy of the package (:mod:`minisplat_ref.experiments.survey_errors`). The
commands run in processes of their own, on the copy; a command notices an error if its exit code is not 0, as a check of
a repository would. Errors in kernels are compiled anew, each into a folder of its own, which takes minutes.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatch
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import minisplat_ref
from minisplat_ref.errors import InputError
from minisplat_ref.experiments.arguments import HelpFormatter, Parser, integer
from minisplat_ref.experiments.survey_errors import ERRORS, TextError
from minisplat_ref.reporting import markdown_table

PACKAGE = Path(minisplat_ref.__file__).parent
COMMANDS = {
    "gradients": ("gradients",),
    "compare": ("compare", "cpu"),
    "compare float32": ("compare", "cpu", "--dtype", "float32"),
    "hard-cases": ("hard-cases",),
}
"""Arguments of ``minisplat-ref oracle``, by the heading of the table."""
TIMEOUT = 1800  # seconds for a command that has to compile its kernels on a busy machine


class Outcome(NamedTuple):
    """What the commands say about one error."""

    error: TextError
    exit_codes: dict[str, int]
    """By heading; 0 where the command passed."""

    @property
    def is_noticed(self) -> bool:
        """Whether any command fails."""
        return any(self.exit_codes.values())


def planted_copy(error: TextError, folder: Path) -> Path:
    """Copy the package into a folder, with one line changed; return what has to be on Python's path.

    Raises
    ------
    InputError
        If the line is not there, or not once: the source has changed, and the list of errors has to follow.
    """
    copy = folder / PACKAGE.name
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    file = copy / error.file
    source = file.read_text(encoding="utf-8")
    if (n := source.count(error.right)) != 1:
        raise InputError(f"{error.what}: {error.file} holds {error.right!r} {n} times; mend survey_errors.py")
    file.write_text(source.replace(error.right, error.wrong), encoding="utf-8")
    return folder


def survey(error: TextError, commands: Sequence[str]) -> Outcome:
    """Plant an error and run commands.

    Parameters
    ----------
    error : TextError
        What to plant.
    commands : sequence of str
        Keys of :data:`COMMANDS`.

    Returns
    -------
    Outcome
        Their exit codes.
    """
    with TemporaryDirectory() as folder:
        path = planted_copy(error, Path(folder))
        environment = {**os.environ, "PYTHONPATH": str(path), "PYTHONDONTWRITEBYTECODE": "1"}
        if error.is_compiled:
            environment["NUMBA_CACHE_DIR"] = str(path / "kernels")
        codes = {}
        for heading in commands:
            call = [sys.executable, "-m", "minisplat_ref", "oracle", *COMMANDS[heading]]
            done = subprocess.run(call, env=environment, cwd=path, capture_output=True, check=False, timeout=TIMEOUT)
            codes[heading] = done.returncode
    return Outcome(error, codes)


def as_markdown(outcomes: Sequence[Outcome]) -> str:
    """Return a table with a line for each error, and a last one that counts."""
    headings = list(dict.fromkeys(heading for outcome in outcomes for heading in outcome.exit_codes))
    rows = [
        [outcome.error.what, f"`{outcome.error.file}`", *_marks([outcome.exit_codes[heading] for heading in headings])]
        for outcome in outcomes
    ]
    counts = [sum(outcome.exit_codes[heading] != 0 for outcome in outcomes) for heading in headings]
    n_noticed = sum(outcome.is_noticed for outcome in outcomes)
    rows.append([f"noticed by any: {n_noticed} of {len(outcomes)}", "", *map(str, counts)])
    return markdown_table(["planted error", "where", *headings], rows)


def _marks(codes: Sequence[int]) -> list[str]:
    return ["noticed" if code else "" for code in codes]


def main() -> None:
    """Survey what the command line says; exit with code 1 if an error passes every command."""
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
    parser.add_argument("--jobs", type=integer(1), default=1, metavar="N", help="errors at a time (default 1)")
    args = parser.parse_args()
    errors = [error for error in ERRORS if fnmatch(error.what, f"*{args.only}*")]
    if not errors:
        parser.error(f"no error's words hold {args.only!r}")
    outcomes = []
    with ThreadPoolExecutor(args.jobs) as pool:
        for outcome in pool.map(lambda error: survey(error, args.commands), errors):
            noticed = [heading for heading, code in outcome.exit_codes.items() if code]
            print(f"{outcome.error.what}: {', '.join(noticed) or 'PASSES EVERY COMMAND'}", file=sys.stderr, flush=True)
            outcomes.append(outcome)
    print(as_markdown(outcomes))
    sys.exit(int(not all(outcome.is_noticed for outcome in outcomes)))
