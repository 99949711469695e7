"""``mesh``: the surface of a run as a triangle mesh."""

import argparse
from pathlib import Path

from minisplat_ref.interface.arguments import Commands, HelpFormatter, add_up_argument, integer, positive

DESCRIPTION = """\
Write the surface of a run as a triangle mesh with colours: .ply, .obj or .glb
(glTF). Its training cameras render depths, which are fused on a grid of voxels
(TSDF), and marching cubes find the surface. A page beside the mesh, FILE.html,
shows it from four sides.

The grid is a box around the surface that the cameras see. With --unbounded it
reaches to infinity, and its voxels grow with the distance. A voxel is as large
as a pixel on the surface, if that is at most 16 million voxels; a smaller one
shows more detail and more noise, and takes 40 bytes.
"""
EPILOG = """\
examples:
  minisplat-ref mesh runs/fox --out fox.ply
  minisplat-ref mesh runs/fox --out fox.glb --voxel 0.02 --depth expected"""
DEPTHS = ("median", "expected", "midpoint")


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "mesh",
        help="write the surface of a run as a triangle mesh",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("folder", type=Path, metavar="RUN", help="the --out folder of a training")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="mesh to write: .ply, .obj or .glb")
    parser.add_argument("--voxel", type=positive, metavar="S", help="size of a voxel, in the scene's unit (see above)")
    parser.add_argument(
        "--depth",
        choices=DEPTHS,
        default=DEPTHS[0],
        help="which depth of a pixel: where half of the light is left (default), the mean, or the dominant Gaussian's",
    )
    parser.add_argument("--unbounded", action="store_true", help="also what lies outside of the box, up to infinity")
    parser.add_argument(
        "--min-views", type=integer(1), default=2, metavar="N", help="views that must see a place (default 2)"
    )
    parser.add_argument(
        "--parts", type=integer(1), default=50, metavar="N", help="keep the N largest connected parts (default 50)"
    )
    add_up_argument(parser)
    parser.set_defaults(run=run, needs=("matplotlib",))


def run(args: argparse.Namespace) -> int:
    """Fuse, write the mesh and its page, and print their content."""
    from minisplat_ref.app.runs.depth_maps import DepthKind
    from minisplat_ref.app.runs.mesh_report import report_html
    from minisplat_ref.app.runs.meshing import MeshOptions, mesh_run, open_for_mesh
    from minisplat_ref.io.formats import write_content
    from minisplat_ref.io.upright import describe_up, upright_rotation
    from minisplat_ref.mechanisms.meshes.files import check_suffix, write_mesh

    check_suffix(args.out)
    kind = DepthKind(args.depth)
    options = MeshOptions(args.folder, kind, args.voxel, args.unbounded, args.min_views, args.parts)
    opened = open_for_mesh(args.folder, args.up)
    print(describe_up(opened.up))
    meshed = mesh_run(opened, options)
    mesh = meshed.mesh
    if args.out.suffix.lower() == ".glb":  # in whose frame y is up; the others have the scene's
        mesh = mesh._replace(vertices=mesh.vertices @ upright_rotation(opened.up.direction).T)
    write_mesh(args.out, mesh)
    html = args.out.with_suffix(".html")
    write_content(html, report_html(opened, options, meshed, args.out).encode())
    size = " x ".join(map(str, meshed.shape))
    print(
        f"{len(meshed.mesh.faces):,} triangles in {args.out}: {meshed.n_views} views on {size} voxels of"
        f" {meshed.voxel:.4g}; {meshed.n_left_out:,} triangles in small parts were left out"
    )
    print(f"page: {html}")
    return 0
