"""``simplify``: a smaller model from a run, at a stated loss."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.interface.arguments import Commands, HelpFormatter, decibels, integer

if TYPE_CHECKING:
    from minisplat_ref.app.runs.simplified_run import SimplifyOptions

FINE_TUNE = 300  # iterations at each size

DESCRIPTION = """\
Make a run smaller: merge Gaussians that are near each other, and fine-tune.
What is lost is measured on every training view, by copies that were fine-tuned
without it; the test views are measured once, at the end.

  --max-drop dB   the smallest size that loses at most so much PSNR, with one
                  standard error on top; 0.1 where no option is given
  --budget N      at most this many Gaussians, whatever is lost
  --max-bytes B   as many as a PLY of at most B bytes holds (for a compact
                  file, minisplat-ref convert has --max-bytes of its own)

Where every smaller size loses more than --max-drop, the run is as small as it
gets: a line says so, and NEW holds its Gaussians unchanged. So it may be
after recipe adaptive, which removes by itself what is not worth its place.

NEW is a run folder for render, eval, info and convert, with point_cloud.ply,
metrics.json, result.json (curve and decision), figure.png and report.html.
Each size takes as long as 3 times --fine-tune iterations of training, and the
search measures at least 2; how long that will take is said when it begins.
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
    target.add_argument("--max-drop", type=decibels, metavar="dB", help="PSNR that may be lost (default 0.1)")
    target.add_argument("--budget", type=integer(1), metavar="N", help="Gaussians that may stay")
    target.add_argument("--max-bytes", type=integer(1), metavar="B", help="size that the PLY may have")
    fine_tune = f"iterations at each size (default {FINE_TUNE})"
    parser.add_argument("--fine-tune", type=integer(0), default=FINE_TUNE, metavar="N", help=fine_tune)
    parser.add_argument("--scene", type=Path, metavar="PATH", help="where the photographs are now, if they have moved")
    parser.set_defaults(run=run, needs=("matplotlib",))


def run(args: argparse.Namespace) -> int:
    """Simplify, print the table, what was decided and what became of the test views."""
    from minisplat_ref.app.runs.first_use import compile_kernels
    from minisplat_ref.app.runs.settings import load
    from minisplat_ref.app.runs.simplification import Target
    from minisplat_ref.app.runs.simplified_run import SimplifyOptions

    compile_kernels(load(args.folder).backend)
    target = Target(args.max_drop, args.budget, args.max_bytes)
    simplify(SimplifyOptions(args.folder, args.out, target, args.fine_tune, args.scene))
    return 0


def simplify(options: "SimplifyOptions") -> None:
    """Simplify a run and print how that went.

    Raises
    ------
    InputError
        See :func:`minisplat_ref.app.runs.simplified_run.simplify_run`.
    """
    from minisplat_ref.app.runs.simplification_report import (
        TABLE_HEADING,
        describe_decision,
        describe_outcome,
        table_rows,
    )
    from minisplat_ref.app.runs.simplified_run import simplify_run
    from minisplat_ref.interface.reporting import markdown_table

    result = simplify_run(options)
    print(markdown_table(TABLE_HEADING, table_rows(result)))
    print(describe_decision(result))
    if result["is_all_that_matter"]:
        n = result["chosen"]["n_gaussians"]
        print(f"minisplat-ref: {options.target} is more than all {n:,} Gaussians that matter", file=sys.stderr)
    print(f"results in {options.out}: point_cloud.ply, metrics.json, report.html")
    print(describe_outcome(result))
