"""Cross-validation: which photographs are held out, which points remain, and the tables by hand."""

import json

import numpy as np
import pytest

from data_tools.claims import folds
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit.claim import FIGURE, RESULT
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import load_extension
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import ViewMetrics
from minisplat_ref.training.recipe_settings import settings_of

SIZE = {"n_views": 8, "width": 48, "height": 36, "n_points": 300}


@pytest.fixture(scope="module")
def scene():
    """Ten photographs with tracks, of which eight are training views."""
    made = make_scene("room", supersampling=1, **SIZE).scene
    found = np.sort(np.random.default_rng(0).choice(300, 60, replace=False))
    tests = tuple(view._replace(point_ids=found) for view in made.test_views)
    return made._replace(test_views=tests)


def test_each_photograph_is_held_out_once(scene):
    views = folds.all_photographs(scene, thin=False)
    names = [view.name for view in views]
    assert len(names) == 10 and names == sorted(names)
    made = [folds.make_fold(scene, views, 3, k).scene for k in range(3)]
    assert [view.name for view in made[1].test_views] == names[1::3]
    assert sorted(view.name for fold in made for view in fold.test_views) == names
    for fold in made:
        assert not {v.name for v in fold.train_views} & {v.name for v in fold.test_views}
        assert [view.view_id for view in fold.train_views] == list(range(len(fold.train_views)))
        assert {view.view_id for view in fold.test_views} == {-1}
        centers = np.array([view.camera.center for view in fold.train_views])
        radius = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
        assert fold.extent == pytest.approx(1.1 * radius)


def test_a_held_out_photograph_has_found_no_points(scene):
    """Only points that two of the others have found remain, and their rows in the tracks move up."""
    views = folds.all_photographs(scene, thin=False)
    fold = folds.make_fold(scene, views, 3, 0).scene
    counts = np.zeros(len(scene.points), int)
    for i, view in enumerate(views):
        if i % 3:
            counts[view.point_ids] += 1
    expected = counts >= 2
    assert 0 < expected.sum() < len(expected)
    np.testing.assert_array_equal(fold.points, scene.points[expected])
    np.testing.assert_array_equal(fold.point_colors, scene.point_colors[expected])
    old = {view.name: view for view in views}
    for view in (*fold.train_views, *fold.test_views):
        before = scene.points[old[view.name].point_ids]
        np.testing.assert_array_equal(fold.points[view.point_ids], before[expected[old[view.name].point_ids]])
    bare = [view._replace(point_ids=None) for view in views]
    assert len(folds.make_fold(scene, bare, 3, 0).scene.points) == len(scene.points)


def test_thinned_scenes_and_too_few_photographs(scene):
    views = folds.all_photographs(scene, thin=True)
    assert [view.name for view in views] == [view.name for view in folds.all_photographs(scene, thin=False)][::2]
    with pytest.raises(InputError, match="5 photographs in 2 folds leave 2 to train on and 3 to measure"):
        folds.make_fold(scene, views, 2, 0)


def test_recipes_with_settings():
    assert folds.recipe_of("3dgs-accel").iterations == 3000
    assert folds.recipe_of("adaptive").iterations == get_recipe("adaptive").iterations
    changed = folds.recipe_of("adaptive+min_slope=0.5+max_growth=0.3")
    assert (settings_of(changed)["min_slope"], settings_of(changed)["max_growth"]) == (0.5, 0.3)
    with pytest.raises(InputError, match="no slope to set"):
        folds.recipe_of("adaptive+slope=1")


def test_recipes_of_extensions_and_terms_for_any_recipe():
    ours = folds.recipe_of("mcmc+budget=700")
    assert (ours.name, ours.iterations, settings_of(ours)["budget"]) == ("mcmc", 3000, 700)
    assert ours.representation == load_extension("mcmc").representation
    for name in ("adaptive", "mini-splatting2", "mcmc"):
        with_depth = folds.recipe_of(f"{name}+sfm_depth=0.1")
        assert {term.name: term.weight for term in with_depth.losses}["sfm_depth"] == 0.1
        assert with_depth.iterations == folds.recipe_of(name).iterations
    assert "sfm_depth" not in settings_of(folds.recipe_of("adaptive+min_slope=0.5"))
    with pytest.raises(InputError, match="recipe adaptive has no sfm_dept to set"):
        folds.recipe_of("adaptive+sfm_dept=0.1")


def test_known_pixels_by_hand():
    """The left half is known and wrong by an offset alone; the right half is not."""
    rng = np.random.default_rng(0)
    image = rng.uniform(0.2, 0.7, (8, 10, 3)).astype(np.float32)
    photograph = np.round(255 * (image + 0.1)).astype(np.uint8)
    photograph[:, 5:] = 255 - photograph[:, 5:]
    view = make_scene("room", supersampling=1, **SIZE).scene.train_views[0]._replace(image=photograph, mask=None)
    coverage = np.full((8, 10), 1)
    coverage[:, :5] = 2
    metrics = ViewMetrics("a", 10.0, 0.5, None, 12.0)
    record = folds.describe_photograph(view, image, metrics, coverage)
    assert (record["psnr"], record["corrected"], record["ssim"], record["share_known"]) == (10.0, 12.0, 0.5, 0.5)
    assert record["known"] > 50
    assert folds.describe_photograph(view, image, metrics, None)["known"] is None
    assert folds.describe_photograph(view, image, metrics, 0 * coverage)["share_known"] == 0
    masked = view._replace(mask=coverage == 1)
    assert folds.describe_photograph(masked, image, metrics, coverage)["share_known"] == 0


def record(scene, fold, recipe, values, curve=None):
    photographs = [
        {
            "name": str(i),
            "psnr": v - 1,
            "exposed": v - 0.5,
            "corrected": v,
            "ssim": v / 100,
            "known": v + 1,
            "share_known": 0.5,
        }
        for i, v in enumerate(values)
    ]
    curve = curve or [[250, 5.0, 30.0, 10], [500, 9.0, float(np.mean(values)), 20]]
    return {
        **{"scene": scene, "fold": fold, "recipe": recipe, "seed": 0, "photographs": photographs, "curve": curve},
        **{"n_gaussians": 20, "hidden_test": 0.1, "hidden_train": None},
    }


RECORDS = [
    *(record("x", 0, "a", [20, 22]), record("x", 0, "b", [19, 20]), record("x", 0, "c", [25, 16])),
    *(record("x", 1, "a", [21, 24]), record("x", 1, "b", [24, 24]), record("x", 1, "c", [20, 20])),
    *(record("y", 0, "a", [10, 12]), record("y", 0, "b", [10, 10]), record("y", 0, "c", [15, 15])),
]


def test_rows_by_hand():
    row = folds.summarise(RECORDS, "x", "a")
    assert (row["n"], row["corrected"], row["corrected_worst"], row["psnr"], row["exposed"]) == (
        4,
        21.5,
        20,
        20.5,
        21.0,
    )
    assert row["mean"] == 21.75 and row["standard_error"] == pytest.approx(np.std([20, 22, 21, 24], ddof=1) / 2)
    assert row["fall"] == pytest.approx((9.0 + 7.5) / 2)  # 30 - 21 and 30 - 22.5
    assert row["hidden_test"] == pytest.approx(0.1) and row["hidden_train"] is None and row["seconds"] == 9.0
    assert row["known"] == 22.5 and row["ssim"] == pytest.approx(0.215)


def test_differences_by_hand():
    """a - b: 1.5, -1.5, 1. The best other recipe of x is b (21.75 and 20.25), of y it is c: 1.5, -1.5, -4."""
    lines = folds.describe_differences(RECORDS, ["a", "b", "c"]).splitlines()
    assert lines[0] == "a minus b: median +1.00 dB, worst -1.50 (x, fold 1), over 3 folds"
    assert lines[2].startswith("a minus the best other recipe of the scene: median -1.50 dB, worst -4.00 (y, fold 0)")
    assert lines[3] == "a minus b: median +0.010 of SSIM, worst -0.015 (x, fold 1), over 3 folds"


def test_a_choice_is_reported_where_it_was_not_made():
    """On y the best recipe is c; on x it is b, 0.0 above a there. So on x: c, 1.5 below; on y: b, 1 below."""
    text = folds.leave_one_scene_out(RECORDS, ["a", "b", "c"])
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:]]
    assert rows == [["x", "c", "-1.50"], ["y", "a", "+0.00"]] or rows == [["x", "c", "-1.50"], ["y", "b", "-1.00"]]
    assert "one scene alone" in folds.leave_one_scene_out(RECORDS[:6], ["a", "b"])


def test_from_the_command_line(scene, tmp_path, monkeypatch, capsys):
    source = tmp_path / "room"
    write_scene(make_scene("room", supersampling=1, **SIZE), source, SIZE)
    monkeypatch.setattr(folds, "recipe_of", lambda name: get_recipe(name, 12))
    monkeypatch.setattr(folds, "ITERATIONS", 72)
    command = ["folds", str(source), "--folds", "3", "--seeds", "0", "--recipes", "3dgs-accel,3dgs"]
    command += ["--long-side", "24", "--out", str(tmp_path / "folds")]
    assert measure_claim(command) == 0
    printed = capsys.readouterr().out
    result = json.loads((tmp_path / "folds" / RESULT).read_text())
    assert (tmp_path / "folds" / FIGURE).stat().st_size > 5000
    assert [(row["recipe"], row["n"]) for row in result["summary"]] == [("3dgs-accel", 10), ("3dgs", 10)]
    assert len(result["runs"]) == 6 and all(run["curve"][-1][0] == 12 for run in result["runs"])
    assert len(result["runs"][0]["curve"]) == 2  # at 6 and 12
    shares = [p["share_known"] for run in result["runs"] for p in run["photographs"]]
    assert len(shares) == 20 and shares.count(None) == 4  # two photographs have no tracks in the file
    assert all(0.2 < share <= 1 for share in shares if share is not None)
    assert "3dgs-accel minus 3dgs: median" in printed and "one scene alone" in printed
    monkeypatch.setattr(folds, "measure", None)  # the same command measures nothing again
    assert measure_claim(command) == 0 and capsys.readouterr().out == printed
    thinned = ["--folds", "2", "--recipes", "3dgs", "--photographs", "thinned", "--out", "z"]
    assert measure_claim([*command[:2], *thinned]) == 2
