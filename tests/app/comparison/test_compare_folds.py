"""``compare --folds``: every photograph is held out once, and recipes are compared photograph by photograph."""

import contextlib
import io
import json
import math
import shutil

import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.app.comparison import runs as runs_module
from minisplat_ref.app.comparison.metrics import METRICS, RecipeMetrics, Spread, read_photographs
from minisplat_ref.app.comparison.plan import load_plan
from minisplat_ref.app.comparison.table import photograph_cells, table_cells
from minisplat_ref.app.runs.settings import load as load_settings
from run_commands import in_process_silently, write_room
from tolerances import CLOSED_FORM

SCENE = {"n_views": 7, "width": 32, "height": 24, "n_points": 60, "test_every": 0}
OPTIONS = ["--recipes", "3dgs,3dgs-accel", "--iterations", "6", "--eval-every", "3", "--folds", "3"]
RUNS = [f"{recipe}-fold{fold}-seed0" for fold in range(3) for recipe in ("3dgs", "3dgs-accel")]
HELD_OUT = ([0, 3, 6], [1, 4], [2, 5])  # of seven photographs


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SCENE)


@pytest.fixture(scope="module")
def stopped(scene_folder, tmp_path_factory):
    """Ctrl-C in the fourth of six trainings, before its first checkpoint."""
    folder = tmp_path_factory.mktemp("comparisons") / "stopped"

    def press_ctrl_c(words):
        if words[-1].endswith(RUNS[3]):
            raise KeyboardInterrupt
        return in_process_silently(words)

    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(io.StringIO()):
        patch.setattr(runs_module, "train_here", press_ctrl_c)
        assert main(["compare", str(scene_folder), *OPTIONS, "--out", str(folder)]) == 130
    return folder


@pytest.fixture(scope="module")
def compared(stopped, tmp_path_factory):
    """The same, continued, and what was printed."""
    folder = tmp_path_factory.mktemp("comparisons") / "compared"
    shutil.copytree(stopped, folder)
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setattr(runs_module, "train_here", in_process_silently)
        assert main(["compare", "--resume", str(folder)]) == 0
    return folder, printed.getvalue()


def test_interrupted_and_continued(stopped, compared):
    folder, printed = compared
    assert {path.name for path in stopped.iterdir()} == {"plan.json", *RUNS[:3]}
    headings = [line for line in printed.splitlines() if line.startswith("run ")]
    assert headings[2] == "run 3 of 6: 3dgs, fold 1, seed 0, 6 iterations: finished, kept"
    assert headings[3] == "run 4 of 6: 3dgs-accel, fold 1, seed 0, 6 iterations: started"
    assert {path.name for path in folder.iterdir() if path.is_dir()} == set(RUNS)
    for run in RUNS[:3]:
        assert (folder / run / "point_cloud.ply").read_bytes() == (stopped / run / "point_cloud.ply").read_bytes()
    plan = load_plan(folder)
    for run in plan.runs:
        assert load_settings(run.folder) == runs_module.make_settings(plan, run)


def test_each_photograph_is_held_out_once(compared):
    folder, _ = compared
    for run in RUNS:
        fold = load_settings(folder / run).fold
        views = json.loads((folder / run / "metrics.json").read_text())["per_view"]
        assert [view["name"] for view in views] == [f"view_{i:04d}" for i in HELD_OUT[fold]]
        cameras = json.loads((folder / run / "cameras.json").read_text())
        assert sum(camera["split"] == "train" for camera in cameras) == 7 - len(HELD_OUT[fold])


def test_compare_json_says_what_the_runs_say(compared):
    folder, _ = compared
    content = json.loads((folder / "compare.json").read_text())
    assert (content["settings"]["folds"], content["settings"]["test_every"]) == (3, 3)
    first, second = content["recipes"]
    values = {}
    for recipe in (first, second):
        assert [run["fold"] for run in recipe["runs"]] == [0, 1, 2]
        per_view = {}
        for run in recipe["runs"]:
            metrics = json.loads((folder / run["folder"] / "metrics.json").read_text())
            assert run["psnr"] == metrics["psnr"]
            per_view |= {view["name"]: view["psnr"] for view in metrics["per_view"]}
        values[recipe["recipe"]] = [per_view[name] for name in sorted(per_view)]
        assert {name: photo["psnr"] for name, photo in recipe["photographs"].items()} == per_view
        assert recipe["mean"]["psnr"] == pytest.approx(sum(per_view.values()) / 7, rel=CLOSED_FORM)
    differences = [ours - theirs for ours, theirs in zip(values["3dgs-accel"], values["3dgs"], strict=True)]
    mean = sum(differences) / 7
    error = math.sqrt(sum((difference - mean) ** 2 for difference in differences) / (6 * 7))
    assert second["relative_to_first"]["psnr"] == pytest.approx(mean, rel=1e-9)
    assert second["error_of_difference"]["psnr"] == pytest.approx(error, rel=1e-9)


def test_printed_table_and_report(compared):
    folder, printed = compared
    page = (folder / "report.html").read_text()
    second = json.loads((folder / "compare.json").read_text())["recipes"][1]
    cell = f"{second['mean']['psnr']:.2f} ± {second['standard_error']['psnr']:.2f}"
    cell += f" ({second['relative_to_first']['psnr']:+.2f} ± {second['error_of_difference']['psnr']:.2f})"
    for text in (printed, page):
        assert cell in text and "each of the 7 photographs was held out once, from one of 3 trainings" in text
    assert "7 photographs in 3 folds" in page and "Photograph by photograph" in page
    assert f"{second['photographs']['view_0006']['psnr']:.2f}" in page


def test_a_fold_is_measured_again_as_it_was(compared, tmp_path):
    """``eval`` holds out what the run did; with another --test-every, from the first photograph on."""
    folder, _ = compared
    shutil.copytree(folder / RUNS[3], tmp_path / "run")
    before = json.loads((tmp_path / "run" / "metrics.json").read_text())["per_view"]
    assert main(["eval", str(tmp_path / "run")]) == 0
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["per_view"] == before
    assert main(["eval", str(tmp_path / "run"), "--test-every", "4", "--out", str(tmp_path / "other")]) == 0
    other = json.loads((tmp_path / "other" / "metrics.json").read_text())["per_view"]
    assert [view["name"] for view in other] == ["view_0000", "view_0004"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--folds", "1"], "--folds"),
        (["--folds", "8"], "has 7 photographs for 8 folds: give --folds of at most 7"),
        (["--folds", "3", "--test-every", "3"], "leave out --test-every"),
    ],
)
def test_nonsense_is_one_line(scene_folder, tmp_path, capfd, options, message):
    words = ["compare", str(scene_folder), "--recipes", "3dgs", *options, "--out", str(tmp_path / "out")]
    try:
        code = main(words)
    except SystemExit as error:  # of argparse
        code = error.code
    assert code == 2
    *_, line = capfd.readouterr().err.splitlines()
    assert message in line and not (tmp_path / "out").exists()


def test_folds_leave_enough_to_train_on(tmp_path, capfd):
    """Of three photographs in two folds, the first holds out two."""
    scene = {**SCENE, "n_views": 3}
    write_room(tmp_path / "scene", **scene)
    words = ["compare", str(tmp_path / "scene"), "--recipes", "3dgs", "--folds", "2", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    assert "1 training and 2 test view(s)" in capfd.readouterr().err and not (tmp_path / "out").exists()


# By hand


def test_what_the_trainings_are_told(compared):
    """As words, which workers carry out as well."""
    folder, _ = compared
    shutil.rmtree(folder / RUNS[3])
    expected = "--recipe 3dgs-accel --iterations 6 --seed 0 --downscale 1 --test-every 3 --fold 1 --eval-every 3"
    assert f" {expected} --out " in " ".join(runs_module.stored_words(folder, 3))


ALIKE = {"psnr_exposed": 20.0, "psnr_corrected": 20.0}  # of every photograph


def photographs(*psnrs):
    return {f"p{i}": {**ALIKE, "psnr": psnr, "ssim": 0.5, "lpips": None} for i, psnr in enumerate(psnrs)}


def test_the_difference_is_paired_by_photograph():
    """Photographs differ by 10 dB, recipes by 1, 2 and 3: deviation 1, error of the mean 1 / sqrt(3).

    The mean is that of photographs, not of the folds, of which the second holds out but one.
    """
    run = {metric.key: 0.0 for metric in METRICS}
    runs = [{**run, "psnr": 15.0}, {**run, "psnr": 30.0}]
    first = RecipeMetrics("a", runs, photographs(10.0, 20.0, 30.0))
    other = RecipeMetrics("b", runs, photographs(11.0, 22.0, 33.0))
    psnr = METRICS[0]
    assert first.compute_spread(psnr) == Spread(20.0, 10.0)
    assert first.compute_error(psnr) == pytest.approx(10 / math.sqrt(3), rel=CLOSED_FORM)
    assert other.error_of_difference(psnr, first) == pytest.approx(1 / math.sqrt(3), rel=CLOSED_FORM)
    rows = {title: cells for title, *cells in table_cells([first, other])}
    assert rows["PSNR (dB)"] == ["20.00 ± 5.77", "22.00 ± 6.35 (+2.00 ± 0.58)"]
    assert rows["Gaussians"] == ["0 ± 0"] * 2  # over runs
    assert photograph_cells([first, other]) == [
        ["PSNR (dB)", "a", "b"],
        ["p0", "10.00", "11.00 (+1.00)"],
        ["p1", "20.00", "22.00 (+2.00)"],
        ["p2", "30.00", "33.00 (+3.00)"],
    ]


def test_a_photograph_is_the_mean_of_its_seeds(tmp_path):
    """Two folds with two seeds; what is null with one of them is so at all."""
    per_view = {
        "fold0-seed0": [("b", 20.0, 0.5)],
        "fold1-seed0": [("a", 10.0, 0.25)],
        "fold0-seed1": [("b", 22.0, None)],
        "fold1-seed1": [("a", 13.0, 0.75)],
    }
    for name, views in per_view.items():
        (tmp_path / name).mkdir()
        content = [{**ALIKE, "name": view, "psnr": psnr, "ssim": ssim, "lpips": None} for view, psnr, ssim in views]
        (tmp_path / name / "metrics.json").write_text(json.dumps({"per_view": content}))
    assert read_photographs(tmp_path / name for name in per_view) == {
        "a": {**ALIKE, "psnr": 11.5, "ssim": 0.5, "lpips": None},
        "b": {**ALIKE, "psnr": 21.0, "ssim": None, "lpips": None},
    }
