"""``minisplat-ref study STUDY SCENE --out DIR``: run one of the studies."""

import argparse
import sys
from collections.abc import Sequence

from minisplat_ref.datasets.command import run_command
from minisplat_ref.experiments.studies import culling, depth_types, simplify, split_forms

STUDIES = (split_forms, culling, simplify, depth_types)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 0 when the results are written, 2 when the input is wrong, 130 when interrupted."""
    parser = argparse.ArgumentParser(
        prog="minisplat-ref study",
        description="Measure on a scene what a choice in a method does.",
    )
    commands = parser.add_subparsers(metavar="STUDY", required=True)
    for study in STUDIES:
        study.add_parser(commands)
    return run_command(parser, lambda options: options.run(options), argv)


if __name__ == "__main__":
    sys.exit(main())
