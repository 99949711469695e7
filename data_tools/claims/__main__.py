"""The command ``python -m data_tools.claims``: measure a claim, or list all."""

import argparse
import sys
from collections.abc import Sequence

from data_tools.claims import all_claims, find_claim
from data_tools.claims.kit.claim import Claim
from data_tools.claims.kit.records import hand_out, handing_out, one_job
from minisplat_ref.app.cli.guard import check_packages, run_guarded
from minisplat_ref.app.runs.cluster import Workers
from minisplat_ref.interface.arguments import HelpFormatter, Parser, add_worker_arguments, drop_workers, integer

PROGRAM = "data_tools.claims"
DESCRIPTION = """\
Measure what a paper claims, or what a choice in a method does: a scene is
trained with and without, and a table and a figure say what that has changed.

Without a NAME: list the claims.
"""
EPILOG = """\
examples:
  python -m data_tools.claims
  python -m data_tools.claims ablation --help
  python -m data_tools.claims ablation room --iterations 1500 --out measured"""
EXAMPLES = {"SCENE": "room", "FILE": "mine.ply", "DIR": "measured"}
"""What the example of a claim shows for a required argument, by its placeholder."""


def main(words: Sequence[str] | None = None) -> int:
    """Measure a claim; return the exit code, as of ``minisplat-ref``."""
    given = sys.argv[1:] if words is None else words
    return run_guarded(lambda: _run(given), PROGRAM)


def _run(words: Sequence[str]) -> int:
    if not words or words[0].startswith("-"):
        parser = Parser(prog=f"python -m {PROGRAM}", usage="python -m data_tools.claims [-h] [NAME ...]")
        parser.description, parser.epilog, parser.formatter_class = DESCRIPTION, EPILOG, HelpFormatter
        parser.parse_args(words)
        return _list_all()
    claim = find_claim(words[0])
    check_packages(("matplotlib",))
    given = parser_of(words[0], claim).parse_args(words[1:])
    if not claim.is_resumed:
        return claim.run(given) or 0
    if given.job is not None:
        with one_job(given.job):
            claim.run(given)
        return 0
    workers = Workers(given.workers, given.cluster)
    elsewhere = hand_out(workers, drop_workers(words), PROGRAM) if workers.is_used else None
    with handing_out(elsewhere):
        return claim.run(given) or 0


def parser_of(name: str, claim: Claim) -> argparse.ArgumentParser:
    """Return the parser of a claim's arguments."""
    parser = Parser(prog=f"claims {name}", description=claim.summary, formatter_class=HelpFormatter)
    claim.add_arguments(parser)
    if claim.is_resumed:
        add_worker_arguments(parser)
        parser.add_argument("--job", type=integer(0), help=argparse.SUPPRESS)  # what a worker is told
    words = ["python -m", PROGRAM, name]
    for action in parser._actions:
        if action.required:
            words += [*action.option_strings[-1:], EXAMPLES.get(str(action.metavar), str(action.metavar))]
    parser.epilog = f"example:\n  {' '.join(words)}"
    return parser


def _list_all() -> int:
    claims = all_claims()
    width = max(map(len, claims))
    for name, claim in claims.items():
        print(f"{name:<{width}}  {claim.summary}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
