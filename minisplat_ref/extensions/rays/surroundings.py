"""The surroundings of the Gaussians: lights, mirrors, glass and meshes, from a JSON file.

    {
      "lights": [[0, -3, 1]],
      "ambient": 0.3,
      "bias": 0.02,
      "surfaces": [
        {"kind": "mirror", "corner": [-1, -1, 4], "sides": [[2, 0, 0], [0, 2, 0]]},
        {"kind": "glass", "mesh": "block.ply", "index": 1.5},
        {"kind": "diffuse", "mesh": "chair.ply", "color": [0.8, 0.6, 0.4]}
      ]
    }

A surface is a parallelogram, or the triangles of a PLY, whose path is relative to the folder of the JSON. Glass is a
closed mesh whose normals point outwards. "color" is white by default. "ambient" is the fraction of light that comes
from no lamp and casts no shadow. "bias" is the fraction of the way from a Gaussian to a lamp on which nothing shadows
it; without it, a floor of many Gaussians would lie in its own shadow.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.rays.geometry import Whitened
from minisplat_ref.extensions.rays.surfaces import DIFFUSE, GLASS, MIRROR, Surfaces, normals_of
from minisplat_ref.io.json_file import as_array, as_number, read_json
from minisplat_ref.mechanisms.meshes.mesh import Mesh, check_mesh, load_mesh
from minisplat_ref.types import Floats

KINDS = {"diffuse": DIFFUSE, "mirror": MIRROR, "glass": GLASS}
KEYS = {"lights", "ambient", "bias", "surfaces"}
SURFACE_KEYS = {"kind", "mesh", "corner", "sides", "color", "index"}
OPAQUE = 0.5  # alpha of a Gaussian at a lamp above which the lamp is refused
INDEX = 1.5  # of window glass
MOST = 1e9  # of a coordinate, and of an index of refraction


class Surroundings(NamedTuple):
    """Lights and surfaces."""

    lights: Floats
    """[L, 3] world frame; all of the same brightness."""
    ambient: float
    """Fraction in [0, 1] of light that casts no shadow."""
    bias: float
    """Fraction in [0, 1) of the way from a Gaussian to a lamp on which no Gaussian counts."""
    surfaces: Surfaces


def surfaces_of(mesh: Mesh, kind: int, color: Floats | None = None, index: float = INDEX) -> Surfaces:
    """Return the triangles of a mesh as surfaces of one kind; ``color`` is white by default."""
    n = len(mesh.faces)
    colors = np.tile(np.ones(3) if color is None else color, (n, 1))
    return Surfaces(mesh.corners, normals_of(mesh.corners), np.full(n, kind), colors, np.full(n, index))


def concatenate_surfaces(surfaces: list[Surfaces]) -> Surfaces:
    """Return several surfaces as one, which is empty if there are none."""
    nothing = Surfaces(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0))
    return Surfaces(*(np.concatenate(fields) for fields in zip(nothing, *surfaces, strict=True)))


def parallelogram(corner: Floats, sides: Floats) -> Mesh:
    """Return two triangles; the normal is along the cross product of the sides [2, 3]."""
    vertices = corner + np.array([np.zeros(3), sides[0], sides[0] + sides[1], sides[1]])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))


def read(path: Path) -> Surroundings:
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
    return surfaces_of(mesh, kind, color, index)


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
