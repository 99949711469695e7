"""Meshes as a viewer of glTF shows them: the colours of the photographs, where ``convert`` has the Gaussians."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from data_tools.foreign_files.building import OPTIONS, done, refused
from data_tools.foreign_files.dialects import gaussians
from data_tools.foreign_files.gltf import glb_parts, only_primitive, values
from data_tools.foreign_files.places import moved
from minisplat_ref.io import save_ply
from minisplat_ref.io.ply_file import read_vertices
from minisplat_ref.mechanisms.fusion.extraction import ColoredMesh
from minisplat_ref.mechanisms.meshes.files import write_mesh

UNLIT: dict[str, object] = {"KHR_materials_unlit": {}}
LIT = 0.6  # of a light, for a program without that extension
TETRAHEDRON = (
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)


def shown(path: Path, is_lit: bool = False) -> NDArray:
    """Return the bytes [P, 3] in which a viewer shows the vertices of a file: by IEC 61966-2-1, of what is emitted."""
    document, body = glb_parts(path.read_bytes())
    primitive, material = only_primitive(document)
    linear = values(document, body, primitive["attributes"]["COLOR_0"])[:, :3].astype(float)
    if is_lit:  # what is metallic has no colour of its own
        linear = LIT * linear * (1.0 - material["pbrMetallicRoughness"].get("metallicFactor", 1.0))
    else:
        assert material["extensions"] == UNLIT
    curved = 1.055 * linear ** (1 / 2.4) - 0.055
    return np.rint(255 * np.where(linear <= 0.0031308, 12.92 * linear, curved)).astype(int)


def _colored(folder: Path, color: tuple[int, int, int]) -> None:
    """The bytes of a colour are those that a viewer shows; with lights it shows a share of them, not black."""
    vertices, faces = TETRAHEDRON
    write_mesh(folder / "mesh.glb", ColoredMesh(vertices, faces, np.tile(np.array(color) / 255, (4, 1))))
    np.testing.assert_array_equal(shown(folder / "mesh.glb"), np.tile(color, (4, 1)))
    lit = shown(folder / "mesh.glb", is_lit=True)[0]
    assert np.all(lit <= color) and np.all(lit >= 0.5 * np.array(color) - 1), lit


def _fans(folder: Path, sides: int) -> None:
    """Translucent fans have the colours of their Gaussians, which the PLY beside them has as bytes."""
    save_ply(folder / "model.ply", gaussians(0))
    for suffix in ("glb", "ply"):
        done("fans", "export", folder / "model.ply", folder / f"fans.{suffix}", "--sides", sides)
    columns = read_vertices(folder / "fans.ply")
    colors = np.stack([columns[name] for name in ("red", "green", "blue")], axis=1)
    np.testing.assert_allclose(shown(folder / "fans.glb"), colors, atol=1)


def positions(path: Path) -> NDArray:
    """Return the positions [P, 3] of a file, which no node moves."""
    document, body = glb_parts(path.read_bytes())
    assert not {"matrix", "rotation", "scale", "translation"} & set(document["nodes"][0])
    (mesh,) = document["meshes"]
    return values(document, body, mesh["primitives"][0]["attributes"]["POSITION"])


def _overlaid(folder: Path, scale: float, shift: tuple[float, float, float]) -> None:
    """Gaussians and mesh of one run lie on each other, wherever the scene is."""
    scene = moved(folder, scale, shift)
    done("train", scene, *OPTIONS, "--out", folder / "run")
    done("convert", folder / "run", folder / "gaussians.glb")
    done("mesh", folder / "run", "--voxel", 0.1 * scale, "--out", folder / "mesh.glb")
    surface, others = positions(folder / "mesh.glb"), positions(folder / "gaussians.glb")
    tree = cKDTree(others)
    distance, as_it_was = (np.median(tree.query(places)[0]) for places in (surface, surface * [-1, -1, 1]))
    assert distance < 0.5 * scale < as_it_was, (distance, as_it_was)


def _no_metal(folder: Path) -> None:
    """Nothing in a file says metal, and no program has to know the extension."""
    vertices, faces = TETRAHEDRON
    write_mesh(folder / "mesh.glb", ColoredMesh(vertices, faces, np.full((4, 3), 0.5)))
    document, body = glb_parts((folder / "mesh.glb").read_bytes())
    primitive, material = only_primitive(document)
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0 and "extensionsRequired" not in document
    normals = values(document, body, primitive["attributes"]["NORMAL"])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert json.dumps(document).count("KHR_materials_unlit") == 2


def _no_mesh(folder: Path) -> None:
    """A mesh is no Gaussians: which command reads it is said."""
    vertices, faces = TETRAHEDRON
    write_mesh(folder / "mesh.glb", ColoredMesh(vertices, faces, np.full((4, 3), 0.5)))
    refused("info", folder / "mesh.glb", names="mesh.glb")


COLORS = ((143, 126, 105), (12, 3, 0), (255, 128, 1), (40, 200, 90))

CASES: dict[str, Callable[[Path], None]] = {
    **{f"colour {' '.join(map(str, color))}": partial(_colored, color=color) for color in COLORS},
    **{f"fans of {sides} sides": partial(_fans, sides=sides) for sides in (4, 6, 8)},
    **{
        f"a run scaled by {scale:g}, moved by {shift}": partial(_overlaid, scale=scale, shift=shift)
        for scale, shift in ((1.0, (7.0, -4.0, 2.0)), (0.5, (0.0, 30.0, 0.0)), (20.0, (-200.0, 0.0, 10.0)))
    },
    "no metal": _no_metal,
    "a mesh is no Gaussians": _no_mesh,
}
