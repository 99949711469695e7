"""``oracle gradients``: checks that every gradient is the derivative of what is computed."""

import argparse

from minisplat_ref.cli.oracle import add_json_argument, publish
from minisplat_ref.constants import GSPLAT_MAIN, PROFILES
from minisplat_ref.experiments.arguments import BACKENDS, Commands, HelpFormatter

DESCRIPTION = """\
Check every stage's gradient, and the whole render's, in float64:

  Jacobian         every entry, on a tiny scene, against differences
  inner products   a random direction for each input, on a larger one
  torch autograd   through gsplat's functions, with the extra [peers]

A difference across a threshold is refused, and a check of nothing fails.
"""
EPILOG = """\
examples:
  minisplat-ref oracle gradients
  minisplat-ref oracle gradients --backend reference --profile INRIA
"""


def add_parser(checks: Commands) -> None:
    """Add the check."""
    parser = checks.add_parser(
        "gradients",
        help="check gradients against differences and autograd",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument(
        "--backend", choices=BACKENDS, default="reference", metavar="NAME", help="reference (default), cpu or cpu-exact"
    )
    parser.add_argument(
        "--profile",
        type=str.upper,
        choices=tuple(PROFILES),
        default=GSPLAT_MAIN.name,
        metavar="NAME",
        help=f"rasteriser conventions: {', '.join(PROFILES)} (default {GSPLAT_MAIN.name})",
    )
    add_json_argument(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Check, print the table."""
    from minisplat_ref.backends import get_backend
    from minisplat_ref.oracle.gradients import AUTOGRAD, check_gradients

    report = check_gradients(get_backend(args.backend), PROFILES[args.profile])
    print(f"{AUTOGRAD}: {report.settings[AUTOGRAD]}")
    return publish(report, args.json)
