"""``oracle export``."""

import argparse

from minisplat_ref.cli.arguments import Commands, HelpFormatter


def add_parser(checks: Commands) -> None:
    """Add the check."""
    parser = checks.add_parser("export", help="(stub)", formatter_class=HelpFormatter)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Check, print the table."""
    raise NotImplementedError
