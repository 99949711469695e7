"""The command ``minisplat-ref rays render``: a trained scene among lights, mirrors, glass and meshes.

The surroundings of the Gaussians are in a JSON file, whose form is in the help of the command. "color" is white by
default. "bias" is there because without it a floor of many Gaussians would lie in its own shadow.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.rays.lights import (
    DIFFUSE,
    GLASS,
    INDEX,
    MIRROR,
    Surfaces,
    Surroundings,
    World,
    concatenate_surfaces,
    make_surfaces,
    parallelogram,
    shade,
)
from minisplat_ref.extensions.rays.model import Whitened, make_tracer, whiten_model
from minisplat_ref.interface.arguments import add_background
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io import orbits, viewpoints, write_image
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.json_file import as_array, as_number, read_json
from minisplat_ref.io.label import warn_of_another
from minisplat_ref.io.names import file_names
from minisplat_ref.io.ply import load_ply, read_label
from minisplat_ref.io.run_files import CAMERAS, model_file, read_background
from minisplat_ref.mechanisms.meshes.mesh import Mesh, check_mesh, load_mesh
from minisplat_ref.mechanisms.rays.pixel_rays import pixel_rays
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Floats, Model

KINDS = {"diffuse": DIFFUSE, "mirror": MIRROR, "glass": GLASS}
KEYS = {"lights", "ambient", "bias", "surfaces"}
SURFACE_KEYS = {"kind", "mesh", "corner", "sides", "color", "index"}
OPAQUE = 0.5  # alpha of a Gaussian at a lamp above which the lamp is refused
MOST = 1e9  # of a coordinate, and of an index of refraction
ORBIT_SIZE = (320, 240)  # pixels
DESCRIPTION = """\
Trace a scene together with lights, mirrors, glass and meshes, which a JSON file
describes:

  {"lights": [[0, -3, 1]], "ambient": 0.3, "bias": 0.02, "surfaces": [
    {"kind": "mirror", "corner": [-1, -1, 4], "sides": [[2, 0, 0], [0, 2, 0]]},
    {"kind": "glass", "mesh": "block.ply", "index": 1.5},
    {"kind": "diffuse", "mesh": "chair.ply", "color": [0.8, 0.6, 0.4]}]}

A surface is a parallelogram, or the triangles of a PLY, whose path is relative
to the folder of the JSON. Glass is a closed mesh whose normals point outwards.
"ambient" is the fraction of light that casts no shadow, "bias" the fraction of
the way from a Gaussian to a lamp on which nothing shadows it.
"""
EPILOG = """\
example:
  minisplat-ref rays render runs/fox --scene lamp_and_mirror.json --out lit"""


def read_surroundings(path: Path) -> Surroundings:
    """Read the surroundings from a JSON file.

    Raises
    ------
    InputError
        It cannot be read, a name in it is unknown, a number is out of range, a surface has no area, or glass is open.
    """
    content = read_json(path, "give the lights and surfaces as minisplat-ref rays render --help shows")
    if not isinstance(content, dict):
        raise InputError(f"{path} does not hold an object with {', '.join(sorted(KEYS))}")
    _check_keys(content, KEYS, str(path))
    lights, surfaces = content.get("lights", []), content.get("surfaces", [])
    if not (isinstance(lights, list) and isinstance(surfaces, list)):
        raise InputError(f"{path}: lights and surfaces must be lists")
    places = [_vector(light, f"{path}, light {i}") for i, light in enumerate(lights)]
    ambient, bias = as_number(content.get("ambient", 0.3)), as_number(content.get("bias", 0.02))
    for name, number in (("ambient", ambient), ("bias", bias)):
        if not 0 <= number <= 1:
            raise InputError(f"{path}: {name} is {content[name]}: give a number from 0 to 1")
    parts = [_surface(entry, f"{path}, surface {i}", path.parent) for i, entry in enumerate(surfaces)]
    return Surroundings(np.array(places).reshape(-1, 3), ambient, bias, concatenate_surfaces(parts))


def check_lights(surroundings: Surroundings, gaussians: Whitened, source: str | Path) -> None:
    """Refuse a light inside an opaque Gaussian, which would hide it from everything.

    Raises
    ------
    InputError
        There is one; the line names both.
    """
    for i, light in enumerate(surroundings.lights):
        offsets = np.einsum("nij,nj->ni", gaussians.maps, light - gaussians.means)
        alphas = np.nan_to_num(gaussians.opacities * np.exp(-0.5 * np.sum(offsets**2, axis=1)))
        if alphas.max(initial=0.0) >= OPAQUE:
            place = ", ".join(f"{x:g}" for x in light)
            raise InputError(
                f"{source}: light {i} at ({place}) lies inside Gaussian {np.argmax(alphas)}, whose alpha there is"
                f" {alphas.max():.2f} and would hide it from everything: move the light"
            )


def _surface(entry: Any, where: str, folder: Path) -> Surfaces:
    if not isinstance(entry, dict):
        raise InputError(f"{where} is not an object with a kind")
    _check_keys(entry, SURFACE_KEYS, where)
    kind = KINDS.get(str(entry.get("kind")))
    if kind is None:
        raise InputError(f"{where}: kind is {entry.get('kind')!r}: choose from {', '.join(KINDS)}")
    if ("mesh" in entry) == ("corner" in entry and "sides" in entry):
        raise InputError(f"{where}: give either mesh, the path of a PLY, or corner and sides")
    if "mesh" in entry:
        if not isinstance(entry["mesh"], str):
            raise InputError(f"{where}: mesh is {entry['mesh']!r}: give the path of a PLY")
        mesh = load_mesh(folder / entry["mesh"])
    else:
        sides = as_array(entry["sides"], (2, 3))
        if sides is None or not np.abs(sides).max() <= MOST:  # False for NaN
            raise InputError(f"{where}: sides must be 2 x 3 finite numbers")
        mesh = parallelogram(_vector(entry["corner"], where), sides)
        check_mesh(mesh, where)
    if kind == GLASS:
        _check_closed(mesh, where)
    color = as_array(entry.get("color", [1, 1, 1]), (3,))
    if color is None or not ((color >= 0) & (color <= 1)).all():
        raise InputError(f"{where}: color must be 3 numbers from 0 to 1")
    index = as_number(entry.get("index", INDEX))
    if not 1 <= index <= MOST:
        raise InputError(f"{where}: index is {entry['index']}: the index of refraction of glass is at least 1")
    return make_surfaces(mesh, kind, color, index)


def _check_closed(mesh: Mesh, where: str) -> None:
    """Refuse a mesh in which an edge does not run once in either direction, so that glass would be open."""
    edges = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=2).reshape(-1, 2)
    there, back = (np.sort(ends[:, 0] * len(mesh.vertices) + ends[:, 1]) for ends in (edges, edges[:, ::-1]))
    if not np.array_equal(there, back) or (np.diff(there) == 0).any():
        raise InputError(f"{where}: glass must be a closed mesh, whose normals point outwards; close it")


def _check_keys(content: dict[str, Any], known: set[str], where: str) -> None:
    if strange := sorted(content.keys() - known):
        raise InputError(f"{where}: {strange[0]!r} is unknown: choose from {', '.join(sorted(known))}")


def _vector(value: Any, where: str) -> Floats:
    vector = as_array(value, (3,))
    if vector is None or not np.abs(vector).max() <= MOST:  # False for NaN
        raise InputError(f"{where}: {value!r} is not 3 finite numbers")
    return vector


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "render",
        help="render a scene among lights, mirrors, glass and meshes",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians, or the folder of a run")
    parser.add_argument("--scene", type=Path, required=True, metavar="JSON", help="lights and surfaces, see above")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the images")
    parser.add_argument("--cameras", type=Path, metavar="JSON", help="cameras.json (default: the run's test views)")
    parser.add_argument("--frames", type=int, default=12, metavar="N", help="of an orbit without cameras (default 12)")
    add_background(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Trace an image for each camera.

    Raises
    ------
    InputError
        The model, the surroundings or the cameras cannot be used.
    """
    if args.frames < 1:
        raise InputError(f"--frames is {args.frames}: give at least 1")
    around = read_surroundings(args.scene)
    file = model_file(args.model)
    background = read_background(file, args.background)
    gaussians = load_ply(file)
    warn_of_another(file, read_label(file), "rays", "rays render")
    whitened = whiten_model(Model(gaussians))
    check_lights(around, whitened, args.scene)
    views = _views(args, gaussians.means)
    world = World(gaussians, make_tracer(whitened, GSPLAT_MAIN, CPU), around, background, GSPLAT_MAIN)
    with making_folder(args.out) as folder:
        names = file_names([view.name for view in views])
        for name, view in zip(names, with_progress(views, "tracing", "views"), strict=True):
            image = shade(world, pixel_rays(view.camera, GSPLAT_MAIN))
            write_image(folder / f"{name}.png", image.reshape(view.camera.height, view.camera.width, 3))
    print(f"{len(views)} images in {args.out}")
    return 0


def _views(args: argparse.Namespace, means: Floats) -> list[viewpoints.Viewpoint]:
    """Return the cameras that are given, those of the run's test views, or an orbit."""
    if args.cameras is not None:
        return viewpoints.read(args.cameras)
    path = args.model / CAMERAS
    if args.model.is_dir() and path.exists():
        known = viewpoints.read(path)
        return [view for view in known if view.split == "test"] or known
    return orbits.orbit(means, [], args.frames, *ORBIT_SIZE)
