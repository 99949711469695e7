"""``oracle hard-cases``: scenes that break renderers, through every precision, forward and backward."""

import argparse

from minisplat_ref.app.cli.oracle import CALLS, add_call_argument, add_output_arguments, module_of, publish
from minisplat_ref.interface.arguments import Commands, HelpFormatter

DESCRIPTION = """\
Run the catalogue of hard cases through cpu float64, cpu-exact float32 and cpu
float32, forward and backward, against the reference in float64.

Each must be finite and within its tolerance, or refused in one clear line.
Image errors are relative to the largest value where that is above 1; gradient
errors are relative, of the worst block of parameters. Pixels on a threshold,
where a rounding decides whether a hit counts or which of two is in front, are
counted by themselves; a flip is one that decided otherwise.
"""
EPILOG = """\
examples:
  minisplat-ref oracle hard-cases
  minisplat-ref oracle hard-cases --only needle
  minisplat-ref oracle hard-cases --json hard_cases.json"""


def add_parser(checks: Commands) -> None:
    """Add the check."""
    parser = checks.add_parser(
        "hard-cases",
        help="needles, huge worlds, empty scenes, NaN: finite or refused",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument(
        "--only", metavar="PATTERN", default="", help="cases whose name holds this; * and ? are wildcards"
    )
    add_call_argument(parser)
    add_output_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the cases, print the table and the worst of each kind."""
    if args.call in CALLS:
        cases = module_of(args.call, "hard_cases")
        return publish(cases.run_cases(cases.select(args.only)), args)
    from minisplat_ref.oracle.cases import as_markdown
    from minisplat_ref.oracle.hard_cases import GROUPS, HARD_CASES
    from minisplat_ref.oracle.hard_cases.run import by_group, run_hard_cases, select_cases

    report = run_hard_cases(select_cases(HARD_CASES, args.only))
    exit_code = publish(report, args)
    print(f"\nworst of each kind\n\n{as_markdown(by_group(report, GROUPS))}")
    return exit_code
