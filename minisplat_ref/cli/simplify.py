"""``simplify``: a smaller model from a run, at a stated loss."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.arguments import Commands, HelpFormatter, decibels, integer

if TYPE_CHECKING:
    from minisplat_ref.runs.simplified_run import Asked

FINE_TUNE = 300  # iterations at each size

DESCRIPTION = """\
Make a run smaller: keep its most important Gaussians, fine-tune them, and
measure at about ten sizes what is lost. Some training views are held out to
decide by; the test views are measured once, at the end.

  --max-drop dB   the smallest size that loses at most so much PSNR, with one
                  standard error on top
  --budget N      at most this many Gaussians
  --max-bytes B   as many as a PLY of at most B bytes holds (for a compact
                  file, minisplat-ref convert has --max-bytes of its own)
  none of these   the knee of the curve

NEW is a run folder for render, eval, info and convert, with point_cloud.ply,
metrics.json, result.json (curve and decision), figure.png and report.html.
It takes as long as about 13 times --fine-tune iterations of training.
"""
EPILOG = """\
example:
  minisplat-ref simplify runs/fox --out runs/fox-small --max-drop 0.1"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "simplify",
        help="make a run smaller at a stated loss",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("folder", type=Path, metavar="RUN", help="the --out folder of a training")
    parser.add_argument("--out", type=Path, required=True, metavar="NEW", help="new folder for the smaller model")
    target = parser.add_mutually_exclusive_group()
    target.add_argument("--max-drop", type=decibels, metavar="dB", help="PSNR that may be lost")
    target.add_argument("--budget", type=integer(1), metavar="N", help="Gaussians that may stay")
    target.add_argument("--max-bytes", type=integer(1), metavar="B", help="size that the PLY may have")
    fine_tune = f"iterations at each size (default {FINE_TUNE})"
    parser.add_argument("--fine-tune", type=integer(0), default=FINE_TUNE, metavar="N", help=fine_tune)
    parser.add_argument("--scene", type=Path, metavar="PATH", help="where the photographs are now, if they have moved")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Simplify, print the table and what became of the test views."""
    from minisplat_ref.runs.first_use import compile_kernels
    from minisplat_ref.runs.settings import load
    from minisplat_ref.runs.simplification import Target
    from minisplat_ref.runs.simplified_run import Asked

    compile_kernels(load(args.folder).backend)
    target = Target(args.max_drop, args.budget, args.max_bytes)
    simplify(Asked(args.folder, args.out, target, args.fine_tune, args.scene))
    return 0


def simplify(asked: "Asked") -> None:
    """Simplify a run and print how that went.

    Raises
    ------
    InputError
        See :func:`minisplat_ref.runs.simplified_run.simplify_run`.
    """
    from minisplat_ref.reporting import markdown_table
    from minisplat_ref.runs.simplification_report import TABLE_HEADING, describe_outcome, table_rows
    from minisplat_ref.runs.simplified_run import simplify_run

    result = simplify_run(asked)
    print(markdown_table(TABLE_HEADING, table_rows(result)))
    n_held = len(result["held_out"])
    print(f"measured on {n_held} of {result['train_views']} training views, held out from ranking and fine-tuning")
    if result["is_all_that_matter"]:
        n = result["chosen"]["n_gaussians"]
        print(f"minisplat-ref: {asked.target} is more than all {n:,} Gaussians that matter", file=sys.stderr)
    print(f"results in {asked.out}: point_cloud.ply, metrics.json, report.html")
    print(describe_outcome(result))
