"""Segmentation: votes by hand and as weights of pixels, the optimum of a linear programme, masks, and the commands."""

import json
from collections import namedtuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.optimize import linprog

from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import load_extension
from minisplat_ref.extensions.segment.commands import paint
from minisplat_ref.extensions.segment.votes import Votes, assign_labels, belongs, colored, count_votes, label_map
from minisplat_ref.io import read_image
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import load_ply, read_label, save_ply
from minisplat_ref.io.viewpoints import Viewpoint, to_json
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.types import Gaussians, Model, view_from
from scenes import balls, make_camera, make_gaussians
from tolerances import PARITY_FLOAT64


def weights_of(gaussians, camera, renderer=SPLATTING):
    """w [H W, N] by rendering each Gaussian white and all others black: no gradient is involved."""
    columns = []
    for row in range(len(gaussians.means)):
        colors = np.zeros((len(gaussians.means), 3))
        colors[row] = 1
        image = renderer.render(Model(colored(gaussians, colors)), view_from(camera), Request())[0].image
        columns.append(image[..., 0].ravel())
    return np.stack(columns, axis=1)


@pytest.fixture
def masked(rng):
    """Ten Gaussians, a camera, and a mask of the labels 0, 2, 5, 6 and 9 in stripes."""
    gaussians, camera = make_gaussians(rng, 10, size=0.3), make_camera()
    mask = np.array([0, 2, 5, 6, 9])[np.arange(camera.width) * 5 // camera.width]
    return gaussians, camera, np.tile(mask, (camera.height, 1))


# Votes


def test_votes_are_the_weights_of_the_pixels_of_each_label(masked):
    """More than three labels take several passes; one that no pixel has gets no vote."""
    gaussians, camera, mask = masked
    votes = count_votes(gaussians, SPLATTING, [(camera, mask)], [2, 5, 6, 7, 9])
    w = weights_of(gaussians, camera)
    assert votes.ids == (0, 2, 5, 6, 7, 9) and w.sum() > 100
    for row, label in enumerate(votes.ids):
        assert_allclose(votes.weights[row], w[(mask == label).ravel()].sum(axis=0), atol=PARITY_FLOAT64 * w.sum())
    assert not votes.weights[4].any()


def test_views_add_up_and_shares_sum_to_one(masked):
    gaussians, camera, mask = masked
    once, twice = (count_votes(gaussians, SPLATTING, [(camera, mask)] * n, [2, 5]) for n in (1, 2))
    assert_allclose(twice.weights, 2 * once.weights, rtol=PARITY_FLOAT64)
    assert_allclose(twice.shares.sum(axis=0), 1.0, rtol=PARITY_FLOAT64)


def test_colors_do_not_vote(masked):
    gaussians, camera, mask = masked
    black = gaussians._replace(sh_dc=gaussians.sh_dc - 9, sh_rest=gaussians.sh_rest + 2)
    found = [count_votes(g, SPLATTING, [(camera, mask)], [2]).weights for g in (gaussians, black)]
    assert_array_equal(*found)


def test_a_gaussian_that_is_hidden_or_outside_has_no_vote():
    """An opaque wall of layers, one ball behind it and one behind the camera."""
    centers = [[0, 0, z] for z in (2.0, 2.01, 2.02, 2.03, 2.04)] + [[0, 0, 5.0], [0, 0, -3.0]]
    gaussians = balls(np.array(centers), np.array([3.0] * 5 + [0.05, 0.3]), np.full(7, 0.99))
    camera = make_camera()
    votes = count_votes(gaussians, SPLATTING, [(camera, np.ones((camera.height, camera.width), int))], [1])
    assert_array_equal(votes.is_seen, [*[True] * votes.is_seen[:5].sum(), *[False] * (7 - votes.is_seen[:5].sum())])
    assert_array_equal(assign_labels(votes, 0.0)[-2:], [-1, -1])


def test_weights_that_are_no_opacity_are_refused(masked):
    gaussians, camera, mask = masked

    def twice(tape, v_image, v_alpha):
        v = SPLATTING.render_vjp(tape, v_image, v_alpha)
        return v._replace(gaussians=v.gaussians._replace(sh_dc=2 * v.gaussians.sh_dc))

    with pytest.raises(InputError, match="renderer double does not blend"):
        count_votes(gaussians, SPLATTING._replace(name="double", render_vjp=twice), [(camera, mask)], [2])


@pytest.mark.parametrize("name", ["surfels", "antialiasing"])
def test_other_renderers_vote(name, masked, rng):
    gaussians, camera, mask = masked
    representation = load_extension(name).representation
    population = representation.extend(gaussians, rng)
    votes = count_votes(population, representation.renderer, [(camera, mask)], [2, 5])
    w = weights_of(population, camera, representation.renderer)
    assert_allclose(votes.weights[1], w[(mask == 2).ravel()].sum(axis=0), atol=PARITY_FLOAT64 * w.sum())


# Labels


def test_labels_are_the_optimum_of_the_linear_programme(masked):
    """min sum_p t_p with t_p >= |sum_i w_i(p) P_i - M(p)| and 0 <= P <= 1, by simplex, for each label alone."""
    gaussians, camera, mask = masked
    w, n = weights_of(gaussians, camera), len(gaussians.means)
    for label in (2, 5):
        m = (mask == label).ravel().astype(float)
        eye = np.eye(len(m))
        solved = linprog(
            np.concatenate([np.zeros(n), np.ones(len(m))]),
            A_ub=np.block([[w, -eye], [-w, -eye]]),
            b_ub=np.concatenate([m, -m]),
            bounds=[(0, 1)] * n + [(0, None)] * len(m),
        )
        votes = count_votes(gaussians, SPLATTING, [(camera, (mask == label).astype(int))], [1])
        found = belongs(votes, 1, 0.0)
        assert np.abs(w @ found - m).sum() == pytest.approx(solved.fun, rel=1e-9)
        assert_array_equal(found, assign_labels(votes, 0.0) == 1)
    assert found.any() and not found.all()


HAND = Votes((0, 3, 8), np.array([[6.0, 2.0, 0.0, 1.0, 2.0], [4.0, 1.0, 0.0, 6.0, 2.0], [0.0, 7.0, 0.0, 3.0, 0.0]]))


@pytest.mark.parametrize(
    ("bias", "expected"),
    [
        (0.0, [0, 8, -1, 3, 0]),  # the last is equal: the background's
        (-0.25, [3, 8, -1, 3, 3]),  # 0.6 - 0.25 < 0.4
        (0.6, [0, 0, -1, 0, 0]),  # 0.2 + 0.6 > 0.7; 0.1 + 0.6 > 0.6
        (0.45, [0, 8, -1, 3, 0]),  # 0.2 + 0.45 < 0.7; 0.1 + 0.45 < 0.6
    ],
)
def test_the_bias_is_the_background_s(bias, expected):
    assert_array_equal(assign_labels(HAND, bias), expected)


def test_one_object_against_the_rest():
    """Shares of label 3 are 0.4, 0.1, none, 0.6 and 0.5; of label 8 that of the second is 0.7."""
    assert_array_equal(belongs(HAND, 3, 0.0), [False, False, False, True, False])
    assert_array_equal(belongs(HAND, 3, -0.25), [True, False, False, True, True])  # 0.4 > 0.6 - 0.25
    assert_array_equal(belongs(HAND, 3, 0.25), [False] * 5)  # 0.6 < 0.4 + 0.25
    assert_array_equal(belongs(HAND, 8, -1.0), [False, True, False, True, False])


# Maps


def test_a_map_shows_the_label_of_the_largest_weight(masked):
    gaussians, camera, _ = masked
    of_gaussians = np.array([0, 2, 5, 6, 9, 0, 2, 5, -1, 9])
    w = weights_of(gaussians, camera)
    sums = np.stack([w[:, of_gaussians == label].sum(axis=1) for label in (2, 5, 6, 9)])
    sums = np.concatenate([1 - sums.sum(axis=0, keepdims=True), sums])
    expected = np.array([0, 2, 5, 6, 9])[np.argmax(sums, axis=0)].reshape(camera.height, camera.width)
    found = label_map(gaussians, of_gaussians, SPLATTING, camera)
    assert_array_equal(found, expected)
    assert len(np.unique(found)) > 2


def test_without_objects_all_is_background(masked):
    gaussians, camera, _ = masked
    assert not label_map(gaussians, np.zeros(10, int), SPLATTING, camera).any()


def test_colors_of_labels():
    painted = paint(np.array([[0, 1, 9, 2]]))
    assert_array_equal(painted[0, 0], [0, 0, 0])
    assert_array_equal(painted[0, 1], painted[0, 2])  # after eight they repeat
    assert (painted[0, 1] != painted[0, 3]).any() and painted[0, 1].any()


# Commands


@pytest.fixture
def folder(tmp_path, masked, monkeypatch):
    """A model, two cameras of which one has a mask, and the mask at twice the size."""
    gaussians, camera, mask = masked
    (tmp_path / "run").mkdir()
    save_ply(tmp_path / "run" / "point_cloud.ply", gaussians)
    views = [Viewpoint("a", camera, "train"), Viewpoint("b", camera, "test")]
    (tmp_path / "run" / "cameras.json").write_text(json.dumps(to_json(views)))
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask.astype(np.uint8).repeat(2, axis=0).repeat(2, axis=1)).save(tmp_path / "masks" / "a.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def label_command(*words):
    return main(["segment", "label", "run", "--masks", "masks", *words])


def test_labels_are_a_column_that_others_skip(folder, masked, capsys):
    gaussians, camera, mask = masked
    assert label_command("--out", "labelled.ply") == 0
    expected = assign_labels(
        count_votes(load_ply("run/point_cloud.ply"), SPLATTING, [(camera, mask)], [2, 5, 6, 9]), 0.0
    )
    column = load_ply("labelled.ply", load_labelled()).label
    assert_array_equal(column, expected)
    assert len(np.unique(column)) > 2
    plain = load_ply("labelled.ply")
    assert_array_equal(plain.means, gaussians.means.astype(np.float32))
    assert "10 Gaussians with labels in labelled.ply, from 1 masks" in capsys.readouterr().out
    assert main(["segment", "render", "labelled.ply", "--cameras", "run/cameras.json", "--out", "maps"]) == 0
    ids = np.array(Image.open("maps/ids/b.png"))
    assert_array_equal(ids, label_map(plain, expected, SPLATTING, camera))
    assert_array_equal(read_image("maps/colors/a.png"), paint(ids))


def load_labelled():
    return namedtuple("Labelled", (*Gaussians._fields, "label"))


def test_an_object_is_taken_out_and_away(folder, masked, capsys):
    _, camera, mask = masked
    whole = load_ply("run/point_cloud.ply")
    is_object = belongs(count_votes(whole, SPLATTING, [(camera, mask)], [2, 5, 6, 9]), 5, -0.5)
    assert 0 < is_object.sum() < 10
    for option, kept in (("--extract", is_object), ("--remove", ~is_object)):
        assert label_command(option, "5", "--bias=-0.5", "--out", "part.ply") == 0
        assert_array_equal(load_ply("part.ply").means, whole.means[kept])
        assert f"{kept.sum()} of 10 Gaussians in part.ply" in capsys.readouterr().out


def test_a_part_is_drawn_by_the_model_s_extension(folder, masked):
    save_ply("run/point_cloud.ply", masked[0], Label("surfels"))
    assert label_command("--extract", "5", "--bias=-1", "--out", "part.ply") == 0
    assert read_label("part.ply").extension == "surfels"


def test_masks_of_palettes_are_their_indices(folder, masked):
    mask = masked[2].astype(np.uint8)
    image = Image.fromarray(mask, mode="P")
    image.putpalette([7, 7, 7] * 256)
    image.save("masks/a.png")
    assert label_command("--out", "labelled.ply") == 0
    assert set(np.unique(load_ply("labelled.ply", load_labelled()).label)) <= {-1, 0, 2, 5, 6, 9}


def save_as(name, array):
    return lambda: Image.fromarray(array).save(f"masks/{name}.png")


BAD = {
    "size": (
        save_as("a", np.ones((18, 25), np.uint8)),
        [],
        "25 x 18 pixels, and its photograph was trained on with 24 x 18",
    ),
    "smaller": (save_as("a", np.ones((9, 12), np.uint8)), [], "a.png: 12 x 9 pixels"),
    "name": (save_as("c", np.ones((18, 24), np.uint8)), [], "c.png: no photograph of that name; the run has a, b"),
    "colours": (save_as("a", np.ones((18, 24, 3), np.uint8)), [], "a.png: RGB pixels are no ids"),
    "object": (None, ["--extract", "4"], "--extract 4: the masks have 2, 5, 6, 9"),
    "background": (None, ["--remove", "0"], "--remove 0: the masks have 2, 5, 6, 9"),
    "bias": (None, ["--bias", "1.5"], "--bias is 1.5: give a number from -1 to 1"),
    "suffix": (None, ["--out", "labelled.spz"], "labelled.spz is not named like a PLY"),
    "cameras": (None, ["--cameras", "no.json"], "no.json: cannot be read (No such file"),
    "folder": (None, ["--masks", "no"], "no is no folder"),
    "empty": (None, ["--masks", "run"], "run holds no PNG"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case, folder, capsys):
    spoil, options, message = BAD[case]
    if spoil:
        spoil()
    assert label_command("--out", "out.ply", *options) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (folder / "out.ply").exists() and not (folder / "labelled.spz").exists()


def test_a_model_without_labels_is_not_drawn(folder, capsys):
    assert main(["segment", "render", "run", "--out", "maps"]) == 2
    assert "run/point_cloud.ply has no labels: write them with" in capsys.readouterr().err
    assert not (folder / "maps").exists()


def test_networks_that_no_ply_holds_are_refused(folder, masked, capsys):
    save_ply("run/point_cloud.ply", masked[0], Label("vdgs"))
    assert label_command("--out", "out.ply") == 2
    assert "is drawn by vdgs, with parameters that no PLY holds" in capsys.readouterr().err
