"""G-Style: colours, areas and grids by hand, gradients of losses and features, and a run that is painted."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from data_tools.claims import style as study
from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.style import recipe
from minisplat_ref.extensions.style.model import (
    FeatureWeights,
    areas,
    cut_stretch,
    feature_loss,
    largest,
    make_children,
    match_colors,
    mean_square,
    nearest_rows,
    nnfm,
    split,
    split_large,
    stages,
    total_variation,
    unit_rows,
)
from minisplat_ref.extensions.style.recipe import read_style, recolor
from minisplat_ref.io.ply import load_ply
from minisplat_ref.mechanisms.features.filters import CLASSICAL
from minisplat_ref.oracle.gradients import jacobian_case
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Gaussians
from scenes import as_dtype, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT64

# Colours


def test_colors_get_mean_and_covariance_of_the_style(rng):
    content, style = (
        rng.uniform(size=(500, 3)),
        rng.uniform(size=(400, 3)) @ np.array([[1, 0.2, 0], [0, 0.5, 0.3], [0, 0, 0.8]]),
    )
    mapped = match_colors(content, style)(content)
    assert_allclose(mapped.mean(axis=0), style.mean(axis=0), atol=PARITY_FLOAT64)
    assert_allclose(np.cov(mapped.T), np.cov(style.T) * (399 / 400) / (499 / 500), atol=1e-10)


def test_variances_along_the_axes_by_hand():
    """Variances 1, 4, 9 hundredths to 4, 4, 1: M = diag(2, 1, 1/3)."""
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], float)
    found = match_colors(signs * [0.1, 0.2, 0.3], 0.5 + signs * [0.2, 0.2, 0.1])
    assert_allclose(found.M, np.diag([2, 1, 1 / 3]), atol=PARITY_FLOAT64)
    assert_allclose(found.target, 0.5, rtol=CLOSED_FORM)


def test_grey_stays_on_a_line(rng):
    grey = np.repeat(rng.uniform(size=(100, 1)), 3, axis=1)
    mapped = match_colors(grey, rng.uniform(size=(100, 3)))(grey)
    values = np.linalg.eigvalsh(np.cov(mapped.T))
    assert values[2] > 1e-3 and abs(values[:2]).max() < 1e-12


def test_gaussians_are_recolored_like_their_images(rng):
    """Base colours are affine, harmonics linear: c = 1/2 + c_0 dc + sum c_k Y_k becomes M (c - source) + target."""
    g = as_dtype(make_gaussians(rng, 3), np.float64)
    color_map = match_colors(rng.uniform(size=(50, 3)), rng.uniform(size=(50, 3)))
    found, y = recolor(g, color_map), rng.normal(size=g.sh_rest.shape[1])

    def color(g):
        return 0.5 + SH_C0 * g.sh_dc + np.einsum("k,nkc->nc", y, g.sh_rest)

    assert_allclose(color(found), color_map(color(g)), rtol=PARITY_FLOAT64)


# Losses


def test_nearest_features_by_hand():
    """(3, 0) and (0, 2) against (1, 0) and (0.6, 0.8): cosines 1 and 0.8, so the loss is (0 + 0.2) / 2."""
    style, map_ = np.array([[1.0, 0.0], [0.6, 0.8]]), np.array([[[3.0, 0.0], [0.0, 2.0]]])
    ids = nearest_rows(unit_rows(map_.reshape(-1, 2))[0], style)
    assert_array_equal(ids, [0, 1])
    assert nnfm(map_, style, ids)[0] == pytest.approx(0.1, abs=1e-9)


def test_total_variation_by_hand():
    """A step of 1 between two of three columns: 6 differences along x of which 2 are 1, times three channels."""
    image = np.zeros((2, 3, 3))
    image[:, 2] = 1
    value, v = total_variation(image)
    assert value == pytest.approx(0.5)
    assert_allclose(v[:, 1], -2 / 12, rtol=CLOSED_FORM)
    assert_allclose(v[:, 2], 2 / 12, rtol=CLOSED_FORM)
    assert not v[:, 0].any()


def test_gradients_of_the_losses(rng):
    maps, content = ([rng.normal(size=(3, 4, 5))] for _ in range(2))
    styles = [unit_rows(rng.normal(size=(6, 5)))[0]]
    weights = FeatureWeights(2.0, 3.0)
    check_jacobian(
        lambda m: (np.array([feature_loss([m], content, styles, weights)[0]]),),
        lambda v: (v[0] * feature_loss(maps, content, styles, weights)[1][0],),
        (maps[0],),
        names=("map",),
    )
    value, _ = feature_loss(maps, content, styles, weights)
    ids = nearest_rows(unit_rows(maps[0].reshape(-1, 5))[0], styles[0])
    assert value == pytest.approx(2 * nnfm(maps[0], styles[0], ids)[0] + 3 * mean_square(maps[0], content[0])[0])


def test_gradients_as_the_oracle_checks_them():
    """A network of three convolutions and both losses; the classical bank has a test of its own."""
    for stage in stages(None, None, np.random.default_rng(4))[1:]:
        case = jacobian_case(stage)
        assert case.passed, case


# Splitting


def one(scales=(0.4, 0.1, 0.2), rng=None):
    g = as_dtype(make_gaussians(rng or np.random.default_rng(0), 1), np.float64)
    return g._replace(log_scales=np.log([scales]))


def test_areas_are_products_of_the_larger_two():
    assert_allclose(areas(one()), [0.08], rtol=CLOSED_FORM)


@pytest.mark.parametrize("n", [4, 8])
def test_children_keep_mean_and_covariance_in_the_plane(n):
    """Of the parent's axes x (longest), z and y: variances along x and z stay, y is not touched."""
    g = one()
    children = make_children(g, np.array([0]), n)
    R = rotation_matrices(g.quats)[0]
    places = (children.means - g.means) @ R  # in the parent's axes
    total = np.cov(places.T, bias=True) + np.diag(np.exp(2 * children.log_scales[0]))
    assert len(places) == n and len(np.unique(places.round(9), axis=0)) == n
    assert_allclose(total, np.diag([0.16, 0.01, 0.04]), atol=PARITY_FLOAT64)
    shrunk = 0.4 / (1.6 if n == 4 else 1.6**2)
    assert_allclose(np.exp(children.log_scales[0]), [shrunk, 0.1, 0.2 / 1.6], rtol=CLOSED_FORM)


def test_splitting_replaces_the_chosen(rng):
    g = make_gaussians(rng, 3)
    edit = split(g, np.array([False, True, False]), 4)
    assert_array_equal(edit.parent_ids, [0, 2, 1, 1, 1, 1])
    assert_array_equal(edit.is_new, [False] * 2 + [True] * 4)
    assert_array_equal(edit.gaussians.means[:2], g.means[[0, 2]])


def test_only_the_largest_above_the_threshold_are_split():
    """Areas 1, 97 times, 1.5, 4 and 9: mean 1.12, deviation 0.85: 4 and 9 are above 1.97; a share of 1 % leaves one."""
    g = make_gaussians(np.random.default_rng(0), 100)
    scales = np.ones((100, 3))
    scales[3], scales[7], scales[5] = 2, 3, 1.5**0.5
    g = g._replace(log_scales=np.log(scales))
    for share, n_new in ((0.05, 8), (0.01, 4)):
        edit = split_large(g, factor=1.0, max_share=share, n_children=4)
        assert edit.is_new.sum() == n_new
        assert set(edit.parent_ids[edit.is_new]) == ({3, 7} if n_new == 8 else {7})
    assert not split_large(g, factor=10.0, max_share=0.05, n_children=4).is_new.any()
    assert_array_equal(largest(np.array([1.0, 3, 2, 0]), 0.0, 0.5), [False, True, True, False])
    assert_array_equal(largest(np.array([2.0, 3, 2, 2]), 2.0, 1.0), [False, True, False, False])  # not at the threshold


def test_stretch_is_cut_at_the_second_axis():
    found = np.exp(cut_stretch(np.log([[0.8, 0.1, 0.2], [0.25, 0.2, 0.1]]), 1.5))
    assert_allclose(found, [[0.3, 0.1, 0.2], [0.25, 0.2, 0.1]], rtol=CLOSED_FORM)


def test_colours_split_where_the_length_of_their_gradient_is_largest(monkeypatch):
    """Second moments of three channels: sums of 3, 2.9 and 4, the largest ones of a channel 1, 2.9 and 4."""
    g = make_gaussians(np.random.default_rng(0), 3)
    moments = np.array([[1.0, 1, 1], [2.9, 0, 0], [4.0, 0, 0]])
    state = SimpleNamespace(gaussians=g, adam=SimpleNamespace(second=SimpleNamespace(sh_dc=moments)))
    edits = []
    monkeypatch.setattr(recipe, "apply_edit", lambda state, edit: edits.append(edit))
    assert recipe.split_by_color_gradient(state, None, max_share=0.7, n_children=4) is None
    assert set(edits[0].parent_ids[edits[0].is_new]) == {0, 2}
    moments[:] = 0
    assert "no colour" in recipe.split_by_color_gradient(state, None, max_share=0.7, n_children=4)


def test_rows_of_a_style_are_spread_evenly():
    rows = np.arange(5_000)
    found = recipe.thin_evenly(rows)
    assert len(found) == 2_000 and found[0] == 0 and found[-1] == 4_997 and set(np.diff(found)) == {2, 3}
    assert_array_equal(recipe.thin_evenly(rows[:10]), rows[:10])


def test_the_content_is_that_of_the_photograph():
    """A rendering that is the photograph has no error of its content, and none where the style weighs nothing."""
    image = np.random.default_rng(0).integers(0, 256, (48, 48, 3)).astype(np.uint8)
    style = recipe.read_features(CLASSICAL, image / 255)
    rendered = SimpleNamespace(channel=lambda name: image / 255, view=SimpleNamespace(image=image))
    for weight, is_some in ((0.0, False), (1.0, True)):
        weights = FeatureWeights(weight, 5.0)
        value, _ = recipe.style_features(
            rendered, style=style._replace(maps=tuple(-m for m in style.maps)), weights=weights
        )
        assert (value > 1e-12) == is_some


def test_published_rounds_and_shares():
    """Four rounds, a fifth of the stage apart, with thresholds that grow by 1.125; colours split four times, too."""
    rounds = recipe.RESTRUCTURE.events
    assert [event.step for event in rounds] == [200, 400, 600, 800]
    assert [round(event.action.keywords["factor"], 4) for event in rounds] == [1, 1.125, 1.2656, 1.4238]
    assert rounds[0].action.keywords["max_ratio"] == 1.5 and rounds[0].action.keywords["max_share"] == 0.1
    image = np.random.default_rng(0).uniform(size=(48, 48, 3)).astype(np.float32)
    painted = recipe.painting(recipe.read_features(CLASSICAL, image), FeatureWeights(10.0, 0.05))
    (every,) = painted.events
    assert [step for step in range(1, 1001) if every.is_due(step)] == [200, 400, 600, 800]
    assert every.action.keywords == {"max_share": 0.05, "n_children": 4}
    trained = {name for name, rate in painted.learning_rates.of.items() if rate}
    assert trained == {"sh_dc"} and painted.losses[1].weight == 1e-4


# A run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("style")
    room = make_scene("room", n_views=4, width=56, height=48, supersampling=1, n_points=150, test_every=4)
    write_scene(room, folder / "room", {})
    words = ["train", folder / "room", "--recipe", "3dgs-accel", "--iterations", 5, "--test-every", 4]
    assert main([str(word) for word in [*words, "--out", folder / "run"]]) == 0
    Image.fromarray((255 * study.swatches()["stripes"]).astype(np.uint8)).save(folder / "stripes.png")
    return folder


def transfer(folder, image, *options):
    return main(["style", "transfer", str(folder / "run"), str(image), "--out", str(folder / "painted"), *options])


def test_a_run_is_painted(folder, capsys):
    assert transfer(folder, folder / "stripes.png", "--iterations", "10") == 0
    painted, plain = (load_ply(folder / name / "point_cloud.ply", Gaussians) for name in ("painted", "run"))
    assert len(painted.means) > len(plain.means) and not painted.sh_rest.any()
    assert f"{len(plain.means):,} Gaussians became {len(painted.means):,}" in capsys.readouterr().out
    about = json.loads((folder / "painted" / "config.json").read_text())["styled"]
    assert about["nnfm"] == 10 and about["iterations"] == 10
    metrics = json.loads((folder / "painted" / "metrics.json").read_text())
    assert metrics["n_gaussians"] == len(painted.means) and metrics["n_gaussians_before"] == len(plain.means)
    for command in ("render", "info", "eval"):
        out = ["--out", str(folder / "shown")] if command == "render" else []
        assert main([command, str(folder / "painted"), *out]) == 0
    assert main(["convert", str(folder / "painted"), str(folder / "painted.spz")]) == 0


@pytest.mark.parametrize(
    ("name", "pixels", "message"),
    [
        ("flat.png", np.full((96, 96, 3), 90, np.uint8), "has one colour, and so no pattern to paint with"),
        ("small.png", np.arange(300, dtype=np.uint8).reshape(10, 10, 3), "is 10 x 10 pixels, and the features"),
        ("text.png", None, "not an image that Pillow can read"),
    ],
)
def test_bad_images(folder, tmp_path, capsys, name, pixels, message):
    if pixels is None:
        (tmp_path / name).write_text("no image")
    else:
        Image.fromarray(pixels).save(tmp_path / name)
    assert main(["style", "transfer", str(folder / "run"), str(tmp_path / name), "--out", str(tmp_path / "no")]) == 2
    error = capsys.readouterr().err
    assert message in error and name in error and error.count("\n") == 1 and not (tmp_path / "no").exists()


def test_a_run_with_more_than_gaussians_is_refused(folder, tmp_path, capsys):
    np.savez(folder / "run" / "shared.npz", sky=np.zeros(3))
    try:
        words = ["style", "transfer", str(folder / "run"), str(folder / "stripes.png"), "--out", str(tmp_path / "no")]
        assert main(words) == 2
    finally:
        (folder / "run" / "shared.npz").unlink()
    assert "has parameters besides its Gaussians" in capsys.readouterr().err and not (tmp_path / "no").exists()


def test_a_thin_style_keeps_a_pixel(tmp_path):
    """100 x 1 pixels and 1 x 100, made ten times smaller; 60 x 30 keep their shape."""
    for size, small in (((100, 1), (1, 10)), ((1, 100), (10, 1)), ((60, 30), (5, 10))):
        Image.new("RGB", size, (10, 200, 30)).save(tmp_path / "thin.png")
        found = read_style(tmp_path / "thin.png", 10)
        assert found.shape == (*small, 3) and (found == [10, 200, 30]).all()
    assert read_style(tmp_path / "thin.png", 60).shape == (30, 60, 3)


def test_a_run_without_gaussians_is_refused(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "minisplat_ref.extensions.style.transfer.load_ply",
        lambda path: Gaussians(*(field[:0] for field in load_ply(path))),
    )
    words = ["style", "transfer", str(folder / "run"), str(folder / "stripes.png"), "--out", str(tmp_path / "no")]
    assert main(words) == 2
    assert "holds no Gaussians" in capsys.readouterr().err and not (tmp_path / "no").exists()
