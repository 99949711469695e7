"""``oracle``: checks gradients, hard cases and other backends against the reference; one module per check."""

import argparse
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minisplat_ref.interface.arguments import Commands, HelpFormatter

if TYPE_CHECKING:
    from minisplat_ref.oracle.cases import Report

DESCRIPTION = """\
Check the renderer, or another one, against the float64 reference.
"""
EPILOG = """\
example:
  minisplat-ref oracle gradients

Exit codes: 0 all passed, 1 a case failed, 2 bad input."""


def add_parser(commands: Commands) -> None:
    """Add the command and its checks."""
    from . import compare, export, gradients, hard_cases, replay, truth

    parser = commands.add_parser(
        "oracle",
        help="check gradients, hard cases and other backends",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    checks = parser.add_subparsers(title="checks", metavar="CHECK", required=True)
    for check in (gradients, truth, hard_cases, compare, export, replay):
        check.add_parser(checks)


CALLS = {
    "rasterization_2dgs": "minisplat_ref.mechanisms.surfels.oracle",
    "rasterization_cameras": "minisplat_ref.mechanisms.cameras.oracle",
}
"""Calls besides ``rasterization``, and the packages of their oracles."""


def module_of(call: str, name: str) -> Any:
    """Return a module of a call's oracle: ``call``, ``hard_cases``."""
    return import_module(f"{CALLS[call]}.{name}")


def add_call_argument(parser: argparse.ArgumentParser) -> None:
    """Add ``--call NAME``."""
    parser.add_argument(
        "--call",
        choices=("rasterization", *CALLS),
        default="rasterization",
        metavar="NAME",
        help="rasterization (default), rasterization_2dgs for 2D Gaussian Splatting, or rasterization_cameras for"
        " rasterization with camera_model, with_ut and with_eval3d",
    )


def add_json_argument(parser: argparse._ActionsContainer) -> None:
    """Add ``--json FILE``."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the cases to FILE")


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--json FILE`` and ``--report FILE``."""
    add_json_argument(parser)
    parser.add_argument("--report", type=Path, metavar="FILE", help="also write a page to look at, like report.html")


def publish(report: "Report", args: argparse.Namespace) -> int:
    """Print the table and the verdict, write the requested files; return 1 where a case failed, else 0."""
    from minisplat_ref.oracle.cases import as_markdown, save_json, verdict

    print(f"{report.title}\n\n{as_markdown(report)}\n\n{verdict([report])}")
    if args.json is not None:
        save_json(report, args.json)
    if args.report is not None:
        from minisplat_ref.app.reports.check_report import write_page

        write_page(report, args.report)
    return 1 if report.n_failed else 0
