"""``oracle export``: golden vectors, with which a renderer in any language can be tested."""

import argparse
from pathlib import Path

from minisplat_ref.app.cli.oracle import CALLS, add_call_argument, module_of
from minisplat_ref.interface.arguments import Commands, HelpFormatter

DESCRIPTION = """\
Write golden vectors: the inputs, outputs, cotangents and gradients of every
stage of the reference, in float64, as plain arrays in .npz files.

They test a renderer in any language without our code. DIR/README.md explains
every array; DIR/manifest.json tells programs the same, with the conventions of
each scene, the tolerances and a hash of each file.
"""
EPILOG = """\
example:
  minisplat-ref oracle export golden    # 9 scenes, 3 MB
  YOUR_PROGRAM golden mine              # reads golden/SCENE/*.npz, writes mine
  minisplat-ref oracle compare mine     # names the first stage that differs
  minisplat-ref oracle export golden_2dgs --call rasterization_2dgs"""


def add_parser(checks: Commands) -> None:
    """Add the command."""
    parser = checks.add_parser(
        "export",
        help="write golden vectors for testing another renderer",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("out", type=Path, metavar="DIR", help="new folder")
    add_call_argument(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the folder and check it by reading it."""
    if args.call in CALLS:
        from minisplat_ref.oracle import call_files

        names = ", ".join(scene.name for scene in call_files.export(module_of(args.call, "call").CALL, args.out))
        print(f"wrote {args.out}: scenes {names}; start with {args.out / 'README.md'}")
        return 0
    from minisplat_ref.oracle.golden.files import export, load
    from minisplat_ref.oracle.golden.scenes import golden_scenes

    export(args.out, golden_scenes())
    scenes = load(args.out)
    print(f"wrote {args.out}: {len(scenes)} scenes ({', '.join(scenes)}); start with {args.out / 'README.md'}")
    return 0
