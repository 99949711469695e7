"""Editing and binding: affine maps of Gaussians and colours, nearest triangles, meshes that are deformed, commands."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.fuzz.judging import judge
from data_tools.fuzz.readers import Reader, mutant
from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import load_extension
from minisplat_ref.extensions.proxies.binding import UNBOUND, bind, nearest_triangles, rebuild, triangle_distances
from minisplat_ref.extensions.proxies.cage import convex_hull, grid, sheet_through
from minisplat_ref.extensions.proxies.edit import (
    Affine,
    are_in_ball,
    are_in_box,
    edit_gaussians,
    make_affine,
    make_rotation,
)
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.mechanisms.editing.deformation import polar_rotations, quaternions
from minisplat_ref.mechanisms.editing.sh_rotation import sh_rotations
from minisplat_ref.mechanisms.meshes.mesh import Mesh, check_mesh, frames, load_mesh, save_mesh
from minisplat_ref.reference.covariance import covariances, rotation_matrices
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Gaussians
from scenes import as_dtype, balls, make_camera, make_gaussians
from tolerances import AFFINE_EDIT, CLOSED_FORM, COVERAGE_MIN, EDITED_IMAGE, PARITY_FLOAT32_PROJECTION

LINEAR = {  # A of x -> A x + b
    "rotation": make_rotation((20, -50, 70)),
    "rotation and scale": 1.7 * make_rotation((20, -50, 70)),
    "reflection": np.diag([1.0, -1.0, 1.0]) @ make_rotation((5, 6, 7)),
    "stretch": np.diag([0.3, 1.0, 4.0]),
    "shear": np.array([[1.0, 0.8, -0.3], [0.0, 1.0, 0.5], [0.2, 0.0, 1.0]]),
}
SHIFT = np.array([0.3, -0.2, 0.1])


def sigma(gaussians):
    return covariances(gaussians.quats.astype(float), np.exp(gaussians.log_scales.astype(float)))


def is_same(a, b):
    return all(x.tobytes() == y.tobytes() and x.dtype == y.dtype for x, y in zip(a, b, strict=True))


def all_of(gaussians):
    return np.ones(len(gaussians.means), bool)


def crumpled(rng, n=40, n_faces=200):
    """Return triangles with random corners, which share vertices and cross each other."""
    faces = np.array([rng.choice(n, 3, replace=False) for _ in range(n_faces)])
    return Mesh(rng.normal(size=(n, 3)), faces)


def flat_sheet(n=4):
    """Return a sheet of two by two units in the plane z = 3 in front of the test camera."""
    return grid(np.array([-1.0, -1.0, 3.0]), np.array([2.0, 0, 0]), np.array([0, 2.0, 0]), (n, n))


# Colours


@pytest.mark.parametrize("sign", [1, -1])
def test_rotated_colours_are_those_of_the_direction_rotated_back(sign, rng):
    """f'(Q d) = f(d) holds for each degree by itself."""
    Q = sign * make_rotation(tuple(rng.uniform(-180, 180, 3)))
    d = rng.normal(size=(40, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    for degree, D in enumerate(sh_rotations(Q[None], 3), 1):
        block = slice(degree**2, (degree + 1) ** 2)
        c = rng.normal(size=2 * degree + 1)
        before, after = sh_basis(d, 3)[:, block] @ c, sh_basis(d @ Q.T, 3)[:, block] @ (D[0] @ c)
        assert np.ptp(before) > 0.5
        assert_allclose(after, before, atol=CLOSED_FORM)


def test_the_rotation_of_degree_one_is_the_matrix_itself(rng):
    """Since Y_1 = C (-y, z, -x), D_1 is Q with its axes in that order."""
    Q = make_rotation((30, 40, 50))
    order, signs = [1, 2, 0], np.array([-1.0, 1.0, -1.0])
    expected = signs[:, None] * Q[np.ix_(order, order)] * signs
    assert_allclose(sh_rotations(Q[None], 1)[0][0], expected, atol=CLOSED_FORM)


def test_rotations_of_colours_compose_and_are_orthogonal(rng):
    P, Q = make_rotation((30, 40, 50)), make_rotation((-80, 10, 5))
    for D in sh_rotations(np.stack([P, Q, P @ Q]), 3):
        assert_allclose(D[0] @ D[1], D[2], atol=CLOSED_FORM)
        assert_allclose(D[2] @ D[2].T, np.eye(D.shape[1]), atol=CLOSED_FORM)


# Affine edits


@pytest.mark.parametrize("name", LINEAR)
def test_an_affine_edit_is_the_gaussian_transformed(name, rng):
    gaussians, A = make_gaussians(rng, 100), LINEAR[name]
    after = edit_gaussians(gaussians, Affine(A, SHIFT), all_of(gaussians))
    assert_allclose(after.means, gaussians.means @ A.T + SHIFT, atol=AFFINE_EDIT)
    expected = A @ sigma(gaussians) @ A.T
    assert np.abs(expected - sigma(gaussians)).max() > 0.01
    assert_allclose(sigma(after), expected, atol=AFFINE_EDIT)


@pytest.mark.parametrize("name", LINEAR)
def test_thin_gaussians_stay_thin(name, rng):
    """The volume of needles and discs a billion times as long as thick is right in every digit."""
    gaussians, A = make_gaussians(rng, 60), LINEAR[name]
    thin = gaussians._replace(log_scales=np.log(rng.permuted(np.tile([1.0, 1e-4, 1e-9], (60, 1)), axis=1)))
    after = edit_gaussians(thin, Affine(A, SHIFT), all_of(thin))
    grown = after.log_scales.sum(axis=1) - thin.log_scales.sum(axis=1)
    assert_allclose(grown, np.log(abs(np.linalg.det(A))), atol=AFFINE_EDIT)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_nothing_and_what_is_not_selected_keep_their_bytes(dtype, rng):
    gaussians = as_dtype(make_gaussians(rng, 50), dtype)
    everything, some = all_of(gaussians), rng.random(50) < 0.5
    assert is_same(
        edit_gaussians(gaussians, make_affine(np.eye(3), rng.normal(size=3), np.zeros(3)), everything), gaussians
    )
    assert_array_equal(make_rotation((0.0, 0.0, 0.0)), np.eye(3), strict=True)
    moved = edit_gaussians(gaussians, Affine(np.eye(3), SHIFT), everything)
    assert is_same(moved[1:], gaussians[1:]) and not (moved.means == gaussians.means).any()
    part = edit_gaussians(gaussians, Affine(LINEAR["shear"], SHIFT), some)
    assert all(field.dtype == dtype for field in part)
    for after, before in zip(part, gaussians, strict=True):
        assert after[~some].tobytes() == before[~some].tobytes()
    assert (part.means[some] != gaussians.means[some]).any()


def test_float32_is_rounded_once(rng):
    gaussians = as_dtype(make_gaussians(rng, 50), np.float32)
    A = LINEAR["shear"]
    after = edit_gaussians(gaussians, Affine(A, SHIFT), all_of(gaussians))
    assert_allclose(sigma(after), A @ sigma(gaussians) @ A.T, atol=PARITY_FLOAT32_PROJECTION)


def test_an_edit_and_its_inverse_cancel(rng):
    gaussians, A = make_gaussians(rng, 50), LINEAR["rotation and scale"]
    there = edit_gaussians(gaussians, Affine(A, SHIFT), all_of(gaussians))
    back = edit_gaussians(there, Affine(np.linalg.inv(A), -np.linalg.solve(A, SHIFT)), all_of(gaussians))
    assert np.abs(there.sh_rest - gaussians.sh_rest).max() > 0.1
    for name in ("means", "log_scales", "sh_rest"):
        assert_allclose(getattr(back, name), getattr(gaussians, name), atol=AFFINE_EDIT)
    assert_allclose(rotation_matrices(back.quats), rotation_matrices(gaussians.quats), atol=AFFINE_EDIT)


@pytest.mark.parametrize("scale", [1.0, 1.7])
def test_a_rotated_scene_looks_as_from_a_camera_rotated_back(scale, rng):
    """With R_c' = R_c Q^T and t_c' = s t_c - R_c Q^T b, shapes, places, order and colours of every degree agree."""
    gaussians, camera = make_gaussians(rng, 60), make_camera(rng=rng)
    Q = make_rotation((20, -50, 70))
    turned = edit_gaussians(gaussians, Affine(scale * Q, SHIFT), all_of(gaussians))
    R = camera.cam_from_world_R @ Q.T
    moved = camera._replace(cam_from_world_R=R, cam_from_world_t=scale * camera.cam_from_world_t - R @ SHIFT)
    before, _ = render(gaussians, camera, backend=REFERENCE)
    after, _ = render(turned, moved, backend=REFERENCE)
    assert before.alpha.mean() > COVERAGE_MIN
    assert_allclose(after.image, before.image, atol=EDITED_IMAGE)
    unturned, _ = render(turned._replace(sh_rest=gaussians.sh_rest), moved, backend=REFERENCE)
    assert np.abs(unturned.image - before.image).max() > 0.01


def test_quaternions_of_half_turns(rng):
    """They are right where w is 0, and close to it, for every axis."""
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(5, 3))])
    for w in (0.0, 1e-12, -1e-12, 1.0):
        quats = np.column_stack([np.full(len(axes), w), axes])
        R = rotation_matrices(quats)
        assert_allclose(rotation_matrices(quaternions(R)), R, atol=CLOSED_FORM)


def test_the_polar_factor_is_the_nearest_rotation(rng):
    """It leaves a symmetric positive factor, and no other rotation is nearer."""
    F = rng.normal(size=(20, 3, 3))
    F *= np.sign(np.linalg.det(F))[:, None, None]
    Q = polar_rotations(F)
    P = np.swapaxes(Q, 1, 2) @ F
    assert_allclose(P, np.swapaxes(P, 1, 2), atol=AFFINE_EDIT)
    assert (np.linalg.eigvalsh(P) > 0).all() and np.linalg.det(Q).min() > 0
    others = Q @ rotation_matrices(np.column_stack([np.full(20, 10.0), rng.normal(size=(20, 3))]))
    assert (np.linalg.norm(F - Q, axis=(1, 2)) < np.linalg.norm(F - others, axis=(1, 2))).all()


@pytest.mark.parametrize("A", [np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.full((3, 3), np.nan)])
def test_maps_without_an_inverse_are_refused(A, rng):
    gaussians = make_gaussians(rng, 3)
    with pytest.raises(InputError, match=r"flat|finite"):
        edit_gaussians(gaussians, Affine(A, SHIFT), all_of(gaussians))


def test_the_fixed_point_stays(rng):
    pivot = rng.normal(size=3)
    A, b = make_affine(LINEAR["shear"], pivot, SHIFT)
    assert_allclose(A @ pivot + b, pivot + SHIFT, atol=CLOSED_FORM)


def test_selections():
    means = np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2], [1, 0, 0]])
    assert_array_equal(are_in_box(means, np.zeros(3), np.ones(3)), [True, True, False, True])
    assert_array_equal(are_in_ball(means, np.zeros(3), 1.0), [True, False, False, True])


# Nearest triangles


def test_distance_from_a_triangle_by_hand():
    corners = np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0]])
    points = np.array([[1, 1, 2], [1, 1, -2], [-3, -4, 0], [2, -5, 0], [4, 3, 0], [7, 0, 4], [0, 0, 0]], float)
    expected = [2, 2, 5, 5, 12 / 5, 5, 0]  # above, below, from a corner, a side, the hypotenuse, a corner, on it
    assert_allclose(triangle_distances(points, corners), expected, atol=CLOSED_FORM)
    assert_allclose(triangle_distances(points, corners[::-1]), expected, atol=CLOSED_FORM)


@pytest.mark.parametrize("spread", [0.5, 1.0, 20.0])
def test_the_nearest_triangle_is_that_of_all(spread, rng):
    mesh, points = crumpled(rng), spread * rng.normal(size=(500, 3))
    found = nearest_triangles(points, mesh)
    distances = triangle_distances(points[:, None], mesh.corners)  # [N, T]
    assert_array_equal(found.distances, distances.min(axis=1))
    assert_array_equal(found.faces, distances.argmin(axis=1))


# Meshes


def test_the_frame_of_a_triangle(rng):
    mesh = crumpled(rng)
    E = frames(mesh)
    p0, p1, p2 = np.moveaxis(mesh.corners, 1, 0)
    assert_array_equal(E[:, :, 0], p1 - p0)
    assert_array_equal(E[:, :, 1], p2 - p0)
    h = np.linalg.norm(E[:, :, 2], axis=1)
    assert_allclose(h**2, np.linalg.norm(np.cross(p1 - p0, p2 - p0), axis=1), rtol=CLOSED_FORM)
    assert_allclose(np.einsum("ti,tik->tk", E[:, :, 2], E[:, :, :2]) / h[:, None], 0, atol=CLOSED_FORM)
    assert (np.linalg.det(E) > 0).all()


def test_a_mesh_at_rest_keeps_every_byte(rng):
    for dtype in (np.float32, np.float64):
        gaussians = as_dtype(make_gaussians(rng, 50), dtype)
        mesh = crumpled(rng)
        assert is_same(rebuild(Mesh(mesh.vertices.copy(), mesh.faces), bind(gaussians, mesh)), gaussians)


@pytest.mark.parametrize("name", ["rotation", "rotation and scale"])
def test_a_mesh_that_is_rotated_and_scaled_takes_everything_along(name, rng):
    gaussians, mesh, A = make_gaussians(rng, 60), crumpled(rng), LINEAR[name]
    carried = rebuild(Mesh(mesh.vertices @ A.T + SHIFT, mesh.faces), bind(gaussians, mesh))
    expected = edit_gaussians(gaussians, Affine(A, SHIFT), all_of(gaussians))
    assert_allclose(sigma(carried), sigma(expected), atol=AFFINE_EDIT)
    for field, other in zip(carried, expected, strict=True):
        assert_allclose(field, other, atol=AFFINE_EDIT)


def test_a_sheet_that_is_sheared_in_its_plane_shears_what_lies_in_it(rng):
    """An affine map within the plane of the triangles acts exactly on Gaussians that are flat in it."""
    A = np.array([[1.3, 0.7, 0], [-0.2, 0.8, 0], [0, 0, 1]])
    mesh, gaussians = flat_sheet(), make_gaussians(rng, 60)
    flat = gaussians._replace(
        means=np.column_stack([rng.uniform(-1, 1, (60, 2)), np.full(60, 3.0)]),
        quats=np.column_stack([rng.normal(size=60), np.zeros((60, 2)), rng.normal(size=60)]),
        log_scales=np.log(np.column_stack([rng.uniform(0.05, 0.3, (60, 2)), np.full(60, 1e-9)])),
    )
    carried = rebuild(Mesh(mesh.vertices @ A.T, mesh.faces), bind(flat, mesh))
    assert_allclose(carried.means, flat.means @ A.T, atol=AFFINE_EDIT)
    assert_allclose(sigma(carried), A @ sigma(flat) @ A.T, atol=AFFINE_EDIT)


def test_thickness_grows_with_the_root_of_the_area(rng):
    mesh, gaussians = flat_sheet(), make_gaussians(rng, 1)
    upright = gaussians._replace(
        means=np.array([[0.3, 0.2, 3.5]]), quats=np.array([[1.0, 0, 0, 0]]), log_scales=np.log([[0.2, 0.3, 0.1]])
    )
    stretched = Mesh(mesh.vertices * [4.0, 1.0, 1.0], mesh.faces)
    carried = rebuild(stretched, bind(upright, mesh))
    assert_allclose(carried.means, [[1.2, 0.2, 4.0]], atol=AFFINE_EDIT)  # an offset of 0.5, twice
    assert_allclose(np.sort(np.exp(carried.log_scales)), [[0.2, 0.3, 0.8]], atol=AFFINE_EDIT)


def test_triangles_that_stay_leave_their_gaussians(rng):
    mesh, gaussians = flat_sheet(), make_gaussians(rng, 200)
    moved = mesh.vertices.copy()
    moved[0] += [0.1, 0.2, 0.3]
    binding = bind(gaussians, mesh)
    carried = rebuild(Mesh(moved, mesh.faces), binding)
    touched = (mesh.faces[binding.faces] == 0).any(axis=1)
    assert 0 < touched.sum() < 100
    for after, before in zip(carried, gaussians, strict=True):
        assert after[~touched].tobytes() == before[~touched].tobytes()
    assert (carried.means[touched] != gaussians.means[touched]).any(axis=1).all()


def test_what_is_out_of_reach_stays(rng):
    mesh, gaussians = flat_sheet(), make_gaussians(rng, 200)
    binding = bind(gaussians, mesh, reach=0.3)
    distances = nearest_triangles(gaussians.means, mesh).distances
    assert_array_equal(binding.faces == UNBOUND, distances > 0.3)
    assert 0 < binding.n_bound < 200
    carried = rebuild(Mesh(mesh.vertices + SHIFT, mesh.faces), binding)
    assert_allclose(carried.means - gaussians.means, np.where((distances <= 0.3)[:, None], SHIFT, 0), atol=CLOSED_FORM)


def test_grids_hulls_and_sheets(rng):
    mesh = grid(np.zeros(3), np.array([3.0, 0, 0]), np.array([0, 2.0, 0]), (3, 2))
    assert mesh.vertices.shape == (12, 3) and mesh.faces.shape == (12, 3)
    assert_allclose(frames(mesh)[:, 2, 2], 1, atol=CLOSED_FORM)  # unit cells: h = 1, normals along right x up
    points = rng.normal(size=(500, 3)) * [3, 1, 0.01]
    hull, sheet = convex_hull(points), sheet_through(points, 6)
    inward = hull.corners.mean(axis=1) - hull.vertices.mean(axis=0)
    assert (np.sum(frames(hull)[:, :, 2] * inward, axis=1) > 0).all()
    assert len(sheet.faces) == 2 * 6 * 2 and np.abs(sheet.vertices[:, 2]).max() < 0.1
    for few in (points[:2], np.zeros((10, 3)), np.zeros((10, 3)) + np.arange(10)[:, None]):
        for make in (convex_hull, lambda means: sheet_through(means, 6)):
            with pytest.raises(InputError):
                make(few)


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        ([[0, 1, 4]], "face 0 has the corner 4"),
        ([[0, 1, 2], [0, -1, 2]], "face 1 has the corner -1"),
        ([[0, 1, 2], [1, 1, 2]], "triangle 1 has no area"),
        ([[0, 1, 2], [0, 1, 3]], "triangle 1 has no area"),
    ],
)
def test_bad_triangles_are_refused(faces, message):
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]]), np.array(faces))
    with pytest.raises(InputError, match=message):
        check_mesh(mesh, "mesh.ply")


def test_a_mesh_that_is_written_is_read(tmp_path, rng):
    mesh = crumpled(rng)
    save_mesh(tmp_path / "mesh.ply", mesh)
    read = load_mesh(tmp_path / "mesh.ply")
    assert_array_equal(read.vertices, mesh.vertices, strict=True)
    assert_array_equal(read.faces, mesh.faces)


def test_polygons_become_fans(tmp_path):
    vertices = "".join(f"{np.cos(a)} {np.sin(a)} 0\n" for a in 2 * np.pi * np.arange(5) / 5)
    header = "element vertex 5|property float x|property float y|property float z|element face 1"
    text = f"ply|format ascii 1.0|{header}|property list uchar int vertex_indices|end_header|".replace("|", "\n")
    (tmp_path / "a.ply").write_text(f"{text}{vertices}5 0 1 2 3 4\n")
    assert_array_equal(load_mesh(tmp_path / "a.ply").faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4]])


def write_meshes(folder):
    save_mesh(folder / "a.ply", flat_sheet(2))
    text = "ply|format ascii 1.0|element vertex 3|property float x|property float y|property float z|element face 1|"
    text += "property list uchar int vertex_indices|end_header|0 0 0|1 0 0|0 1 0|3 0 1 2|"
    (folder / "b.ply").write_text(text.replace("|", "\n"))


@settings(max_examples=200, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_damaged_meshes_are_read_or_refused(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("meshes")
    write_meshes(folder)
    reader = Reader(write_meshes, lambda _, file: load_mesh(file), ("*.ply",))
    damaged = mutant(reader, folder, lambda n: data.draw(st.integers(0, n - 1)))
    assert judge(reader, folder, damaged).finding == ""


# Commands


@pytest.fixture
def model(tmp_path, rng):
    path = tmp_path / "model.ply"
    save_ply(path, as_dtype(make_gaussians(rng, 60), np.float32))
    return path


def run(*words):
    return main(["proxies", *map(str, words)])


def test_edit_from_the_command_line(model, tmp_path, capsys):
    out, before = tmp_path / "out.ply", load_ply(model)
    assert run("edit", model, out) == 0
    assert out.read_bytes() == model.read_bytes()
    options = ("--box", -9, -9, -9, 0, 9, 9, "--scale", 2, "--rotate", 0, 30, 0, "--translate", -1, 0, 0)
    assert run("edit", model, out, *options, "--about", 0, 0, 3) == 0
    is_selected = before.means[:, 0] <= 0
    assert f"{is_selected.sum()} of 60 Gaussians edited" in capsys.readouterr().out
    affine = make_affine(2 * make_rotation((0, 30, 0)), np.array([0.0, 0, 3]), np.array([-1.0, 0, 0]))
    assert is_same(load_ply(out), edit_gaussians(before, affine, is_selected))
    assert run("edit", model, out, "--sphere", 0, 0, 3, 0.7, "--matrix", 1, 0.5, 0, 0, 1, 0, 0, 0, 1) == 0
    assert run("edit", model, out, "--scale", 1, 2, 3) == 0
    assert_allclose(load_ply(out).means.mean(axis=0), before.means.mean(axis=0), atol=PARITY_FLOAT32_PROJECTION)


def test_an_edit_by_hand(tmp_path):
    """The middle of what is selected, (1, 2, 0), stays; and scaling comes before turning: x doubled becomes y."""
    before = as_dtype(balls([[0, 2, 0], [2, 2, 0], [9, 9, 9]], [0.1, 0.2, 0.3], [0.5, 0.5, 0.5]), np.float32)
    model, out = tmp_path / "model.ply", tmp_path / "out.ply"
    save_ply(model, before)
    assert run("edit", model, out, "--box", -1, -1, -1, 3, 3, 3, "--scale", 2, 1, 1, "--rotate", 0, 0, 90) == 0
    after = load_ply(out)
    assert_allclose(after.means, [[1, 0, 0], [1, 4, 0], [9, 9, 9]], atol=PARITY_FLOAT32_PROJECTION)
    variances = np.array([[0.01, 0.04, 0.01], [0.04, 0.16, 0.04], [0.09, 0.09, 0.09]])
    assert_allclose(sigma(after), variances[:, :, None] * np.eye(3), atol=PARITY_FLOAT32_PROJECTION)


def test_edit_near_a_mesh(model, tmp_path, capsys):
    mesh, before = flat_sheet(), load_ply(model)
    save_mesh(tmp_path / "mesh.ply", mesh)
    out = tmp_path / "out.ply"
    assert run("edit", model, out, "--near", tmp_path / "mesh.ply", "--within", 0.2, "--translate", 0, 0, 1) == 0
    in_sheet = np.clip(before.means, [-1, -1, 3], [1, 1, 3])
    is_near = np.linalg.norm(before.means - in_sheet, axis=1) <= 0.2
    assert 0 < is_near.sum() < 60 and f"{is_near.sum()} of 60" in capsys.readouterr().out
    assert_array_equal((load_ply(out).means != before.means).any(axis=1), is_near)


def test_follow_from_the_command_line(model, tmp_path, capsys):
    rest, bent, out = (tmp_path / name for name in ("rest.ply", "bent.ply", "out.ply"))
    assert run("cage", model, rest, "--cells", 6) == 0
    assert run("follow", model, rest, rest, out) == 0
    assert out.read_bytes() == model.read_bytes()
    mesh = load_mesh(rest)
    save_mesh(bent, Mesh(mesh.vertices + 0.2 * np.sin(3 * mesh.vertices[:, [1, 2, 0]]), mesh.faces))
    assert run("follow", model, rest, bent, out) == 0
    assert "60 of 60 Gaussians follow" in capsys.readouterr().out
    assert is_same(load_ply(out), rebuild(load_mesh(bent), bind(load_ply(model), mesh)))
    assert run("cage", model, rest, "--hull") == 0
    assert len(load_mesh(rest).faces) > 10


def test_bad_input_is_one_line_and_writes_nothing(model, tmp_path, capsys):
    mesh, other, flat, no_faces, points = (tmp_path / f"{name}.ply" for name in "abcde")
    save_mesh(mesh, flat_sheet(2))
    save_mesh(other, flat_sheet(3))
    save_mesh(flat, Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])))
    save_mesh(no_faces, Mesh(np.zeros((3, 3)), np.zeros((0, 3), int)))
    save_ply(points, make_far())
    before = sorted(tmp_path.iterdir())
    out = tmp_path / "out.ply"
    cases = {
        ("edit", tmp_path / "none.ply", out): "cannot be opened",
        ("edit", mesh, out): "not a PLY of Gaussians",
        ("edit", model, out, "--sphere", 99, 99, 99, 1): "none of its 60 Gaussians is selected",
        ("edit", model, out, "--scale", 0): "flattens Gaussians",
        ("edit", model, out, "--scale", 1, 2): "--scale has 2 numbers",
        ("edit", model, out, "--near", mesh): "belong together",
        ("edit", model, out, "--scale", 2, "--matrix", *range(9)): "takes the place",
        ("edit", model, tmp_path / "absent" / "out.ply"): "does not exist",
        ("follow", model, no_faces, mesh, out): "a mesh of no faces",
        ("follow", model, flat, flat, out): "triangle 0 has no area",
        ("follow", model, mesh, other, out): "not the 9 and 8 of the mesh at rest",
        ("follow", points, mesh, mesh, out, "--reach", 0.1): "within 0.1 of the mesh",
        ("follow", mesh, mesh, mesh, out): "not a PLY of Gaussians",
        ("cage", points, out, "--hull"): "1 Gaussians are too few",
        ("cage", model, out, "--cells", 0): "--cells is 0",
    }
    for words, message in cases.items():
        assert run(*words) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1, (words, error)
        assert sorted(tmp_path.iterdir()) == before


def make_far():
    one = np.ones((1, 3), np.float32)
    zeros = np.zeros((1, 0, 3), np.float32)
    return Gaussians(1000 * one, np.ones((1, 4), np.float32), -one, np.ones(1, np.float32), one, zeros)


def test_fields_that_cannot_be_moved_are_said(tmp_path, model, capsys):
    moving = load_extension("velocity").representation
    save_ply(tmp_path / "moving.ply", moving.extend(load_ply(model), np.random.default_rng(0)))
    assert run("edit", tmp_path / "moving.ply", tmp_path / "out.ply", "--scale", 2) == 0
    assert "velocities_0, velocities_1, velocities_2 are left out" in capsys.readouterr().err


def test_a_real_scene_can_be_bent(shared_data, tmp_path, capsys):
    """It works on a hundred Gaussians of somebody else's training, whose rotations are not normalised."""
    model, rest, bent, out = shared_data / "ply" / "epfl_pc_short_100.ply", *(tmp_path / f"{i}.ply" for i in range(3))
    assert run("cage", model, rest, "--hull") == 0
    mesh = load_mesh(rest)
    save_mesh(bent, Mesh(mesh.vertices * [1, 1, 2], mesh.faces))
    assert run("follow", model, rest, bent, out) == 0
    after, before = load_ply(out), load_ply(model)
    assert np.isfinite(np.concatenate([field.ravel() for field in after])).all()
    assert np.corrcoef(after.means[:, 2], before.means[:, 2])[0, 1] > 0.9
