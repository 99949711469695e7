"""The command ``minisplat-ref fans export``: a trained scene as a mesh for other programs."""

import argparse
import sys
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.fans.arguments import add_shape, load_as_fans, shape_of

DESCRIPTION = """\
Write Gaussians as fans of translucent triangles with a colour and an opacity
at each vertex: a .ply, a .glb (glTF) or an .obj. Colours are those of degree
0, without view dependence. A program that shows the mesh as it is meant has to
blend its triangles in the order of their depths; an .obj has no opacities.
"""
EPILOG = """\
examples:
  minisplat-ref fans export runs/fox fox.glb
  minisplat-ref fans export runs/fox fox.ply --solid --reach 2.3 --rim 0.2"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "export",
        help="write a scene as a mesh of translucent triangles",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians or of fans, or a run's folder")
    parser.add_argument("out", type=Path, metavar="OUT", help="mesh to write: .ply, .glb or .obj")
    parser.add_argument(
        "--min-opacity",
        type=float,
        default=1 / 255,
        metavar="A",
        help="leave out triangles whose corners all are fainter (default 1/255)",
    )
    add_shape(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, convert, write.

    Raises
    ------
    InputError
        The model or the name of the mesh cannot be used, trimesh is needed and missing, or a number is out of range.
    """
    from minisplat_ref.extensions.fans.mesh_files import write_mesh
    from minisplat_ref.extensions.fans.shapes import mesh_of, visible_mesh
    from minisplat_ref.mechanisms.meshes.files import check_suffix

    check_suffix(args.out)
    if not 0 <= args.min_opacity <= 1:
        raise InputError(f"--min-opacity is {args.min_opacity:g}, not in [0, 1]: give such an opacity")
    fans = load_as_fans(args.model, shape_of(args))
    whole = mesh_of(fans)
    mesh = visible_mesh(whole, args.min_opacity)
    write_mesh(args.out, mesh)
    left_out = len(whole.faces) - len(mesh.faces)
    print(
        f"{len(fans.means):,} fans in {args.out}: {len(mesh.faces):,} triangles, {len(mesh.vertices):,} vertices,"
        f" {args.out.stat().st_size:,} bytes; {left_out:,} triangles were too faint"
    )
    if args.out.suffix.lower() == ".obj":
        print("minisplat-ref: an .obj holds no opacities, so that its triangles are opaque", file=sys.stderr)
    return 0
