"""Fusion of depth maps: by hand, planes and spheres, both statements, contracted space, parts, and files."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.foreign_files.gltf import glb_parts, only_primitive, values
from minisplat_ref.errors import InputError
from minisplat_ref.io.srgb import encode_srgb
from minisplat_ref.mechanisms.fusion import kernels, reference, volume
from minisplat_ref.mechanisms.fusion.extraction import (
    ColoredMesh,
    extract,
    keep_largest,
    marching_cubes_package,
    without_flat,
)
from minisplat_ref.mechanisms.fusion.volume import Contraction, DepthMap, Grid, Volume, empty_volume
from minisplat_ref.mechanisms.meshes.files import check_suffix, to_glb, write_mesh
from minisplat_ref.mechanisms.meshes.mesh import check_mesh, flat_triangles, load_mesh
from minisplat_ref.types import Camera
from tolerances import CLOSED_FORM, ROUNDED_TO_FLOAT32

BOTH = pytest.mark.parametrize("fuse", [reference.fuse, kernels.fuse], ids=["reference", "kernel"])


def looking_at(center, target, focal=60.0, width=80, height=60):
    """A camera at ``center`` that looks at ``target``."""
    forward = np.asarray(target, float) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.1, 1.0, 0.2])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return Camera(R, -R @ np.asarray(center, float), focal, focal, width / 2, height / 2, width, height)


def rays_of(camera):
    """Directions [H, W, 3] of camera z 1, world frame."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    return rays @ camera.cam_from_world_R


def plane_depth(camera, normal, offset):
    """Camera z of the plane ``n . x = offset``."""
    return (offset - camera.center @ normal) / (rays_of(camera) @ normal)


def sphere_depth(camera, radius):
    """Camera z of a sphere about the origin; 0 beside it."""
    d, o = rays_of(camera), camera.center
    a, b, c = np.sum(d * d, axis=-1), d @ o, o @ o - radius**2
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)


def around(n, distance):
    """Positions [n, 3] spread evenly over a sphere."""
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return distance * np.column_stack([r * np.cos(angle), r * np.sin(angle), z])


# One voxel after the other --------------------------------------------------------------------------------------------


@BOTH
def test_voxels_on_the_axis_by_hand(fuse):
    """Views at 2.0 and 1.95 of voxels at 1.2, 1.9, 2.1 and 2.3, with a truncation of 0.2.

    The first is far before (1), the second 0.1 and 0.05 before (0.5 and 0.25), the third 0.1 and 0.15 behind; the last
    is hidden by more than the truncation and stays unknown.
    """
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 2.5, 2.5, 5, 5)
    found = []
    for z in (1.2, 1.9, 2.1, 2.3):
        grid = Grid((0.0, 0.0, z), 0.1, (1, 1, 1))
        seen = empty_volume(grid)
        for depth, red in ((2.0, 0.8), (1.95, 0.4)):
            fuse(seen, grid, camera, DepthMap(np.full((5, 5), depth), np.full((5, 5, 3), red)), 0.2)
        found.append([float(field.ravel()[0]) for field in seen])
    distances, weights, reds, n_near = np.transpose(found)
    assert_allclose(distances, [1, 0.375, -0.625, 0], rtol=ROUNDED_TO_FLOAT32)
    assert_array_equal(weights, [2, 2, 2, 0])
    assert_array_equal(n_near, [0, 2, 2, 0])
    assert_allclose(reds, [0, 0.6, 0.6, 0], rtol=ROUNDED_TO_FLOAT32)


@BOTH
def test_between_two_objects_there_is_none(fuse):
    """Where the depth jumps from 2 to 3, a voxel takes that of its own pixel, and not the 2.4 of the mean."""
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 1.0, 0.5, 2, 1)
    view = DepthMap(np.array([[2.0, 3.0]]), np.array([[[1.0, 0, 0], [0, 1.0, 0]]]))
    for x, shown in ((-0.01, 2.0), (0.01, 3.0)):
        grid = Grid((x, 0.0, shown - 0.05), 0.1, (1, 1, 1))
        seen = empty_volume(grid)
        fuse(seen, grid, camera, view, 0.1)
        assert_allclose(seen.distances, 0.5, rtol=ROUNDED_TO_FLOAT32)
        assert_allclose(seen.colors[0, 0, 0], view.image[0, int(shown) - 2])


@BOTH
def test_nothing_is_said_beside_the_image_behind_the_camera_or_where_no_surface_is(fuse):
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 2.5, 2.5, 5, 5)
    depth = np.full((5, 5), 2.0)
    depth[2, 2] = 0
    for place in ((0.6, 0, 2.0), (0, -0.6, 2.0), (0, 0, -2.0), (0, 0, 0), (0, 0, 2.0)):
        grid = Grid(place, 0.1, (1, 1, 1))
        seen = empty_volume(grid)
        fuse(seen, grid, camera, DepthMap(depth, np.ones((5, 5, 3))), 0.2)
        assert not any(field.any() for field in seen)


@pytest.mark.parametrize("contraction", [None, Contraction((0.1, -0.2, 0.0), 1.5)])
def test_both_statements_agree(contraction, rng):
    """Noise with holes, from inside and outside of the grid."""
    grid = Grid((-2.013, -1.987, -2.031), 0.151, (28, 27, 26), contraction)  # no voxel between two pixels
    ours, theirs = empty_volume(grid), empty_volume(grid)
    for center in ((0.0, 0.0, 3.0), (0.3, 0.2, 0.0)):
        camera = looking_at(np.array(center), [0.5, 0, -4])
        depth = rng.uniform(0.5, 5.0, (60, 80)) * (rng.random((60, 80)) > 0.1)
        depth[:30] = plane_depth(camera, np.array([0.1, 0.2, 1.0]), -2.0)[:30]
        view = DepthMap(np.maximum(depth, 0), rng.random((60, 80, 3)))
        reference.fuse(theirs, grid, camera, view, 0.4)
        kernels.fuse(ours, grid, camera, view, 0.4)
    assert 1000 < np.count_nonzero(ours.weights) and np.count_nonzero(ours.n_near) > 300
    for a, b in zip(ours, theirs, strict=True):
        assert_allclose(a, b, rtol=ROUNDED_TO_FLOAT32, atol=ROUNDED_TO_FLOAT32)


# Surfaces -------------------------------------------------------------------------------------------------------------


def test_a_plane_is_exact_at_any_angle(rng):
    """To a hundredth of a voxel: the distance along z bends a little between two voxels."""
    normal = np.array([0.2, 0.3, 1.0]) / np.linalg.norm([0.2, 0.3, 1.0])
    grid = Grid((-1.0, -1.0, -1.0), 0.05, (41, 41, 41))
    seen = empty_volume(grid)
    for center in 3 * np.array([[0.3, 0.1, 1], [-0.4, 0.2, 1], [0.2, -0.5, 0.9], [0, 0, 1]]):
        camera = looking_at(center, np.zeros(3))
        view = DepthMap(plane_depth(camera, normal, 0.1), np.full((60, 80, 3), [0.2, 0.4, 0.6]))
        kernels.fuse(seen, grid, camera, view, 0.2)
    mesh = extract(seen, grid, 2)
    assert len(mesh.faces) > 1000
    assert np.abs(mesh.vertices @ normal - 0.1).max() < 0.01 * grid.voxel
    corners = mesh.corners
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ normal > 0).all()  # to the cameras
    assert_allclose(mesh.colors, np.tile([0.2, 0.4, 0.6], (len(mesh.colors), 1)), atol=1e-6)


def ball(contraction=None):
    """A volume of a sphere of radius 1, seen from all sides."""
    grid = Grid((-1.3,) * 3, 0.065, (41, 41, 41), contraction)
    seen = empty_volume(grid)
    for center in around(30, 4.0):
        camera = looking_at(center, np.zeros(3), focal=120.0)
        kernels.fuse(seen, grid, camera, DepthMap(sphere_depth(camera, 1.0), np.ones((60, 80, 3))), 0.325)
    return seen, grid


def test_a_closed_body_is_watertight():
    """Each edge belongs to two triangles.

    Voxels just outside of the far side of the limb lie behind a thin cap by less than the truncation, and count as
    inside, so that bodies swell: here by less than half of a voxel.
    """
    mesh = extract(*ball(), 2)
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    swollen = (np.linalg.norm(mesh.vertices, axis=1) - 1) / 0.065
    assert -0.1 < swollen.min() < swollen.mean() < 0.3 and swollen.max() < 0.6
    p0, p1, p2 = np.moveaxis(mesh.corners, 1, 0)
    inside = np.sum(np.cross(p0, p1) * p2) / 6
    assert inside == pytest.approx(4 / 3 * np.pi * (1 + swollen.mean() * 0.065) ** 3, rel=0.01)


def test_where_the_surface_runs_through_voxels_no_triangle_is_flat_and_no_hole_is_left():
    """An octahedron whose faces go through centres of voxels, where marching cubes put several corners in one place."""
    grid = Grid((-10.0,) * 3, 1.0, (21, 21, 21))
    empty = empty_volume(grid)
    distances = (np.abs(grid.places()).sum(axis=-1) - 6).astype(empty.distances.dtype) / 6
    seen = empty._replace(distances=distances, weights=np.full_like(empty.weights, 2))
    raw, _, _, _ = marching_cubes_package().marching_cubes(seen.distances, 0.0)
    assert len(np.unique(raw, axis=0)) < len(raw)
    mesh = extract(seen, grid, 2)
    check_mesh(mesh, "octahedron")
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
    p0, p1, p2 = np.moveaxis(mesh.corners, 1, 0)
    assert np.sum(np.cross(p0, p1) * p2) / 6 == pytest.approx(4 / 3 * 6**3, rel=ROUNDED_TO_FLOAT32)


def test_flat_triangles_by_hand():
    """Corners 1 and 2 are one place, so triangle 0 vanishes and 1 has corner 1; the corners of 2 lie on one line."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1e-9, 0], [1, 1, 0], [2, 0, 0], [4, 0, 0]], np.float64)
    mesh = ColoredMesh(vertices, np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5]]), np.zeros((6, 3)))
    assert flat_triangles(mesh.corners).tolist() == [True, False, True]
    assert without_flat(mesh).faces.tolist() == [[0, 1, 3]]
    none = mesh._replace(faces=np.zeros((0, 3), np.int64))
    assert without_flat(none).faces.shape == (0, 3)


def test_contracted_space_by_hand():
    """At twice the radius from the centre ``|y|`` is 2 - 1/2; there and back again changes nothing."""
    grid = Grid((-2.0,) * 3, 0.1, (41, 41, 41), Contraction((1.0, 0.0, 0.0), 3.0))
    assert_allclose(
        grid.from_world(np.array([[7.0, 0, 0], [1.0, 1.5, 0]])), [[1.5, 0, 0], [0, 0.5, 0]], rtol=CLOSED_FORM
    )
    points = np.random.default_rng(0).normal(size=(100, 3)) * 10
    assert_allclose(grid.to_world(grid.from_world(points)), points, rtol=1e-11)


@BOTH
def test_far_away_voxels_have_a_longer_truncation(fuse):
    """With ``|y|`` = 1.5 it is doubled: a voxel 0.3 before the surface of a truncation of 0.3 has d = 1/2."""
    grid = Grid((0.0, 0.0, 1.5), 0.1, (1, 1, 1), Contraction((0.0, 0.0, 0.0), 1.0))  # at z = 2 in the world
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 2.5, 2.5, 5, 5)
    seen = empty_volume(grid)
    fuse(seen, grid, camera, DepthMap(np.full((5, 5), 2.3), np.ones((5, 5, 3))), 0.3)
    assert_allclose(seen.distances, 0.5, rtol=ROUNDED_TO_FLOAT32)


def test_cells_that_few_views_have_seen_are_left_out():
    seen, grid = ball()
    half = seen._replace(weights=np.where(grid.places()[..., 0] > 0, seen.weights, 1))
    mesh = extract(half, grid, 2)
    assert 0 <= mesh.vertices[:, 0].min() < 2 * grid.voxel
    with pytest.raises(InputError, match="no surface: no cell of the grid was seen by 99 views"):
        extract(seen, grid, 99)
    with pytest.raises(InputError, match="no surface"):
        extract(seen._replace(distances=np.ones_like(seen.distances)), grid, 1)


def test_the_largest_parts_stay():
    """Parts of two, one and three triangles."""
    vertices = np.arange(36.0).reshape(12, 3)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [7, 8, 9], [7, 9, 10], [7, 10, 11]])
    mesh = ColoredMesh(vertices, faces, vertices / 36)
    kept = keep_largest(mesh, 2)
    assert_array_equal(kept.corners, mesh.corners[[0, 1, 3, 4, 5]])
    assert len(kept.vertices) == len(kept.colors) == 9
    assert_array_equal(keep_largest(mesh, 1).corners, mesh.corners[3:])
    assert_array_equal(keep_largest(mesh, 9).corners, mesh.corners)


def test_a_grid_that_does_not_fit_is_refused_with_one_that_does(monkeypatch):
    monkeypatch.setattr(volume, "free_bytes", lambda: 40e6 / 8)
    with pytest.raises(
        InputError, match=r"100 x 100 x 100 voxels of 0\.01 take about 40 MB, 5 MB are free: --voxel 0\.021"
    ):
        empty_volume(Grid((0.0, 0.0, 0.0), 0.01, (100, 100, 100)))
    assert isinstance(empty_volume(Grid((0.0, 0.0, 0.0), 0.021, (48, 48, 48))), Volume)


# Files ----------------------------------------------------------------------------------------------------------------

TETRAHEDRON = ColoredMesh(
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.2, 0.4, 0.6]]),
)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".GLB"])
def test_other_programs_open_it(suffix, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / f"mesh{suffix}"
    write_mesh(path, TETRAHEDRON)
    (opened,) = trimesh.load_scene(path, process=False).geometry.values()
    assert opened.is_watertight and opened.volume == pytest.approx(1 / 6)
    is_glb = suffix.lower() == ".glb"
    expected = TETRAHEDRON.vertices * ([-1, -1, 1] if is_glb else 1)
    order = [int(np.argmin(np.abs(opened.vertices - v).sum(axis=1))) for v in expected]
    assert_allclose(opened.vertices[order], expected, atol=ROUNDED_TO_FLOAT32)
    if is_glb:
        colors = 255 * encode_srgb(np.asarray(opened.visual.vertex_attributes["color"], float))
    else:
        colors = np.asarray(opened.visual.vertex_colors)[:, :3]
    assert_allclose(colors[order], np.rint(255 * TETRAHEDRON.colors), atol=1)


def read_glb(mesh):
    """Return the JSON of a mesh's file, its positions, colours and faces."""
    pytest.importorskip("trimesh")
    document, body = glb_parts(to_glb(mesh.vertices, mesh.colors, mesh.faces))
    primitive, _ = only_primitive(document)
    names = primitive["attributes"]
    assert set(names) == {"POSITION", "NORMAL", "COLOR_0"} and primitive.get("mode", 4) == 4  # triangles
    positions, colors = (values(document, body, names[name]) for name in ("POSITION", "COLOR_0"))
    return document, positions, colors, values(document, body, primitive["indices"]).reshape(-1, 3)


def test_colours_of_gltf_are_linear_by_hand():
    """Of 0.5, ((0.5 + 0.055) / 1.055)^2.4 = 0.2140; of 0.04, on the line, 0.04 / 12.92; beyond the ends, the ends."""
    encoded = np.array([[0.5, 0.04, 0.0], [1.0, 0.5, 0.04], [-0.5, 1.5, 1.0], [0.0, 0.0, 0.0]])
    _, _, colors, _ = read_glb(TETRAHEDRON._replace(colors=encoded))
    half, dark = 0.21404114, 0.04 / 12.92
    assert colors.dtype == np.float32  # a byte would be 1 of 255, not 0.79
    assert_allclose(colors, [[half, dark, 0], [1, half, dark], [0, 1, 1], [0, 0, 0]], rtol=ROUNDED_TO_FLOAT32)


def test_colours_of_gltf_keep_every_level():
    levels = np.arange(256)
    many = ColoredMesh(np.eye(256, 3), TETRAHEDRON.faces, np.repeat(levels[:, None] / 255, 3, axis=1))
    _, _, colors, _ = read_glb(many)
    assert_allclose(255 * encode_srgb(colors.astype(float)), np.repeat(levels[:, None], 3, axis=1), atol=1e-4)


def test_the_material_of_gltf_is_matt_and_not_lit():
    """Without these, glTF's defaults are those of a metal, which is dark where nothing is to be mirrored."""
    document, *_ = read_glb(TETRAHEDRON)
    _, material = only_primitive(document)
    assert material["pbrMetallicRoughness"] == {"metallicFactor": 0, "roughnessFactor": 1}
    assert material["extensions"] == {"KHR_materials_unlit": {}}
    assert document["extensionsUsed"] == ["KHR_materials_unlit"] and "extensionsRequired" not in document
    assert material.get("alphaMode", "OPAQUE") == "OPAQUE" and not material.get("doubleSided", False)


def test_the_axes_of_gltf():
    """X and y change sign, a rotation: triangles are still seen from outside, and the volume is positive."""
    moved = TETRAHEDRON._replace(vertices=TETRAHEDRON.vertices + np.array([2.0, 3.0, 5.0]))
    document, positions, _, faces = read_glb(moved)
    assert_array_equal(positions, moved.vertices * [-1, -1, 1])
    assert_array_equal(positions[0], [-2, -3, 5])
    assert_array_equal(faces, moved.faces)
    p0, p1, p2 = np.moveaxis(positions[faces].astype(float), 1, 0)
    assert np.sum(np.cross(p0, p1) * p2) / 6 == pytest.approx(1 / 6)
    assert not {"matrix", "rotation", "scale", "translation"} & set(document["nodes"][0])


def test_normals_of_gltf_point_outward_by_hand():
    """At the corner of three right angles they add up to -(1, 1, 1), at (1, 0, 0) to (1, 1, 1) - (0, 1, 0) - (0, 0, 1);
    x and y then change sign. A vertex without triangles has one, too."""
    loose = TETRAHEDRON._replace(
        vertices=np.concatenate([TETRAHEDRON.vertices, [[9.0, 9, 9]]]), colors=np.ones((5, 3), float)
    )
    document, body = glb_parts(to_glb(loose.vertices, loose.colors, loose.faces))
    primitive, _ = only_primitive(document)
    normals = values(document, body, primitive["attributes"]["NORMAL"])
    third = 1 / np.sqrt(3)
    expected = [[third, third, -third], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, 1]]
    assert_allclose(normals, expected, atol=ROUNDED_TO_FLOAT32)


def test_gltf_of_no_triangles_is_a_file():
    """It has no meshes, as accessors of glTF have at least one element."""
    pytest.importorskip("trimesh")
    document, body = glb_parts(to_glb(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3), int)))
    assert not document.get("meshes") and body == b""


def test_a_ply_far_from_the_origin_keeps_its_place(tmp_path):
    far = TETRAHEDRON._replace(vertices=TETRAHEDRON.vertices + np.array([4e5, 5e6, 0]))
    write_mesh(tmp_path / "far.ply", far)
    assert_array_equal(load_mesh(tmp_path / "far.ply").vertices, far.vertices)


def test_another_name_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"mesh\.stl is not named like a mesh: .*\.ply, \.glb, \.obj"):
        check_suffix(tmp_path / "mesh.stl")
