"""``oracle truth``: errors of float64 and float32 against 50 digits."""

import argparse

from minisplat_ref.app.cli.oracle import add_output_arguments, publish
from minisplat_ref.interface.arguments import Commands, HelpFormatter

DESCRIPTION = """\
Compare covariance, projection and transmittance with 50 digits (mpmath, extra
[peers]): ordinary Gaussians, needles, and a world far from its origin. Errors
are relative; judged is their ratio to the condition number of what is computed.
Gain is what the kernels' formulas win over the textbook's in float32.
"""
EPILOG = """\
examples:
  minisplat-ref oracle truth
"""


def add_parser(checks: Commands) -> None:
    """Add the check."""
    parser = checks.add_parser(
        "truth",
        help="measure rounding errors against 50 digits",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    add_output_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Check, print the table."""
    from minisplat_ref.oracle.truth import check_truth

    return publish(check_truth(), args)
