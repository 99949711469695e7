"""The commands ``fans export``, a scene as a mesh, and ``fans fine-tune``, its vertices fitted to photographs."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.fans.mesh_files import is_fans, load_fans, save_fans, write_mesh
from minisplat_ref.extensions.fans.model import (
    FANS_OF_GAUSSIANS,
    FINE_TUNING,
    Fans,
    FanShape,
    check_shape,
    convert_gaussians,
    mesh_of,
    visible_mesh,
)
from minisplat_ref.interface.arguments import add_background, add_number
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io.ply import load_ply
from minisplat_ref.io.run_files import model_file, read_background
from minisplat_ref.mechanisms.meshes.files import check_suffix
from minisplat_ref.metrics import Evaluation, evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.fine_tuning import fine_tune as train_further
from minisplat_ref.training.representation import GAUSSIANS
from minisplat_ref.training.schedule import scale_recipe
from minisplat_ref.training.state import StepReport
from minisplat_ref.types import Model, Scene, View

DEFAULT = FanShape()
EXPORT_DESCRIPTION = """\
Write Gaussians as fans of translucent triangles with a colour and an opacity
at each vertex: a .ply, a .glb (glTF) or an .obj. Colours are those of degree
0, without view dependence. A program that shows the mesh as it is meant has to
blend its triangles in the order of their depths; an .obj has no opacities.
"""
EXPORT_EPILOG = """\
examples:
  minisplat-ref fans export runs/fox fox.glb
  minisplat-ref fans export runs/fox fox.ply --solid --reach 2.3 --rim 0.2"""
FINE_TUNE_EPILOG = """\
example:
  minisplat-ref fans fine-tune photos/fox runs/fox fans.ply --downscale 4
  minisplat-ref render fans.ply --cameras runs/fox/cameras.json
  minisplat-ref fans export fans.ply fox.glb"""


def add_parser(commands: Any) -> None:
    """Add both commands."""
    export = commands.add_parser(
        "export",
        help="write a scene as a mesh of translucent triangles",
        description=EXPORT_DESCRIPTION,
        epilog=EXPORT_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    export.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians or of fans, or a run's folder")
    export.add_argument("out", type=Path, metavar="OUT", help="mesh to write: .ply, .glb or .obj")
    export.add_argument(
        "--min-opacity",
        type=float,
        default=1 / 255,
        metavar="A",
        help="leave out triangles whose corners all are fainter (default 1/255)",
    )
    _add_shape(export)
    export.set_defaults(run=run_export)
    tune = commands.add_parser(
        "fine-tune",
        help="optimise positions, colours and opacities of a scene's vertices",
        description="Make fans of a trained scene and train their vertices, by the loss of 3DGS.",
        epilog=FINE_TUNE_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    tune.add_argument("scene", metavar="SCENE", help="folder of photographs that the model was trained on")
    tune.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians or of fans, or a run's folder")
    tune.add_argument("out", type=Path, metavar="OUT", help="PLY of fans to write")
    add_number(tune, "--downscale", 1, "make photographs D times smaller", metavar="D")
    add_number(tune, "--iterations", 1000, "length")
    add_number(tune, "--seed", 0, "of the training", minimum=0, metavar="S")
    add_background(tune)
    _add_shape(tune)
    tune.set_defaults(run=run_fine_tune)


def _add_shape(parser: Any) -> None:
    """Add ``--sides``, ``--reach``, ``--rim`` and ``--solid``."""
    shape = parser.add_argument_group("how Gaussians become fans")
    shape.add_argument(
        "--sides", type=int, default=DEFAULT.n_sides, metavar="N", help="of a fan, at least 3 (default %(default)s)"
    )
    shape.add_argument(
        "--reach",
        type=float,
        default=DEFAULT.reach,
        metavar="K",
        help="standard deviations from the centre to the rim (default %(default)s)",
    )
    shape.add_argument(
        "--rim",
        type=float,
        default=DEFAULT.rim,
        metavar="A",
        help="opacity on the rim, as a part of the centre's (default %(default)s)",
    )
    shape.add_argument("--solid", action="store_true", help="three fans each, in the planes of all pairs of axes")


# --- export ---


def run_export(args: argparse.Namespace) -> int:
    """Read, convert, write.

    Raises
    ------
    InputError
        The model or the name of the mesh cannot be used, trimesh is needed and missing, or a number is out of range.
    """
    check_suffix(args.out)
    if not 0 <= args.min_opacity <= 1:
        raise InputError(f"--min-opacity is {args.min_opacity:g}, not in [0, 1]: give such an opacity")
    fans = load_as_fans(args.model, read_shape(args))
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


def read_shape(args: argparse.Namespace) -> FanShape:
    """Return the shape that the options describe.

    Raises
    ------
    InputError
        A number is out of range.
    """
    shape = FanShape(args.sides, args.reach, args.rim, not args.solid)
    check_shape(shape)
    return shape


def load_as_fans(path: Path, shape: FanShape) -> Fans:
    """Read fans as they are, or Gaussians and make fans of them, of a PLY or a run's folder.

    Raises
    ------
    InputError
        There is no PLY of either, or none in it.
    """
    file = model_file(path)
    kind, population = ("fans", load_fans(file)) if is_fans(file) else ("Gaussians", load_ply(file))
    if len(population.means) == 0:
        raise InputError(f"{path} holds no {kind}: give a model that has been trained")
    return population if isinstance(population, Fans) else convert_gaussians(population, shape)


# --- fine-tune ---


def run_fine_tune(args: argparse.Namespace) -> int:
    """Train, write, and report the change on the test views.

    Raises
    ------
    InputError
        The scene, the model or the output cannot be used, or a number is out of range.
    """
    from minisplat_ref.datasets.named_scenes import read_scene

    if args.out.suffix.lower() != ".ply":
        raise InputError(f"{args.out}: fine-tuned fans are written as a .ply, of which fans export makes other formats")
    if not args.out.parent.is_dir():
        raise InputError(f"{args.out.parent} is no folder: make it, or give another OUT")
    start = load_as_fans(args.model, read_shape(args))
    background = read_background(model_file(args.model), args.background)
    scene = read_scene(args.scene, args.downscale, background=background)
    before = measure(start, scene, scene.test_views)
    with progress_bar("vertices", "iterations", args.iterations) as bar:
        fans = fine_tune(start, scene, args.iterations, args.seed, lambda _: bar.update())
    after = measure(fans, scene, scene.test_views)
    save_fans(args.out, fans)
    print(
        f"{len(start.means):,} fans: test PSNR {before.psnr:.2f} dB, SSIM {before.ssim:.4f}\n"
        f"fine-tuned, {len(fans.means):,} fans: {after.psnr:.2f} dB, {after.ssim:.4f}; in {args.out}"
    )
    return 0


def fine_tune(
    fans: Fans, scene: Scene, iterations: int, seed: int, on_step: Callable[[StepReport], None] | None = None
) -> Fans:
    """Return fans after some iterations of ``FINE_TUNING`` of their vertices; the given ones are not changed."""
    recipe = scale_recipe(FINE_TUNING, iterations)._replace(representation=FANS_OF_GAUSSIANS)
    result: Fans = train_further(fans, scene, recipe, seed, on_step)
    return result


def measure(population: Any, scene: Scene, views: tuple[View, ...]) -> Evaluation:
    """Compare images of fans or Gaussians with photographs."""
    renderer = find_representation(population).renderer
    return evaluate(Model(population), views, RenderSettings(scene.background, renderer=renderer))


def find_representation(population: Any) -> Any:
    """Return the renderer of a population of fans, or of Gaussians."""
    return FANS_OF_GAUSSIANS if isinstance(population, Fans) else GAUSSIANS
