"""The page that ``mesh`` writes beside a mesh: the mesh from four sides, beside renders of the run."""

from pathlib import Path

import numpy as np

from minisplat_ref.app.reports.images import Image8, to_8_bits
from minisplat_ref.app.reports.page import add_caption, page, panel, section, table
from minisplat_ref.app.runs.meshing import Meshed, MeshOptions, Opened
from minisplat_ref.io.frames import place_points
from minisplat_ref.io.upright import turn_upright
from minisplat_ref.mechanisms.fusion.extraction import ColoredMesh
from minisplat_ref.mechanisms.peeling.kernels import peel
from minisplat_ref.mechanisms.peeling.layers import Frame, TranslucentMesh
from minisplat_ref.types import Camera, Floats, view_from

N_SIDES = 4
NEAR = 1e-3  # of the distance to the middle of the mesh
WHITE = np.ones(3)


def vertex_normals(mesh: ColoredMesh) -> Floats:
    """Return the normals [P, 3] of the vertices: sums over their triangles, weighted by area, of length 1."""
    p0, p1, p2 = np.moveaxis(mesh.corners, 1, 0)
    across = np.cross(p1 - p0, p2 - p0)  # [T, 3]
    sums = np.zeros_like(mesh.vertices)
    for corner in mesh.faces.T:
        np.add.at(sums, corner, across)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.finfo(float).tiny)


def render_mesh(mesh: ColoredMesh, colors: Floats, camera: Camera) -> Image8:
    """Render a mesh with a colour at each vertex, opaque, on white."""
    opaque = TranslucentMesh(mesh.vertices, np.column_stack([colors, np.ones(len(colors))]), mesh.faces)
    distance = float(np.linalg.norm(mesh.vertices.mean(axis=0) - camera.center))
    return to_8_bits(peel(opaque, Frame(camera, NEAR * distance, 1), WHITE).image)


def report_html(opened: Opened, options: MeshOptions, meshed: Meshed, name: Path) -> str:
    """Return the page."""
    mesh = meshed.mesh._replace(vertices=place_points(meshed.mesh.vertices, opened.frame))
    normals = 0.5 + 0.5 * vertex_normals(mesh)
    sides = opened.views[:: -(-len(opened.views) // N_SIDES)]
    panels = []
    for view in sides:
        view = view._replace(camera=turn_upright(view.camera, opened.up.direction))
        camera = opened.adapt_camera(view)
        splats = to_8_bits(opened.trained.render(view_from(view.camera, time=view.time)).image[..., :3])
        images = {
            "as the run shows it": splats,
            "the mesh": render_mesh(mesh, mesh.colors, camera),
            "its normals as colours": render_mesh(mesh, normals, camera),
        }
        panels.append(panel(view.name, [add_caption(image, caption) for caption, image in images.items()]))
    size = " x ".join(f"{length:.4g}" for length in np.ptp(meshed.mesh.vertices, axis=0))
    facts = [
        ("run", str(options.run)),
        ("triangles, vertices", f"{len(mesh.faces):,}, {len(mesh.vertices):,}"),
        ("in smaller parts, left out", f"{meshed.n_left_out:,} triangles"),
        ("voxel", f"{meshed.voxel:.4g} in the unit of the scene"),
        ("grid", " x ".join(map(str, meshed.shape)) + (" in contracted space" if options.is_unbounded else "")),
        ("size", size),
        ("depth", f"{options.depth.value}, of {meshed.n_views} views"),
    ]
    introduction = "Normals are shown as colours: red is world x, green y, blue z, each from -1 (dark) to 1 (bright)."
    return page(
        f"{name.name}: a mesh of {options.run.name}", introduction, [table(facts), section("From four sides", *panels)]
    )
