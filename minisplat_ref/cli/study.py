"""``study``: measures what a choice in a method does."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.arguments import Commands, HelpFormatter, Parser, add_worker_arguments, integer, without_workers
from minisplat_ref.errors import InputError

if TYPE_CHECKING:
    from minisplat_ref.runs.cluster import Workers
    from minisplat_ref.studies.study import Study

DESCRIPTION = """\
Measure what a choice in a method does to a scene: it is trained with and
without, and a table and a figure say what that has changed.

Without a NAME: list the studies.
"""
EPILOG = """\
examples:
  minisplat-ref study
  minisplat-ref study ablation --help
  minisplat-ref study ablation room --iterations 1500 --out studies/ablation"""


def add_parser(commands: Commands) -> None:
    """Add the command. A study's own arguments are parsed when it is known which one it is: see :func:`run`."""
    parser = commands.add_parser(
        "study",
        help="measure what a choice in a method does",
        usage="minisplat-ref study [-h] [NAME ...]",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("name", nargs="?", metavar="NAME", help="of a study")
    parser.add_argument(
        "arguments", nargs=argparse.REMAINDER, metavar="...", help="its arguments: see minisplat-ref study NAME --help"
    )
    parser.set_defaults(run=run, needs=("matplotlib",))


def run(args: argparse.Namespace) -> int:
    """Run a study, or list all."""
    from minisplat_ref.studies import all_studies

    studies = all_studies()
    if args.name is not None and "/" in args.name:
        studies |= _extension_studies(args.name)
    if args.name is None:
        width = max(map(len, studies))
        for name, study in studies.items():
            print(f"{name:<{width}}  {study.summary}")
        print("\nminisplat-ref study NAME --help explains one. Those of an extension are called EXTENSION/NAME:")
        print("minisplat-ref extensions EXTENSION lists them.")
        return 0
    if args.name not in studies:
        raise InputError(f"there is no study {args.name!r}: choose from {', '.join(studies)}")
    study = studies[args.name]
    parser = Parser(prog=f"minisplat-ref study {args.name}", description=study.summary, formatter_class=HelpFormatter)
    study.add_arguments(parser)
    if study.is_resumed:
        add_worker_arguments(parser)
        parser.add_argument("--job", type=integer(0), help=argparse.SUPPRESS)  # what a worker is told
    parser.epilog = _example(parser)
    given = parser.parse_args(args.arguments)
    if not study.is_resumed:
        return study.run(given) or 0
    return _run_resumed(study, given, args.words)


def _run_resumed(study: "Study", given: argparse.Namespace, words: Sequence[str]) -> int:
    """Run a study of several trainings here or by workers, or one of them for another process."""
    from functools import partial

    from minisplat_ref.runs.cluster import Workers
    from minisplat_ref.studies.records import handing_out, one_job

    if given.job is not None:
        with one_job(given.job):
            study.run(given)
        return 0
    workers = Workers(given.workers, given.cluster)
    with handing_out(partial(hand_out, workers, without_workers(words)) if workers.is_used else None):
        return study.run(given) or 0


def hand_out(
    workers: "Workers",
    words: list[str],
    folder: Path,
    numbers: Sequence[int],
    noun: str = "training",
    program: str = "minisplat_ref",
) -> None:
    """Have jobs of a command that continues in its folder carried out by workers.

    Parameters
    ----------
    workers : Workers
    words : list of str
        Of the command, after the program's name; ``--job N`` is added for one job.
    folder : Path
    numbers : sequence of int
        Of the jobs.
    noun : str
        What a job is called.
    program : str
        Module of the command.

    Raises
    ------
    InputError
        A job has failed, or as for :func:`minisplat_ref.runs.cluster.carry_out_all`.
    """
    from minisplat_ref.runs.cluster import carry_out_all
    from minisplat_ref.runs.worker import Job

    where = folder.resolve()
    jobs = [Job(f"{noun} {n + 1}", _words_of_job, (where, n, words), program=program) for n in numbers]
    code = carry_out_all(workers, jobs, folder, on_done=lambda job: print(f"{job.name}: ended", flush=True))
    if code:
        raise InputError(f"a {noun} has failed; what others measured is in {folder}, and the same command continues")


def _words_of_job(folder: Path, number: int, words: list[str]) -> list[str] | None:
    from minisplat_ref.studies.records import job_file

    return None if job_file(folder, number).exists() else [*words, "--job", str(number)]


EXAMPLES = {"SCENE": "room", "FILE": "runs/mine.ply", "DIR": "study"}
"""What the example of a study shows for a required argument, by its placeholder."""


def _example(parser: argparse.ArgumentParser) -> str:
    """Return a line that calls a study with all that it requires."""
    words = [parser.prog]
    for action in parser._actions:
        if action.required:
            words += [*action.option_strings[-1:], EXAMPLES.get(str(action.metavar), str(action.metavar))]
    return f"example:\n  {' '.join(words)}"


def _extension_studies(name: str) -> "dict[str, Study]":
    """Return the studies of the extension that ``EXTENSION/NAME`` begins with, by their whole names."""
    from minisplat_ref.extensions.extension import load_extension

    extension = load_extension(name.partition("/")[0])
    return {f"{extension.name}/{study.name}": study for study in extension.studies}
