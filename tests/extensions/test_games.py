"""GaMeS: places on a face by hand, their gradient, Gaussians on faces of their own, and a training on a mesh."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.games.model import (
    ON_FACES,
    FaceGaussians,
    face_frames,
    from_mesh,
    on_faces,
    on_own_faces,
    place,
    place_vjp,
)
from minisplat_ref.io.frames import place_scene, return_population
from minisplat_ref.io.ply import load_ply, read_label
from minisplat_ref.mechanisms.meshes.mesh import Mesh, save_mesh
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.types import Frame, Gaussians, Model, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT64, ROUNDED_TO_FLOAT32

P0, P1, P2 = [2.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]  # around the origin, facing z


def on_face(weights=(0.5, 0.25, 0.25), rho=2.0, corners=(P0, P1, P2)):
    """One Gaussian on a face."""
    plain = Gaussians(*(np.zeros(shape) for shape in ((1, 3), (1, 4), (1, 3), (1,), (1, 3), (1, 0, 3))))
    p0, p1, p2 = (np.array([p], float) for p in corners)
    return FaceGaussians(*plain, np.log([weights]), np.log([rho]), p0, p1, p2)


# By hand


def test_a_face_around_the_origin():
    """m = 0 and n = z, so r2 = x with |p0| = 2, r3 = y with p1 . y = 1; the thickness is sqrt(2) thousandths."""
    g = place(on_face())
    assert_allclose(g.means, [[0.5, 0.0, 0.0]], atol=CLOSED_FORM)
    assert_allclose(rotation_matrices(g.quats)[0].T, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=CLOSED_FORM)
    assert_allclose(np.exp(g.log_scales), [[2 * 1e-3 * np.sqrt(2), 4.0, 2.0]], rtol=CLOSED_FORM)


def test_the_order_of_corners_says_where_outside_is():
    """p2 before p1 turns the normal to -z and r3 with it; the lengths stay."""
    g, other = (place(on_face((1 / 3, 1 / 3, 1 / 3), corners=c)) for c in ((P0, P1, P2), (P0, P2, P1)))
    assert_allclose(rotation_matrices(other.quats)[0].T, [[0, 0, -1], [1, 0, 0], [0, -1, 0]], atol=CLOSED_FORM)
    assert_allclose(other.log_scales, g.log_scales, rtol=CLOSED_FORM)


def test_weights_do_not_depend_on_a_common_logit():
    g = on_face()
    assert_allclose(place(g._replace(corner_logits=g.corner_logits + 800)).means, [[0.5, 0, 0]], atol=PARITY_FLOAT64)


def test_what_moves_the_corners_moves_the_gaussian():
    """Rotated, doubled and moved away from the origin, where p1 . r3 and (p1 - m) . r3 differ."""
    R = rotation_matrices(np.array([[0.3, -0.5, 0.7, 0.2]]))[0]
    moved = [2 * R @ np.array(p) + [5.0, -3.0, 1.0] for p in (P0, P1, P2)]
    rest, g = place(on_face()), place(on_face(corners=moved))
    assert_allclose(g.means[0], 2 * R @ rest.means[0] + [5, -3, 1], rtol=CLOSED_FORM)
    assert_allclose(rotation_matrices(g.quats)[0], R @ rotation_matrices(rest.quats)[0], atol=CLOSED_FORM)
    assert_allclose(g.log_scales, rest.log_scales + np.log(2), rtol=CLOSED_FORM)


# Gradient


def test_gradient_of_places(rng):
    g = on_own_faces(as_dtype(make_gaussians(rng, 4), np.float64), rng)
    a, sizes = rng.normal(size=(4, 3)), rng.normal(size=4)

    def function(a, sizes):
        placed = place(g._replace(corner_logits=a, log_sizes=sizes))
        return placed.means, placed.log_scales

    def vjp(v_means, v_log_scales):
        v = place_vjp(free, place(free)._replace(means=v_means, log_scales=v_log_scales))
        assert not (v.means.any() or v.quats.any() or v.log_scales.any())  # no parameters
        return v.corner_logits, v.log_sizes

    free = g._replace(corner_logits=a, log_sizes=sizes)
    check_jacobian(function, vjp, (a, sizes), names=("corner_logits", "log_sizes"))


# Degenerate


def test_flat_gaussians_on_faces_of_their_own_are_3dgs(rng, backend):
    g = as_dtype(make_gaussians(rng, 12), np.float64)
    thin = g.log_scales.copy()
    thin[:, 0] = thin[:, 1:].mean(axis=1) + np.log(1e-3)
    g = g._replace(log_scales=thin)
    request = Request(np.full(3, 0.2), backend=backend)
    view = view_from(make_camera())
    ours, _ = ON_FACES.renderer.render(Model(on_own_faces(g, rng)), view, request)
    theirs, _ = SPLATTING.render(Model(g), view, request)
    assert theirs.image.std() > 0.05
    assert_allclose(ours.image, theirs.image, atol=PARITY_FLOAT64)


# A mesh


@pytest.fixture(scope="module")
def wall():
    return make_scene("plain-wall", n_views=6, width=32, height=24, supersampling=1, n_points=200, test_every=3)


@pytest.fixture(scope="module")
def mesh(wall):
    """A wall of its own: the box of the scene's points, at their mean height, in 2 x 3 cells."""
    points = wall.scene.points
    (x0, y0, z0), (x1, y1, z1) = points.min(axis=0), points.max(axis=0)
    thin = int(np.argmin([x1 - x0, y1 - y0, z1 - z0]))
    u, v = (axis for axis in range(3) if axis != thin)
    vertices = np.zeros((12, 3))
    i, j = np.divmod(np.arange(12), 4)
    vertices[:, thin] = points[:, thin].mean()
    low, high = points.min(axis=0), points.max(axis=0)
    vertices[:, u] = low[u] + i / 2 * (high - low)[u]
    vertices[:, v] = low[v] + j / 3 * (high - low)[v]
    cells = [4 * a + b for a in range(2) for b in range(3)]
    faces = [face for c in cells for face in ((c, c + 4, c + 5), (c, c + 5, c + 1))]
    return Mesh(vertices, np.array(faces))


def test_gaussians_lie_evenly_on_their_faces(wall, mesh, rng):
    """Weights of uniform places have the mean 1/3 and the variance 1/18; the rows of a face follow one another."""
    g = on_faces(mesh, wall.scene, 1, rng, per_face=400)
    assert g.sh_rest.shape == (4800, 3, 3) and all(field.dtype == np.float32 for field in g)
    assert_array_equal(g.p1[400:800], np.broadcast_to(mesh.corners[1, 1].astype(np.float32), (400, 3)))
    weights = np.exp(g.corner_logits)
    assert_allclose(weights.mean(axis=0), 1 / 3, atol=0.01)
    assert_allclose(weights.var(axis=0), 1 / 18, rtol=0.05)
    assert_allclose(g.log_sizes, np.log(1 / 40), rtol=ROUNDED_TO_FLOAT32)  # 1 / (2 sqrt(400))
    frames = face_frames(g.p0, g.p1, g.p2)
    assert_allclose(g.log_scales, frames.log_lengths + np.log(1 / 40), rtol=1e-4)


def test_colors_are_those_of_the_nearest_points(wall, mesh, rng):
    """Each level over 255 is 1/2 + c_0 Y_0 with Y_0 = 1 / (2 sqrt(pi)); without points all is gray."""
    g = on_faces(mesh, wall.scene, 0, rng, per_face=2)
    nearest = np.argmin(((g.means[:, None] - wall.scene.points) ** 2).sum(axis=2), axis=1)
    levels = 255 * (0.5 + g.sh_dc / (2 * np.sqrt(np.pi)))
    assert_allclose(levels, wall.scene.point_colors[nearest], atol=1e-3)  # float32 of levels
    none = wall.scene._replace(points=np.zeros((0, 3)), point_colors=np.zeros((0, 3), np.uint8))
    assert not on_faces(mesh, none, 0, rng, per_face=2).sh_dc.any()


def test_a_mesh_of_files_is_placed_with_its_scene(wall, mesh, tmp_path, rng):
    """In a frame with the origin (40, 0, -8) and the unit 2, p' = (p - o) / 2; and back again for the file."""
    frame = Frame((40.0, 0.0, -8.0), 2.0)
    save_mesh(tmp_path / "mesh.ply", mesh)
    g = from_mesh(tmp_path / "mesh.ply", place_scene(wall.scene, frame), 0, rng, per_face=1)
    assert_allclose(g.p1, (mesh.corners[:, 1] - [40, 0, -8]) / 2, rtol=ROUNDED_TO_FLOAT32)
    returned = return_population(g, ON_FACES.units, frame)
    for name, corner in zip(("p0", "p1", "p2"), np.moveaxis(mesh.corners, 1, 0), strict=True):
        assert_allclose(getattr(returned, name), corner, atol=1e-5)  # float32 of 20 units


@pytest.fixture(scope="module")
def trained(wall, mesh, tmp_path_factory):
    folder = tmp_path_factory.mktemp("games")
    write_scene(wall, folder / "wall", {})
    save_mesh(folder / "mesh.ply", mesh)
    words = ["train", folder / "wall", "--recipe", "games", "--init", folder / "mesh.ply", "--set", "per_face=4"]
    words += ["--iterations", 30, "--test-every", 3, "--out", folder / "run"]
    assert main([str(word) for word in words]) == 0
    return folder


def test_a_training_stays_on_its_faces(trained, mesh):
    path = trained / "run" / "point_cloud.ply"
    g = load_ply(path, FaceGaussians)
    assert read_label(path).extension == "games" and len(g.means) == 48
    assert_array_equal(g.p0, np.repeat(mesh.corners[:, 0], 4, axis=0).astype(np.float32))
    placed = place(g)
    for name in ("means", "quats", "log_scales"):  # what other viewers read is what is trained
        assert_allclose(getattr(g, name), getattr(placed, name), atol=ROUNDED_TO_FLOAT32)
    assert np.abs(g.log_sizes + np.log(4)).max() > 1e-3  # 2 sqrt(4); they have moved
    thin = int(np.argmin(np.ptp(mesh.vertices, axis=0)))
    assert_allclose(g.means[:, thin], mesh.vertices[0, thin], atol=ROUNDED_TO_FLOAT32)


def test_a_run_goes_on_and_is_bound_again(trained, capsys):
    words = ["train", trained / "wall", "--recipe", "games", "--init", trained / "run", "--iterations", 2]
    words += ["--test-every", 3, "--out", trained / "more"]
    assert main([str(word) for word in words]) == 0
    assert "48 Gaussians of" in capsys.readouterr().out
    files = [trained / "run" / "point_cloud.ply", trained / "mesh.ply", trained / "mesh.ply", trained / "same.ply"]
    assert main(["proxies", "follow", *map(str, files)]) == 0
    assert_array_equal(load_ply(trained / "same.ply").means, load_ply(files[0]).means)


BAD = {
    "no file": ([], "recipe games trains gaussians on faces, which do not start from the scene's points: give --init"),
    "points": (["--init", "points.ply"], "a mesh of no faces"),
    "elsewhere": (["--init", "far.ply"], "no training view sees any of its 12 faces"),
    "none": (["--init", "mesh.ply", "--set", "per_face=0"], "per_face is 0: give at least 1"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case, trained, mesh, capsys, monkeypatch):
    monkeypatch.chdir(trained)
    options, message = BAD[case]
    save_mesh("far.ply", mesh._replace(vertices=mesh.vertices + 1e4))
    if not (trained / "points.ply").exists():
        main(["convert", "run", "points.ply"])
    capsys.readouterr()
    words = ["train", "wall", "--recipe", "games", "--test-every", "3", "--iterations", "2", *options, "--out", "no"]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not (trained / "no").exists()
