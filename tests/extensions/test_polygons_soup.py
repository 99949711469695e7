"""Polygon soups: files that go out and come back, edits carried to Gaussians, and what is refused."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims.polygons import edits as claims
from minisplat_ref.app.cli import main
from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.polygons.soup import carry_gaussians, load_corners, make_soup, save_soup
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.io.ply_faces import read_faces
from minisplat_ref.io.ply_file import read_vertices, write_vertices
from minisplat_ref.mechanisms.editing.deformation import Deformation, deform
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.types import Gaussians
from scenes import as_dtype, make_gaussians
from tolerances import AFFINE_EDIT, EDITED_IMAGE, PARITY_FLOAT64

TURN = rotation_matrices(np.array([[0.8, 0.2, -0.4, 0.4]]))[0]


def model(rng, n=30):
    """Flat Gaussians, two of them too faint to have a polygon."""
    g = make_gaussians(rng, n)
    g.log_scales[np.arange(n), np.argmin(g.log_scales, axis=1)] -= 8
    g.opacity_logits[[3, 7]] = -9
    return g


def is_same(a, b):
    return all(x.tobytes() == y.tobytes() and x.dtype == y.dtype for x, y in zip(a, b, strict=True))


def write_soup(path, vertices, faces):
    write_vertices(path, dict(zip("xyz", np.asarray(vertices).T, strict=True)), faces)


@pytest.fixture
def files(tmp_path, rng):
    """A model and its exported soup."""
    save_ply(tmp_path / "model.ply", model(rng))
    assert main(["polygons", "export", str(tmp_path / "model.ply"), "--out", str(tmp_path / "soup.ply")]) == 0
    return tmp_path / "model.ply", tmp_path / "soup.ply"


def one(**fields):
    """A Gaussian of deviations 1 and 0.5 in the plane z = 2."""
    means, quats, log_scales = np.array([[0.0, 0, 2]]), np.array([[1.0, 0, 0, 0]]), np.log([[1.0, 0.5, 0.01]])
    plain = Gaussians(means, quats, log_scales, np.full(1, 4.0), np.zeros((1, 3)), np.zeros((1, 0, 3)))
    return plain._replace(**fields)


# --- there and back ---


def test_a_soup_has_the_polygons_of_what_can_be_seen(files, capsys):
    gaussians, columns, faces = load_ply(files[0]), read_vertices(files[1]), read_faces(files[1])
    assert len(faces) == 28 and {len(face) for face in faces} == {8} and len(columns["x"]) == 224
    assert columns["x"].dtype == np.float64
    assert_array_equal(np.concatenate(faces), np.arange(224))
    centres = np.column_stack([columns[name] for name in "xyz"]).reshape(28, 8, 3).mean(axis=1)
    assert_allclose(centres, np.delete(gaussians.means, [3, 7], axis=0), atol=1e-12)
    opacities = np.delete(1 / (1 + np.exp(-gaussians.opacity_logits)), [3, 7])
    assert_allclose(columns["alpha"][::8], 255 * opacities, atol=0.51)


def test_what_was_not_moved_keeps_its_bytes(files, tmp_path, capsys):
    """Also when a mesh tool rounded the vertices to float32, or gave them in another order."""
    columns, faces = read_vertices(files[1]), np.stack(read_faces(files[1]))
    xyz = np.column_stack([columns[name] for name in "xyz"])
    order = np.random.default_rng(0).permutation(len(xyz))
    write_soup(tmp_path / "rounded.ply", xyz.astype(np.float32), faces)
    write_soup(tmp_path / "shuffled.ply", xyz[order], np.argsort(order)[faces])
    for name in ("soup", "rounded", "shuffled"):
        out = tmp_path / f"{name}_out.ply"
        assert main(["polygons", "edit", str(files[0]), str(tmp_path / f"{name}.ply"), "--out", str(out)]) == 0
        assert "0 of 30 Gaussians follow" in capsys.readouterr().out
        assert out.read_bytes() == files[0].read_bytes()


def test_colours_turn_along(rng):
    before = model(rng)
    soup = make_soup(before, 8)
    after, _ = carry_gaussians(before, soup, 0.7 * soup.corners @ TURN.T, "it")
    direct = deform(before, before.means, Deformation(0.7 * TURN[None], np.zeros(30, int)))
    assert_allclose(after.sh_rest[soup.rows], direct.sh_rest[soup.rows], atol=AFFINE_EDIT)
    d = rng.normal(size=(5, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    seen = np.einsum("dk,nkc->ndc", sh_basis(d, 3)[:, 1:], before.sh_rest[soup.rows])
    turned = np.einsum("dk,nkc->ndc", sh_basis(d @ TURN.T, 3)[:, 1:], after.sh_rest[soup.rows])
    assert_allclose(turned, seen, atol=PARITY_FLOAT64)


def test_the_plane_stays_the_plane_when_a_polygon_shrinks(rng):
    """By more than its Gaussian is thick: a plain 3DGS model has thick ones."""
    before = make_gaussians(rng, 20)
    soup = make_soup(before, 8)
    centres = soup.corners.mean(axis=1, keepdims=True)
    after, _ = carry_gaussians(before, soup, centres + 0.01 * (soup.corners - centres), "it")
    assert_allclose(make_soup(after, 8).corners, centres + 0.01 * (soup.corners - centres), atol=PARITY_FLOAT64)
    assert_allclose(after.log_scales, before.log_scales + np.log(0.01), atol=1e-9)


def test_one_moved_vertex_changes_one_gaussian(files, tmp_path, capsys):
    columns, faces = read_vertices(files[1]), np.stack(read_faces(files[1]))
    columns["y"][8 * 5] += 0.05
    write_vertices(tmp_path / "moved.ply", columns, faces)
    out = tmp_path / "out.ply"
    assert main(["polygons", "edit", str(files[0]), str(tmp_path / "moved.ply"), "--out", str(out)]) == 0
    assert "1 of 30 Gaussians follow" in capsys.readouterr().out
    before, after = load_ply(files[0]), load_ply(out)
    row = make_soup(before, 8).rows[5]
    others = np.delete(np.arange(30), row)
    assert is_same([f[others] for f in after], [f[others] for f in before])
    assert after.means[row, 1] - before.means[row, 1] == pytest.approx(0.05 / 8, rel=1e-3)


def test_a_soup_has_colour_and_opacity_in_bytes(tmp_path):
    """0.2, 0.5 and 0.8 are 51, 127.5 and 204 of 255, and so is an opacity of 0.8."""
    colored = one(sh_dc=np.array([[-0.3, 0.0, 0.3]]) / SH_C0, opacity_logits=np.log([4.0]))
    save_soup(tmp_path / "soup.ply", colored, 5)
    columns = read_vertices(tmp_path / "soup.ply")
    for name, level in zip(("red", "green", "blue", "alpha"), (51, 128, 204, 204), strict=True):
        assert columns[name].tolist() == [level] * 5


def test_a_polygon_may_be_narrow_but_not_a_line():
    gaussians = one()
    soup = make_soup(gaussians, 8)
    narrow, n_edited = carry_gaussians(gaussians, soup, soup.corners * [1, 1e-4, 1], "soup.ply")
    assert n_edited == 1
    assert_allclose(np.exp(np.sort(narrow.log_scales[0]))[1:], [0.5e-4, 1], rtol=1e-6)
    with pytest.raises(InputError, match="polygon 0 has no area"):
        carry_gaussians(gaussians, soup, soup.corners * [1, 1e-10, 1], "soup.ply")


def test_a_run_and_other_numbers_of_sides(tmp_path, rng):
    (tmp_path / "run").mkdir()
    gaussians = as_dtype(model(rng), np.float32)
    save_ply(tmp_path / "run" / "point_cloud.ply", gaussians)
    soup, out = tmp_path / "soup.ply", tmp_path / "out.ply"
    assert main(["polygons", "export", str(tmp_path / "run"), "--out", str(soup), "--sides", "5"]) == 0
    assert load_corners(soup, 28).shape == (28, 5, 3)
    assert main(["polygons", "edit", str(tmp_path / "run"), str(soup), "--out", str(out)]) == 0
    assert is_same(load_ply(out), gaussians)


# --- what is refused ---


def broken(corners, faces, kind):
    """A soup with one fault: its vertices [V, 3] and faces."""
    faces = faces.tolist()
    if kind == "short":
        faces[4] = faces[4][:2]
    elif kind == "cut":
        faces[4] = faces[4][:7]
    elif kind == "beyond":
        faces[4][2] = 224
    elif kind == "fewer vertices":
        corners = corners[:-1]
    elif kind == "fewer polygons":
        corners, faces = corners[:-8], faces[:-1]
    elif kind == "point":
        corners[32:40] = corners[32]
    elif kind == "line":
        corners[32:40] = corners[32] + np.linspace(0, 1, 8)[:, None] * [1.0, 2, 3]
    elif kind == "no number":
        corners[33, 1] = np.nan
    return corners, faces


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("short", "polygon 4 has 2 corners, not 3 or more"),
        ("cut", "polygon 4 has 7 corners, and polygon 0 has 8"),
        ("beyond", "polygon 4 has a corner beyond the 224 vertices"),
        ("fewer vertices", "28 polygons of 8 corners and 223 vertices, but the model has 28 polygons, which are 224"),
        ("fewer polygons", "27 polygons of 8 corners and 216 vertices, but the model has 28"),
        ("point", "polygon 4 has no area (1 have none)"),
        ("line", "polygon 4 has no area (1 have none)"),
        ("no number", "property y is nan in row 33"),
        ("no faces", "not a polygon soup, it has no faces"),
    ],
)
def test_soups_that_do_not_fit_are_refused(kind, message, files, tmp_path, capsys):
    columns = read_vertices(files[1])
    vertices, faces = np.column_stack([columns[name] for name in "xyz"]), np.stack(read_faces(files[1]))
    vertices, lists = broken(vertices, faces, kind)
    rows = [" ".join(map(repr, map(float, v))) for v in vertices]
    lists = [] if kind == "no faces" else [" ".join(map(str, (len(face), *face))) for face in lists]
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property double {c}" for c in "xyz")]
    header += [f"element face {len(lists)}", "property list uchar int vertex_indices", "end_header"]
    (tmp_path / "bad.ply").write_text("\n".join([*header, *rows, *lists]) + "\n")
    out = tmp_path / "out.ply"
    assert main(["polygons", "edit", str(files[0]), str(tmp_path / "bad.ply"), "--out", str(out)]) == 2
    err = capsys.readouterr().err
    assert message in err and len(err.strip().splitlines()) == 1 and not out.exists()


def test_models_without_polygons_and_odd_sides_are_refused(tmp_path, rng):
    g = model(rng)
    for n_sides in (2, 256):
        with pytest.raises(InputError, match=f"3 to 255 sides, not {n_sides}"):
            save_soup(tmp_path / "soup.ply", g, n_sides)
    with pytest.raises(InputError, match="none of the 30 Gaussians is opaque enough"):
        save_soup(tmp_path / "soup.ply", g._replace(opacity_logits=np.full(30, -9.0)), 8)
    assert not (tmp_path / "soup.ply").exists()


def test_gaussians_of_no_finite_size_are_left_out(rng):
    g = model(rng)
    g.log_scales[0], g.log_scales[1] = 1000, -1000
    assert_array_equal(make_soup(g, 8).rows, [i for i in range(30) if i not in (0, 1, 3, 7)])


# --- bending ---


def test_a_bent_soup_is_drawn_as_it_is(rng):
    """A sheet that is only moved looks like its Gaussians; the more it is bent, the more these differ."""
    gaussians = claims.sheet(6)
    soup = make_soup(gaussians, 8)
    moved = claims.place_sheet(soup.corners)
    after, _ = carry_gaussians(gaussians, soup, moved, "it")
    drawn = claims.render_soup(gaussians, soup, moved)
    assert drawn.min() < 0.5
    assert_allclose(claims.render_float64(after), drawn, atol=EDITED_IMAGE)
