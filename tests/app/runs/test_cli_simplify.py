"""``simplify``: the rule that chooses by hand, what it leaves, that it keeps to its limits, and what it refuses."""

import json
import math
import shutil

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from browser import check_page
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs import opened_run, simplification
from minisplat_ref.app.runs.opened_run import N_FOLDS, open_run
from minisplat_ref.app.runs.progress import PSNR_MAX
from minisplat_ref.app.runs.rate_distortion import (
    CLOSE,
    PlySize,
    Point,
    count_sizes,
    next_size,
    paired_drop,
    smallest_within,
)
from minisplat_ref.app.runs.simplification import DEFAULT_DROP, Target, decide, fine_tuning, make_measure
from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.io import load_ply, load_scene, save_ply
from minisplat_ref.io.images import read_image
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.importance import collect_importance
from minisplat_ref.strategy.ops import take
from minisplat_ref.strategy.simplify import merge_neighbours
from minisplat_ref.training.loop import train
from run_commands import write_room
from tolerances import CLOSED_FORM

SCENE = {"n_views": 12, "width": 32, "height": 24, "n_points": 150, "test_every": 6}
FILES = {
    *("point_cloud.ply", "config.json", "cameras.json", "metrics.json", "renders"),
    *("result.json", "figure.png", "report.html"),
}


def point(n, drop, error=0.0):
    return Point(n, 100 * n, (30.0, 30.0), (0.9, 0.9), drop, error)


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SCENE)


def trained(scene_folder, out, *options):
    command = ["train", str(scene_folder), "--out", str(out), "--iterations", "40", "--test-every", "6", *options]
    assert main(command) == 0
    return out


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    return trained(scene_folder, tmp_path_factory.mktemp("runs") / "run")


def simplify(folder, out, *options):
    return main(["simplify", str(folder), "--out", str(out), "--fine-tune", "3", *options])


@pytest.fixture(scope="module")
def halved(run_folder, tmp_path_factory):
    """Simplified to a budget, once for the tests that look at it."""
    out = tmp_path_factory.mktemp("runs") / "halved"
    assert simplify(run_folder, out, "--budget", "70") == 0
    return out


def read(path):
    return json.loads(path.read_text())


# The rule -------------------------------------------------------------------------------------------------------------


def test_paired_drop_by_hand():
    """Differences 1, 2, 6: mean 3, deviations -2, -1, 3, so variance 14 / 2 and standard error sqrt(7 / 3)."""
    drop, error = paired_drop((20.0, 30.0, 40.0), (19.0, 28.0, 34.0))
    assert drop == pytest.approx(3.0, rel=CLOSED_FORM) and error == pytest.approx(math.sqrt(7 / 3), rel=CLOSED_FORM)


def test_what_all_views_have_in_common_is_no_error():
    drop, error = paired_drop((10.0, 20.0, 40.0), (9.5, 19.5, 39.5))
    assert drop == 0.5 and error == 0.0


def test_drop_of_equal_images_and_of_one_view():
    drop, error = paired_drop((math.inf, math.inf), (math.inf, PSNR_MAX - 1.0))
    assert drop == 0.5 and error == 0.5
    drop, error = paired_drop((30.0,), (29.0,))
    assert drop == 1.0 and math.isnan(error)


def test_smallest_within_adds_one_standard_error():
    points = [point(10, 2.0), point(20, 0.09, 0.02), point(30, 0.06, 0.04), point(40, 0.0, 0.01)]
    assert smallest_within(points, 0.1).n_gaussians == 30  # 20 loses 0.11 with its error
    assert smallest_within(points, 0.11).n_gaussians == 20
    assert smallest_within(points, 5.0).n_gaussians == 10
    assert smallest_within(points[:2], 0.1) is None


def test_search_by_hand():
    """Down by a tenth, then by the square of x to the first size outside the limit, then the geometric mean."""
    assert next_size([], 400, 400, 0.1) == 363  # 400 / 1.1
    # x = log(400 / 363) = 0.0971; a drop of 0.04 reaches 0.1 at 0.0971 sqrt(2.5) = 0.1535, which is 343; that is close
    assert next_size([point(363, 0.04)], 400, 400, 0.1) == 330  # 363 / 1.1
    # with 0.01 at 0.0971 sqrt(10) = 0.307
    assert next_size([point(363, 0.01)], 400, 400, 0.1) == 294
    assert next_size([point(363, 0.001)], 400, 400, 0.1) == 256  # 363 / sqrt(2) at most
    points = [point(363, 0.001), point(256, 0.2)]
    assert next_size(points, 400, 400, 0.1) == round(math.sqrt(256 * 363)) == 305
    assert next_size([*points, point(305, 0.01, 0.06)], 400, 400, 0.1) == round(math.sqrt(256 * 305)) == 279
    assert next_size([*points, point(305, 0.01), point(279, 0.2)], 400, 400, 0.1) is None  # 305 / 279 is close


def test_a_search_that_can_gain_almost_nothing_ends():
    """A tenth is too much already; or a drop in proportion leaves no other tenth within the limit."""
    assert next_size([point(363, 0.11)], 400, 400, 0.1) is None
    assert next_size([point(363, 0.08, 0.03)], 400, 400, 0.1) is None
    # 0.0971 / 0.08 * 0.1 = 0.1214: nothing below 354 can be within, of which 363 is 1.03 times as many
    assert next_size([point(363, 0.08)], 400, 400, 0.1) is None
    # A standard error does not grow with x: here 0.0971 / 0.02 * 0.1 = 0.4855, so 246 might do.
    assert next_size([point(363, 0.02, 0.06)], 400, 400, 0.1) == 330


def test_search_keeps_to_what_there_is():
    assert next_size([], 400, 150, 0.1) == 150  # no more Gaussians are of any importance
    assert next_size([point(150, 0.5)], 400, 150, 0.1) is None  # of the others there are none to add
    assert next_size([], 2, 2, 0.1) == 1 and next_size([point(1, 0.0)], 2, 2, 0.1) is None
    assert next_size([], 1, 1, 0.1) is None


def test_sizes_that_are_left_by_hand():
    assert count_sizes([], 400, 400, 0.1) == (1, None)
    assert count_sizes([point(363, 0.0)], 400, 400, 0.1) == (1, None)  # nothing says yet where it ends
    assert count_sizes([point(363, 0.11)], 400, 400, 0.1) == count_sizes([point(363, 0.08)], 400, 400, 0.1) == (0, 0)
    # 330 is next. In proportion it loses 0.099; then only 329 could do. If it is not within, 363 is close to it.
    assert count_sizes([point(363, 0.05)], 400, 400, 0.1) == (1, 1)
    # With 0.02, 321 is next. In proportion it loses 0.045, 288 0.068, and 261 0.088, below which only 246 could do; if
    # 261 is not within, 274 is between it and 288. These are four; where 321 or 288 are outside, two or three.
    assert count_sizes([point(363, 0.02)], 400, 400, 0.1) == (1, 4)
    # Outside the limit 256 leaves 305 and one of 279 and 333; the latter are close to their neighbours.
    assert count_sizes([point(363, 0.001), point(256, 0.2)], 400, 400, 0.1) == (1, 2)


@pytest.mark.parametrize("slope", [0.01, 0.1, 1.0, 30.0])
def test_search_finds_the_limit_of_a_line(slope):
    """A drop of ``slope`` dB for each halving: the limit lies at n 2^(-0.1 / slope), or below one Gaussian."""
    points, n = [], 10_000
    while (size := next_size(points, n, n, 0.1)) is not None:
        points.append(point(size, slope * math.log2(n / size)))
        assert len(points) < 40
    best, limit = smallest_within(points, 0.1), max(n * 2 ** (-0.1 / slope), 1)
    assert limit <= (n if best is None else best.n_gaussians) <= CLOSE * limit + 1


def test_ply_size_is_that_of_the_file(run_folder, tmp_path):
    size = simplification.ply_size(open_run(run_folder))
    gaussians = load_ply(run_folder / "point_cloud.ply")
    for n in (1, 9, 10, 100):
        save_ply(tmp_path / "a.ply", take(gaussians, np.arange(n)))
        n_bytes = (tmp_path / "a.ply").stat().st_size
        assert size.of(n) == n_bytes
        assert size.max_rows(n_bytes) == n and size.max_rows(n_bytes - 1) == n - 1


def test_digits_of_the_count_count():
    size = PlySize(header=100, row=10)
    assert size.of(9) == 191 and size.of(10) == 202
    assert size.max_rows(201) == 9 and size.max_rows(202) == 10 and size.max_rows(50) == 0


# Fine-tuning ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["3dgs-accel", "mini-splatting"])
def test_rates_of_a_schedule_stay_at_their_last(name):
    recipe = get_recipe(name, 1000)
    tuning, _ = fine_tuning(recipe, 20)
    assert tuning.iterations == recipe.iterations + 20 and not tuning.events
    for step in (recipe.iterations + 1, recipe.iterations + 20):
        assert tuning.rates.at(step, 2.0) == pytest.approx(recipe.rates.at(recipe.iterations, 2.0), rel=CLOSED_FORM)


def test_a_recipe_without_a_schedule_cools_down_again():
    """To 0.1 and 0.01 of its constant rates; after half of the iterations their logarithms are half-way."""
    recipe = get_recipe("adaptive")
    tuning, pace = fine_tuning(recipe, 20)
    assert tuning.rates == recipe.rates and tuning.iterations == pace.last_step and not tuning.events
    half, end = (tuning.cooling.factors(recipe.iterations + k, pace) for k in (10, 20))
    assert half == pytest.approx((0.1**0.5, 0.1), rel=CLOSED_FORM) and end == pytest.approx(
        (0.1, 0.01), rel=CLOSED_FORM
    )


def test_every_training_view_is_held_out_once(run_folder):
    run = open_run(run_folder)
    n = len(run.scene.train_views)
    assert len(run.folds) == N_FOLDS
    assert sorted(k for fold in run.folds for k in fold.held_out) == list(range(n))
    for fold in run.folds:
        assert sorted(fold.trained + fold.held_out) == list(range(n)) and len(fold.trained) >= 2


def test_a_view_is_measured_by_a_copy_that_never_saw_it(run_folder, monkeypatch):
    """By the views that the loop reports; all copies begin with the same Gaussians, and the last sees all views."""
    run, trained, begun, measured = open_run(run_folder), [], [], []

    def watched_train(*args, state, on_step, **named):
        seen = set()
        trained.append(seen)
        begun.append(take(state.gaussians, np.arange(len(state.gaussians.means))))
        return train(*args, state=state, on_step=lambda report: (seen.add(report.view.name), on_step(report)), **named)

    def watched_evaluate(model, views, settings):
        measured.append({view.name for view in views})
        return evaluate(model, views, settings)

    names = {view.name for view in run.scene.train_views}
    monkeypatch.setattr(simplification, "train", watched_train)
    monkeypatch.setattr(simplification, "evaluate", watched_evaluate)
    measure_size = make_measure(run, len(names))  # enough iterations for every view to come up
    point = measure_size(50)  # all Gaussians come after it
    assert len(trained) == len(measured) == 2 * N_FOLDS
    for seen, held_out in zip(trained, measured, strict=True):
        assert seen == names - held_out
    assert len(point.psnrs) == len(point.ssims) == len(names)
    simplification.finish(run, 50, len(names))
    assert trained[-1] == names
    for other in (*begun[1:N_FOLDS], begun[-1]):
        for ours, theirs in zip(begun[0], other, strict=True):
            assert_array_equal(ours, theirs)


# From end to end ------------------------------------------------------------------------------------------------------


def test_budget(halved, run_folder):
    assert {path.name for path in halved.iterdir()} == FILES
    gaussians, result = load_ply(halved / "point_cloud.ply"), read(halved / "result.json")
    assert len(gaussians.means) == 70 == result["chosen"]["n_gaussians"]
    assert (halved / "point_cloud.ply").stat().st_size == result["chosen"]["n_bytes"]
    assert result["target"] == "--budget 70" and result["max_drop"] is None and len(result["curve"]) == 1
    assert result["all"]["n_gaussians"] == len(load_ply(run_folder / "point_cloud.ply").means)
    assert [p["n_gaussians"] for p in result["curve"]] == sorted(p["n_gaussians"] for p in result["curve"])
    for p in result["curve"]:
        drop, error = paired_drop(result["all"]["psnrs"], p["psnrs"])
        assert (p["drop"], p["standard_error"]) == (drop, error)

    metrics, test, chosen = read(halved / "metrics.json"), result["test"], result["chosen"]
    assert metrics["n_gaussians"] == 70 and metrics["psnr"] == test["psnr_after"]
    before = read(run_folder / "metrics.json")["psnr"]
    assert metrics["psnr_before"] == test["psnr_before"] == pytest.approx(before, rel=CLOSED_FORM)
    assert test["drop"] == pytest.approx(test["psnr_before"] - test["psnr_after"], abs=1e-9)
    assert (metrics["drop"], metrics["drop_standard_error"]) == (chosen["drop"], chosen["standard_error"])
    assert metrics["ssim_drop"] == pytest.approx(np.mean(result["all"]["ssims"]) - np.mean(chosen["ssims"]), abs=1e-12)
    assert read_image(halved / "figure.png").std() > 1
    page = (halved / "report.html").read_text()
    assert "<svg" in page and 'href="http' not in page and page.count("data:image/png") == 3 * len(test["views"])


def test_the_report_in_a_browser(halved, browser):
    check_page(browser, halved / "report.html")


def test_the_new_folder_is_a_run(halved, tmp_path, capsys):
    """``render``, ``eval``, ``info`` and ``convert`` take it; ``eval`` finds what ``simplify`` has measured."""
    copy = shutil.copytree(halved, tmp_path / "copy")
    before = read(copy / "metrics.json")
    assert main(["eval", str(copy)]) == 0
    assert read(copy / "metrics.json") == before
    assert main(["render", str(copy), "--out", str(tmp_path / "views")]) == 0
    assert main(["convert", str(copy), str(tmp_path / "a.ply")]) == 0
    assert (tmp_path / "a.ply").read_bytes() == (copy / "point_cloud.ply").read_bytes()
    capsys.readouterr()
    assert main(["info", str(copy)]) == 0
    out = capsys.readouterr().out
    assert "complete" in out and "psnr before" in out


def test_same_bytes_twice(halved, run_folder, tmp_path):
    again = tmp_path / halved.name  # the page names the folder
    assert simplify(run_folder, again, "--budget", "70") == 0
    for name in ("point_cloud.ply", "result.json", "metrics.json", "figure.png"):
        assert (again / name).read_bytes() == (halved / name).read_bytes(), name


def test_without_fine_tuning_neighbours_are_merged(run_folder, scene_folder, tmp_path):
    command = ["simplify", str(run_folder), "--out", str(tmp_path / "out"), "--budget", "60", "--fine-tune", "0"]
    assert main(command) == 0
    dense, scene = load_ply(run_folder / "point_cloud.ply"), load_scene(scene_folder, test_every=6)
    settings, views = RenderSettings(scene.background), scene.train_views

    merged = merge_neighbours(dense, collect_importance(dense, views).blend_weight_sum, 60).gaussians
    for ours, theirs in zip(load_ply(tmp_path / "out" / "point_cloud.ply"), merged, strict=True):
        assert_array_equal(ours, theirs)
    before, after = ([view.psnr for view in evaluate(g, views, settings).per_view] for g in (dense, merged))
    chosen = read(tmp_path / "out" / "result.json")["chosen"]
    assert (chosen["drop"], chosen["standard_error"]) == pytest.approx(paired_drop(before, after), rel=1e-9)


def test_max_bytes_is_a_ceiling(run_folder, tmp_path):
    row = simplification.ply_size(open_run(run_folder)).row
    most = (run_folder / "point_cloud.ply").stat().st_size // 2
    assert simplify(run_folder, tmp_path / "out", "--max-bytes", str(most)) == 0
    assert most - row < (tmp_path / "out" / "point_cloud.ply").stat().st_size <= most


def test_max_drop_is_kept_by_the_smallest_of_the_measured(run_folder, tmp_path, capsys):
    assert simplify(run_folder, tmp_path / "out", "--max-drop", "1") == 0
    result = read(tmp_path / "out" / "result.json")
    within = [p["n_gaussians"] for p in result["curve"] if p["drop"] + p["standard_error"] <= 1]
    assert result["chosen"]["n_gaussians"] == min(within)
    lines = capsys.readouterr().out.splitlines()
    assert sum("chosen" in line for line in lines) == 1 and lines[-1].startswith("test PSNR ")


def test_as_small_as_it_gets(run_folder, tmp_path, capsys):
    """Nothing may be lost: the new folder holds the run's own Gaussians, and one line says why."""
    assert simplify(run_folder, tmp_path / "out", "--max-drop", "0") == 0
    assert (tmp_path / "out" / "point_cloud.ply").read_bytes() == (run_folder / "point_cloud.ply").read_bytes()
    result, metrics = read(tmp_path / "out" / "result.json"), read(tmp_path / "out" / "metrics.json")
    assert result["is_unchanged"] and result["chosen"] == result["all"]
    assert metrics["drop"] == metrics["ssim_drop"] == 0 and metrics["psnr"] == metrics["psnr_before"]
    assert all(p["drop"] + p["standard_error"] > 0 for p in result["curve"])
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("already as small as it gets")]
    nearest = min(result["curve"], key=lambda p: p["drop"] + p["standard_error"])
    assert f"{nearest['n_gaussians']:,} instead of {result['all']['n_gaussians']:,} Gaussians lose" in line
    assert "already as small as it gets" in (tmp_path / "out" / "report.html").read_text()


def test_a_tenth_of_a_decibel_where_nothing_is_asked(run_folder, tmp_path):
    default, asked = tmp_path / "default", tmp_path / "asked"
    assert simplify(run_folder, default) == 0 and simplify(run_folder, asked, "--max-drop", str(DEFAULT_DROP)) == 0
    assert (default / "result.json").read_bytes() == (asked / "result.json").read_bytes()
    chosen = read(default / "result.json")["chosen"]
    assert chosen["drop"] + chosen["standard_error"] <= DEFAULT_DROP == 0.1


def test_the_search_ends_at_the_limit(run_folder):
    """Of sizes whose drops are made up: as if Gaussians beyond 60 showed nothing, the smallest is just above 60."""
    run = open_run(run_folder)
    n, asked = len(run.model.gaussians.means), []

    def measure_size(count):
        asked.append(count)
        return point(count, 0.0 if count >= 60 else 5.0)

    decision = decide(run, Target(), measure_size)
    assert not decision.is_unchanged and 60 <= decision.chosen.n_gaussians <= 60 * CLOSE
    assert decision.reference.n_gaussians == n == asked[0] and len(asked) == len(set(asked))
    assert decide(run, Target(budget=7), measure_size).chosen.drop == 5.0, "a budget is kept whatever is lost"


def test_a_budget_of_more_than_all_keeps_all_that_matter(run_folder, scene_folder, tmp_path, capsys):
    assert simplify(run_folder, tmp_path / "out", "--budget", "100000") == 0
    result = read(tmp_path / "out" / "result.json")
    gaussians, scene = load_ply(run_folder / "point_cloud.ply"), load_scene(scene_folder, test_every=6)
    weights = collect_importance(gaussians, scene.train_views).blend_weight_sum
    assert result["is_all_that_matter"] and result["chosen"]["n_gaussians"] == np.count_nonzero(weights)
    assert "--budget 100000 is more than all" in capsys.readouterr().err


def test_of_an_extension(scene_folder, tmp_path):
    """A population with one more field, whose bytes count; shared parameters and exposures come along."""
    run = trained(scene_folder, tmp_path / "run", "--recipe", "velocity", "--set", "exposure=learned")
    assert simplify(run, tmp_path / "out", "--budget", "40") == 0
    population = find_recipe("velocity").representation.population
    assert load_ply(tmp_path / "out" / "point_cloud.ply", population).velocities.shape == (40, 3)
    result = read(tmp_path / "out" / "result.json")
    assert (tmp_path / "out" / "point_cloud.ply").stat().st_size == result["chosen"]["n_bytes"]
    exposures = [np.load(folder / "shared.npz")["exposures"] for folder in (run, tmp_path / "out")]
    assert exposures[0].shape == exposures[1].shape == (12, 3, 4) and (exposures[0] != exposures[1]).any()
    assert main(["eval", str(tmp_path / "out")]) == 0


# After a training -----------------------------------------------------------------------------------------------------


def test_a_training_is_followed_by_its_simplification(scene_folder, tmp_path, capsys, monkeypatch):
    """To the same bytes as the command does it, also where a continued run is what ends."""
    limit = "9000"
    monkeypatch.setattr("minisplat_ref.app.cli.simplify.FINE_TUNE", 10)
    run = trained(scene_folder, tmp_path / "run", "--recipe", "3dgs-accel", "--max-bytes", limit)
    small = run / "simplified"
    assert (small / "point_cloud.ply").stat().st_size <= int(limit) < (run / "point_cloud.ply").stat().st_size
    lines = [line for line in capsys.readouterr().out.splitlines() if not line.startswith("in a new terminal")]
    assert lines[-1].startswith("test PSNR ")
    assert main(["simplify", str(run), "--out", str(tmp_path / "again"), "--max-bytes", limit]) == 0
    assert (tmp_path / "again" / "point_cloud.ply").read_bytes() == (small / "point_cloud.ply").read_bytes()
    assert main(["train", "--resume", str(run), "--iterations", "41"]) == 0
    assert read(small / "metrics.json")["iterations"] == 40, "what is there already stays"
    assert f"{small} is of an earlier end of the run" in capsys.readouterr().err


def test_a_simplification_that_cannot_follow_is_refused_before_the_training(scene_folder, tmp_path, capsys):
    command = ["train", str(scene_folder), "--out", str(tmp_path / "run"), "--iterations", "5"]
    assert main([*command, "--max-bytes", "10"]) == 2
    assert "--max-bytes 10 is too little" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*command, "--max-drop", "0.1", "--max-bytes", "9000"])
    assert not (tmp_path / "run").exists()


# What is refused ------------------------------------------------------------------------------------------------------


@pytest.fixture
def refused(tmp_path, capfd):
    """Simplify what must be refused; nothing is left, and one line says why."""

    def run(folder, *options, out=None):
        out = out or tmp_path / "out"
        before = sorted(tmp_path.rglob("*"))
        try:
            code = simplify(folder, out, *options)
        except SystemExit as error:  # of the arguments
            code = error.code
        assert code == 2
        assert sorted(tmp_path.rglob("*")) == before
        (line,) = [line for line in capfd.readouterr().err.splitlines() if "error: " in line]
        return line.rpartition("error: ")[2]

    return run


def test_targets_that_cannot_be_met(run_folder, refused):
    size = simplification.ply_size(open_run(run_folder))
    line = refused(run_folder, "--max-bytes", "10")
    assert "--max-bytes 10 is too little" in line and f"{size.of(1):,} bytes" in line and "convert" in line
    assert "not a whole number" in refused(run_folder, "--budget", "0")
    assert "not a number of dB" in refused(run_folder, "--max-drop", "nan")
    assert "not allowed with" in refused(run_folder, "--budget", "9", "--max-bytes", "90000")


def test_folders_that_cannot_be_used(halved, run_folder, refused, tmp_path):
    assert "is not a folder" in refused(tmp_path / "nowhere")
    assert "already there and not empty" in refused(run_folder, out=halved)
    assert "holds no run" in refused(run_folder / "renders")


def test_photographs_that_are_elsewhere(run_folder, scene_folder, refused, tmp_path):
    copy = shutil.copytree(run_folder, tmp_path / "run")
    config = read(copy / "config.json")
    config["settings"]["scene"] = str(tmp_path / "gone")
    (copy / "config.json").write_text(json.dumps(config))
    line = refused(copy)
    assert f"{tmp_path / 'gone'}, the scene of" in line and "--scene PATH" in line
    assert open_run(copy, scene_folder).settings.scene == str(scene_folder)


def test_too_few_views_to_decide_by(tmp_path, refused):
    options = {**SCENE, "n_views": 3, "test_every": 0}
    write_room(tmp_path / "scene", **options)
    command = ["train", str(tmp_path / "scene"), "--out", str(tmp_path / "run"), "--iterations", "2"]
    assert main([*command, "--recipe", "3dgs-accel", "--test-every", "0"]) == 0
    assert "needs at least 4 training views, some of which are held out in turn to measure what is lost" in refused(
        tmp_path / "run"
    )


@pytest.mark.parametrize("reason", ["", "its kernels collect none"])
def test_a_renderer_without_blend_weights(run_folder, refused, monkeypatch, reason):
    """Whether it leaves them out or refuses to draw."""
    recipe = get_recipe("3dgs-accel", 40)
    inner = recipe.representation.renderer

    def render(model, view, request):
        if reason:
            raise InputError(reason)
        output, tape = inner.render(model, view, request)
        return output._replace(stats=None), tape

    blind = recipe.representation._replace(renderer=inner._replace(name="blind", render=render))
    monkeypatch.setattr(opened_run, "configure_recipe", lambda settings: recipe._replace(representation=blind))
    line = refused(run_folder)
    assert "renderer blind of extension core gives no blend weights" in line and reason in line


def test_no_test_views(scene_folder, tmp_path, capsys):
    command = ["train", str(scene_folder), "--out", str(tmp_path / "run"), "--iterations", "5", "--test-every", "0"]
    assert main(command) == 0
    assert simplify(tmp_path / "run", tmp_path / "out", "--budget", "50") == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith("50 Gaussians; no test views to measure")
    assert read(tmp_path / "out" / "result.json")["test"] is None


def test_an_unfinished_run(run_folder, tmp_path):
    """Its checkpoint is simplified, and a line says so."""
    copy = shutil.copytree(run_folder, tmp_path / "run")
    for name in ("point_cloud.ply", "metrics.json"):
        (copy / name).unlink()
    with pytest.warns(InputWarning, match="has not ended: this is its checkpoint of iteration 40"):
        run = open_run(copy)
    assert run.unfinished == run.step == 40
    assert_array_equal(run.model.gaussians.means, load_ply(run_folder / "point_cloud.ply").means)
