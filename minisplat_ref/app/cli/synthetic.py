"""``synthetic``: ray-traces a scene whose depth and normals are known exactly."""

import argparse
from pathlib import Path

from minisplat_ref.interface.arguments import SYNTHETIC_SCENES, Commands, HelpFormatter
from minisplat_ref.interface.progress import with_progress

DESCRIPTION = """\
Ray-trace photographs of a small world, and write them as a COLMAP scene with
sparse points. Beside it is what no photograph has: the exact depths/, normals/
and ids/ of every pixel, mesh.ply of the surfaces, and scene_info.json. Equal
arguments give equal bytes.

  room         textured walls, furniture with thin rods
  plain-wall   walls without any texture fill most of the image
  glossy       polished things, whose look changes with the viewpoint
  outdoor      open ground under a sky that has no depth

and four whose surface is the subject:
  staircase       planes at right angles, with steps in depth
  noisy-sphere    a ball; its points err by a twentieth of the radius
  facing-spheres  two balls, of which each hides part of the other
  box-city        blocks with narrow streets

and a park to be trained in blocks, in squares of 4 m:
  park-1     hedges, boulders and beds, seen while walking
  park-4     four such squares
  park-16    sixteen
"""
EPILOG = """\
example:
  minisplat-ref synthetic outdoor --views 40 --out scenes/outdoor"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "synthetic",
        help="ray-trace a scene with exact depth and normals",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("name", metavar="NAME", help=f"{', '.join(SYNTHETIC_SCENES[:-1])} or {SYNTHETIC_SCENES[-1]}")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the scene")
    parser.add_argument(
        "--views", type=int, default=24, metavar="N", help="training views; test views come on top (default 24)"
    )
    parser.add_argument("--width", type=int, default=160, metavar="PX", help="of the images (default 160)")
    parser.add_argument("--height", type=int, default=120, metavar="PX", help="of the images (default 120)")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="S", help="of textures, camera path and points (default 0)"
    )
    parser.add_argument("--supersampling", type=int, default=2, metavar="N", help="N x N samples a pixel (default 2)")
    parser.add_argument("--points", type=int, default=4000, metavar="N", help="sparse points (default 4000)")
    parser.add_argument(
        "--point-noise",
        type=float,
        metavar="M",
        help="standard error of the points, metres (default 0, but 0.025 for noisy-sphere)",
    )
    parser.add_argument(
        "--test-every", type=int, default=8, metavar="K", help="every K-th view is for testing, 0: none (default 8)"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Trace the scene, write it, and print its content."""
    from functools import partial

    from minisplat_ref.datasets.synthetic import make_scene
    from minisplat_ref.datasets.synthetic.files import check_free, write_scene
    from minisplat_ref.datasets.synthetic.triangles import triangulate_world
    from minisplat_ref.mechanisms.fusion.extraction import ColoredMesh
    from minisplat_ref.mechanisms.meshes.files import write_mesh

    settings = {
        "n_views": args.views,
        "width": args.width,
        "height": args.height,
        "seed": args.seed,
        "supersampling": args.supersampling,
        "n_points": args.points,
        "point_noise": args.point_noise,
        "test_every": args.test_every,
    }
    check_free(args.out)
    progress = partial(with_progress, description="ray-tracing", unit="views")
    synthetic = make_scene(args.name, **settings, progress=progress)
    triangles = triangulate_world(synthetic.world)
    mesh = ColoredMesh(triangles.vertices, triangles.faces, triangles.colors)
    write_scene(
        synthetic,
        args.out,
        {"scene": args.name, **settings},
        lambda folder: write_mesh(folder / "mesh.ply", mesh),
    )
    scene = synthetic.scene
    counts = f"{len(scene.train_views)} training and {len(scene.test_views)} test views, {len(scene.points)} points"
    print(f"{args.out}: {counts}")
    return 0
