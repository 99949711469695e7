"""``oracle gradients``: checks that every gradient is the derivative of what is computed."""

import argparse
from typing import TYPE_CHECKING

from minisplat_ref.app.cli.oracle import add_output_arguments, publish
from minisplat_ref.constants import GSPLAT_MAIN, PROFILES
from minisplat_ref.interface.arguments import BACKENDS as NAMES
from minisplat_ref.interface.arguments import Commands, HelpFormatter

if TYPE_CHECKING:
    from minisplat_ref.rendering.backends import Backend

DESCRIPTION = """\
Check the gradient of every stage, of the whole render and of rasterization in
every mode, for every backend, in float64:

  Jacobian         every entry, on a tiny scene, against differences
  inner products   a random direction for each input, on a larger one
  torch autograd   through gsplat's functions, with the extra [peers]

A difference across a threshold is refused, and a check of nothing fails.

With --extension NAME everything that the extension has of its own is checked,
for every backend: its whole renderer with respect to every field of its
population and every shared parameter, at time 0.7; its loss terms and those of
its recipes, whatever their weight; and the stages that it names. Renderer and
stages must compute the same on every backend. An extension that has nothing of
its own to check fails.
"""
EPILOG = """\
examples:
  minisplat-ref oracle gradients
  minisplat-ref oracle gradients --backend reference --profile INRIA
  minisplat-ref oracle gradients --extension velocity
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
        "--backend", choices=NAMES, metavar="NAME", help="reference, cpu or cpu-exact alone (default: all of them)"
    )
    parser.add_argument(
        "--profile",
        type=str.upper,
        choices=tuple(PROFILES),
        default=GSPLAT_MAIN.name,
        metavar="NAME",
        help=f"rasteriser conventions: {', '.join(PROFILES)} (default {GSPLAT_MAIN.name})",
    )
    parser.add_argument("--extension", metavar="NAME", help="check this extension instead of the core")
    add_output_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Check, print the table."""
    if args.extension is not None:
        return _check_extension(args)
    from minisplat_ref.oracle.gradients import AUTOGRAD, check_all_gradients

    report = check_all_gradients(_backends(args), PROFILES[args.profile])
    print(f"{AUTOGRAD}: {report.settings[AUTOGRAD]}")
    return publish(report, args)


def _check_extension(args: argparse.Namespace) -> int:
    from minisplat_ref.extensions.extension import load_extension
    from minisplat_ref.oracle.relatives import Relative, check_relative_gradients

    e = load_extension(args.extension)
    relative = Relative(e.name, e.representation, e.losses, e.recipes, e.stages)
    return publish(check_relative_gradients(_backends(args), PROFILES[args.profile], relative), args)


def _backends(args: argparse.Namespace) -> "tuple[Backend, ...]":
    from minisplat_ref.rendering.backends import BACKENDS, get_backend

    return tuple(BACKENDS.values()) if args.backend is None else (get_backend(args.backend),)
