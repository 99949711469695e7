"""``compare``: from the command line to its files, and by hand what its measures, its table and its crops say."""

import contextlib
import csv
import io
import json
import math
import re
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from browser import check_page
from minisplat_ref.app.cli import main
from minisplat_ref.app.comparison import runs as runs_module
from minisplat_ref.app.comparison import speed
from minisplat_ref.app.comparison.crops import best_window, choose_crops, detail, difference
from minisplat_ref.app.comparison.metrics import (
    METRICS,
    RecipeMetrics,
    Spread,
    best_record,
    densification_end,
    first_to_reach,
    peak_training_mb,
    relation,
    spread,
)
from minisplat_ref.app.comparison.plan import Plan
from minisplat_ref.app.comparison.table import table_cells
from minisplat_ref.app.runs import trainings
from minisplat_ref.app.runs.events import Mechanism
from minisplat_ref.app.runs.progress import read_log
from minisplat_ref.app.runs.recipe_actions import Fired, remarks, rows
from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.io import load_ply, load_scene
from minisplat_ref.methods import RECIPES
from minisplat_ref.rendering import SPLATTING
from minisplat_ref.training.schedule import At, describe
from minisplat_ref.types import Gaussians, Model
from run_commands import in_process_silently, write_room
from tolerances import CLOSED_FORM

SCENE = {"n_views": 8, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
RECIPE_NAMES, ITERATIONS = ("3dgs", "3dgs-accel"), (24, 12)
FIGURES = {
    "psnr_over_time.png",
    "psnr_over_iterations.png",
    "psnr_over_count.png",
    "chamfer_over_iterations.png",
    "gallery.png",
}
OPTIONS = ["--recipes", ",".join(RECIPE_NAMES), "--iterations", ",".join(map(str, ITERATIONS)), "--test-every", "4"]


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SCENE)


@pytest.fixture(scope="module")
def compared(scene_folder, tmp_path_factory):
    """A comparison from the command line, and what it has printed itself."""
    folder = tmp_path_factory.mktemp("comparisons") / "compared"
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setattr(runs_module, "train_here", in_process_silently)
        assert main(["compare", str(scene_folder), *OPTIONS, "--out", str(folder)]) == 0
    return folder, printed.getvalue()


def read_json(path):
    return json.loads(path.read_text())


# From the command line


def test_what_is_in_the_folder(compared):
    folder, _ = compared
    run_folders = {f"{recipe}-seed0" for recipe in RECIPE_NAMES}
    assert {path.name for path in folder.iterdir()} == run_folders | FIGURES | {
        "plan.json",
        "compare.json",
        "table.csv",
        "table.tex",
        "report.html",
    }
    for recipe, iterations in zip(RECIPE_NAMES, ITERATIONS, strict=True):
        settings = read_json(folder / f"{recipe}-seed0" / "config.json")["settings"]
        assert (settings["recipe"], settings["iterations"], settings["seed"]) == (recipe, iterations, 0)
        assert settings["schedule_iterations"] == iterations
        steps = [record["step"] for record in read_log(folder / f"{recipe}-seed0" / "curve.jsonl")]
        assert steps == list(range(1, iterations + 1))


def test_compare_json_says_what_the_runs_say(compared, scene_folder):
    folder, _ = compared
    content = read_json(folder / "compare.json")
    assert content["settings"]["recipes"] == list(RECIPE_NAMES)
    assert content["settings"]["scene"] == str(scene_folder.resolve())
    assert "threads" in content["machine"] and "Numba" in content["machine"]
    assert content["lpips_reason"]
    first, second = content["recipes"]
    for recipe in (first, second):
        run = recipe["runs"][0]
        metrics = read_json(folder / run["folder"] / "metrics.json")
        for key in (
            "psnr",
            "psnr_exposed",
            "psnr_corrected",
            "ssim",
            "lpips",
            "n_gaussians",
            "train_seconds",
            "peak_rss_mb",
        ):
            assert run[key] == recipe["mean"][key] == metrics[key]
        assert run["iterations_per_second"] == metrics["iterations"] / metrics["train_seconds"]
        ply = folder / run["folder"] / "point_cloud.ply"
        assert run["ply_bytes"] == ply.stat().st_size
        trained_mb = 4 * sum(field.nbytes for field in load_ply(ply)) / 1e6
        assert run["densified_mb"] == pytest.approx(trained_mb, rel=CLOSED_FORM)
        assert run["render_fps"] > 0
        curve = read_log(folder / run["folder"] / "curve.jsonl")
        assert run["best_psnr"] == max(record["psnr"] for record in curve)
        assert [record["psnr"] for record in curve if record["step"] == run["best_iteration"]] == [run["best_psnr"]]
        assert run["chamfer"] == curve[-1]["chamfer"] > 0
        assert set(recipe["std"].values()) == {None}
    assert second["relative_to_first"]["psnr"] == second["mean"]["psnr"] - first["mean"]["psnr"]
    assert second["relative_to_first"]["ply_bytes"] == second["mean"]["ply_bytes"] / first["mean"]["ply_bytes"]
    assert first["mean"]["seconds_to_first"] <= first["mean"]["train_seconds"]
    assert first["mean"]["iterations_to_first"] <= ITERATIONS[0]
    assert second["relative_to_first"]["best_iteration"] is None
    differences = ("psnr", "psnr_exposed", "psnr_corrected", "ssim", "lpips", "best_psnr")
    assert second["error_of_difference"] == dict.fromkeys(differences)  # of one seed


def test_table_files_say_what_compare_json_says(compared):
    folder, printed = compared
    of_json = {recipe["recipe"]: recipe for recipe in read_json(folder / "compare.json")["recipes"]}
    with open(folder / "table.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert {row["recipe"] for row in table} == set(RECIPE_NAMES)
    for row in table:
        mean = of_json[row["recipe"]]["mean"][row["metric"]]
        assert row["mean"] == ("" if mean is None else str(mean))
    latex = (folder / "table.tex").read_text()
    psnr = next(line for line in printed.splitlines() if line.startswith("| PSNR (dB)")).split("|")[2].strip()
    assert f"PSNR (dB) & {psnr} &" in latex
    assert "3dgs & 3dgs-accel" in latex


def test_what_fired_is_told(compared):
    """24 iterations of 3dgs are too few for anything but the reset in front of white, which is not there."""
    folder, printed = compared
    content, page = read_json(folder / "compare.json"), (folder / "report.html").read_text()
    for recipe in content["recipes"]:
        assert [mechanism["action"] for mechanism in recipe["runs"][0]["mechanisms"]] == ["reset_opacity_on_white"]
        assert recipe["never_fired"] == ["clone_and_split", "prune_faint", "prune_large", "reset_opacity"]
    for text in (printed, page):
        assert text.count("clone_and_split, prune_faint, prune_large, reset_opacity") == 2
        assert "nothing done: the background is not white" in text
        assert "3dgs: 24 iterations, published for 30,000" in text


def test_printed_table_and_report(compared, scene_folder):
    folder, printed = compared
    second = read_json(folder / "compare.json")["recipes"][1]["mean"]
    page = (folder / "report.html").read_text()
    for text in (printed, page):
        assert f"{second['psnr']:.2f}" in text and f"{second['ply_bytes']:,.0f}" in text
        assert "LPIPS null" in text
    assert f"open {folder / 'report.html'}" in printed
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert all(link.startswith(("data:image/png;base64,", "#")) for link in links)
    assert not re.search(r"url\((?!#)|@import|<script src|<link", page)
    n_crops, n_columns = 3, 3  # one crop per test view; truth and two recipes
    assert page.count("data:image/png") == n_crops * n_columns and page.count("<svg") == 4
    assert "threads" in page and "8 training and 3 test views" in page


def test_the_report_in_a_browser(compared, browser):
    folder, _ = compared
    check_page(browser, folder / "report.html")
    assert browser.run("document.querySelector('.slider select').options.length") == len(RECIPE_NAMES)


# Trainings that do not end well: a stand-in for the command of the training


def compare_with(command, monkeypatch, scene_folder, out):
    monkeypatch.setattr(runs_module, "warm_up", lambda plan, scene: None)
    monkeypatch.setattr(trainings, "PROGRAM", ())
    monkeypatch.setattr(runs_module, "_first_words", lambda plan, run: command)
    return main(["compare", str(scene_folder), *OPTIONS, "--out", str(out)])


def test_refused_training_ends_the_comparison(scene_folder, tmp_path, monkeypatch, capfd):
    command = [sys.executable, "-m", "minisplat_ref", "train", str(tmp_path / "nowhere"), "--out", str(tmp_path / "x")]
    assert compare_with(command, monkeypatch, scene_folder, tmp_path / "out") == 2
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and str(tmp_path / "nowhere") in lines[0]
    assert not any(tmp_path.iterdir())


def test_runs_before_a_failed_one_stay(scene_folder, tmp_path, monkeypatch):
    finished = tmp_path / "out" / "finished"
    code = f"import pathlib, sys; p = pathlib.Path({str(finished)!r}); sys.exit(2 if p.exists() else p.mkdir())"
    assert compare_with([sys.executable, "-c", code], monkeypatch, scene_folder, tmp_path / "out") == 2
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"finished", "plan.json"}


def test_killed_training_is_not_taken_for_a_result(scene_folder, tmp_path, monkeypatch):
    code = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    with pytest.raises(subprocess.CalledProcessError, match="SIGKILL"):
        compare_with([sys.executable, "-c", code], monkeypatch, scene_folder, tmp_path / "out")


TRAINING_THAT_SAVES = """
import os, signal, sys, pathlib, time
folder = pathlib.Path(sys.argv[1])
def save(*_):
    signal.signal(signal.SIGINT, lambda *_: sys.exit("interrupted while saving"))
    time.sleep(0.3)
    (folder / "saved").touch()
    sys.exit(130)
signal.signal(signal.SIGINT, save)
os.kill(os.getppid(), signal.SIGINT)
if sys.argv[2] == "too":
    os.kill(os.getpid(), signal.SIGINT)
time.sleep(60)
"""


@pytest.fixture
def heeds_interrupts():
    """Ctrl-C interrupts also where the tests run in the background, whose shell has it ignored."""
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, previous)


@pytest.mark.parametrize(("who", "saving_seconds"), [("too", 30.0), ("not", 0.1)])
def test_interrupted_while_training(scene_folder, tmp_path, monkeypatch, capfd, heeds_interrupts, who, saving_seconds):
    """The training is interrupted as well, by the terminal, or it is not and must be told; once in both cases."""
    monkeypatch.setattr(trainings, "SAVING_SECONDS", saving_seconds)
    out = tmp_path / "out"
    command = [sys.executable, "-c", TRAINING_THAT_SAVES, str(out), who]
    assert compare_with(command, monkeypatch, scene_folder, out) == 130
    assert {path.name for path in out.iterdir()} == {"saved", "plan.json"}
    expected = f"minisplat-ref: interrupted; to continue: minisplat-ref compare --resume {out}\n"
    assert capfd.readouterr().err == expected


# The plan


def plan(**changes):
    defaults = {"scene": Path("scene"), "folder": Path("out"), "recipes": ("a", "b"), "iterations": (300, 100)}
    options = {"seeds": (0, 5), "downscale": 2, "test_every": 4, "eval_every": None}
    not_given = {"budget": None, "simplify": None, "scene_type": None}
    return Plan(**{**defaults, **options, **not_given, **changes})


def test_runs_go_seed_by_seed():
    assert [(run.recipe, run.iterations, run.seed) for run in plan().runs] == [
        ("a", 300, 0),
        ("b", 100, 0),
        ("a", 300, 5),
        ("b", 100, 5),
    ]
    assert [run.folder for run in plan().list_runs("b")] == [Path("out/b-seed0"), Path("out/b-seed5")]


def test_options_go_to_the_recipes_that_take_them(monkeypatch):
    def simplify(state, iteration, *, budget, metric):
        pass

    event = At(10, partial(simplify, budget=None, metric=None))
    monkeypatch.setitem(RECIPES, "a", RECIPES["3dgs"])
    monkeypatch.setitem(RECIPES, "b", RECIPES["3dgs"]._replace(events=(event,)))
    ours = plan(budget=70, scene_type="outdoor", seeds=(0,))
    assert [run.options for run in ours.runs] == [{}, {"budget": 70, "scene_type": "outdoor"}]
    words = runs_module.next_words(ours, 1)
    expected = "--recipe b --iterations 100 --seed 0 --downscale 2 --test-every 4 --eval-every 4 --budget 70"
    assert " ".join(words) == f"train scene {expected} --scene-type outdoor --out out/b-seed0"


@pytest.mark.parametrize(("iterations", "n_points"), [(3000, 24), (1000, 24), (60, 30), (5, 5), (1, 1)])
def test_about_two_dozen_points(iterations, n_points):
    (run,) = plan(iterations=(iterations,), recipes=("a",), seeds=(0,)).runs
    assert math.ceil(iterations / run.eval_every) == n_points


def test_points_as_asked_for():
    assert {run.eval_every for run in plan(eval_every=7).runs} == {7}


# Measures by hand


def curve(*psnrs):
    return [{"step": 10 * i, "seconds": 0.5 * i, "psnr": psnr} for i, psnr in enumerate(psnrs, start=1)]


def test_first_to_reach():
    records = curve(15.0, 18.0, 17.0, 21.0)
    assert first_to_reach(records, 14.0)["step"] == 10
    assert first_to_reach(records, 18.0)["step"] == 20  # equal is reached, though it falls again
    assert first_to_reach(records, 18.1)["step"] == 40
    assert first_to_reach(records, 21.1) is None
    assert first_to_reach([], 0.0) is None


def test_best_on_the_way():
    assert best_record(curve(15.0, 18.0, 17.0, 18.0, 17.5))["step"] == 20
    assert best_record(curve(15.0, 18.0))["step"] == 20


def test_peak_of_model_gradients_and_moments():
    """The record of the last iteration of densification is written after its events, the simplification among them."""
    log = [{"step": step, "model_mb": mb} for step, mb in ((5, 1.0), (10, 3.5), (15, 2.5), (20, 0.75), (25, 0.5))]
    assert peak_training_mb(log, 20) == (14.0, 3.0)
    assert peak_training_mb(log, math.inf) == (14.0, None)
    assert peak_training_mb([], 20) == (None, None)


@pytest.mark.parametrize("name", [name for name, recipe in RECIPES.items() if recipe.cooling is None])
def test_every_recipe_with_a_schedule_stops_densifying_before_its_end(name):
    assert 0 < densification_end(describe(RECIPES[name])) < RECIPES[name].iterations


def test_end_of_densification():
    def event(action, stop):
        return {"action": action, "stop": stop, "factor": "1/10"}

    events = [event("clone_and_split", 100), event("prune_faint", 300), event("clone_and_split", 200)]
    assert densification_end({"events": events}) == 20
    assert densification_end({"events": [event("clone_and_split", None)]}) == math.inf
    assert densification_end({"events": []}) == math.inf


def test_spread():
    assert spread([1.0, 2.0, 6.0]) == Spread(3.0, pytest.approx(math.sqrt(7.0)))  # (4 + 1 + 9) / 2
    assert spread([2.0]) == Spread(2.0, None)
    assert spread([2.0, None]) == Spread(None, None)


def test_relation():
    by_key = {measure.key: measure for measure in METRICS}
    assert relation(by_key["n_gaussians"], Spread(25.0, None), Spread(100.0, None)) == 0.25
    assert relation(by_key["psnr"], Spread(24.0, None), Spread(25.5, None)) == -1.5
    assert relation(by_key["lpips"], Spread(None, None), Spread(None, None)) is None
    assert relation(by_key["n_gaussians"], Spread(25.0, None), Spread(0.0, None)) is None


def measures(**values):
    return {**{measure.key: 1.0 for measure in METRICS}, "lpips": None, **values}


def test_error_of_a_difference_is_paired_by_seed():
    """Seeds differ by far more than recipes do: differences 1, 2 and 3 have deviation 1, their mean 1 / sqrt(3)."""
    psnr = METRICS[0]
    first = RecipeMetrics("a", [measures(psnr=psnr) for psnr in (10.0, 20.0, 30.0)])
    other = RecipeMetrics("b", [measures(psnr=psnr) for psnr in (11.0, 22.0, 33.0)])
    assert other.error_of_difference(psnr, first) == pytest.approx(1 / math.sqrt(3), rel=CLOSED_FORM)
    single = [RecipeMetrics(recipe.recipe, recipe.runs[:1]) for recipe in (other, first)]
    assert single[0].error_of_difference(psnr, single[1]) is None
    lacking = RecipeMetrics("b", [*other.runs[:2], measures(psnr=None)])
    assert lacking.error_of_difference(psnr, first) is None


def test_table():
    recipes = [
        RecipeMetrics("a", [measures(psnr=25.0, n_gaussians=9000), measures(psnr=27.0, n_gaussians=11000)]),
        RecipeMetrics("b", [measures(psnr=24.5, n_gaussians=2000, seconds_to_first=None), measures(psnr=24.5)]),
        RecipeMetrics("c", [measures(seconds_to_first=None, iterations_to_first=None, psnr=25.0)] * 2),
    ]
    heading, *rows = table_cells(recipes)
    assert heading == ["", "a", "b", "c"]
    assert [row[0] for row in rows] == [measure.title for measure in METRICS]
    by_title = {title: cells for title, *cells in rows}
    assert by_title["PSNR (dB)"][:2] == ["26.00 ± 1.41", "24.50 ± 0.00 (-1.50 ± 1.00)"]
    assert by_title["LPIPS"] == ["null"] * 3
    assert by_title["reached at iteration"] == ["1 ± 0"] * 3
    assert by_title["Gaussians"][:2] == ["10,000 ± 1,414", "1,000 ± 1,414 (0.1x)"]
    assert by_title["until the first's final PSNR (s)"][1:] == ["not reached by 1 of 2", "not reached"]
    assert by_title["the same (iterations)"][1:] == ["1 ± 0 (1x)", "not reached"]


def test_table_without_a_true_surface():
    """Not the row of a distance that nobody could know; a null of LPIPS has its reason told."""
    rows = table_cells([RecipeMetrics("a", [measures(chamfer=None)])])[1:]
    assert [row[0] for row in rows] == [measure.title for measure in METRICS if measure.key != "chamfer"]


# Mechanisms by hand


def mechanism(action, times, first, last, added, removed, **notes):
    return Mechanism(action, times, 0, first, last, added, removed, 0, 0, 0.0, notes)


def test_table_of_mechanisms():
    """The range where seeds differ; what acted with one seed only is no mechanism that never did."""
    runs = [
        [mechanism("grow", 3, 100, 300, 5000, 0), mechanism("prune", 1, 100, 100, 0, 7, full=1)],
        [mechanism("grow", 3, 100, 400, 4000, 10, paused=2)],
    ]
    fired = Fired("a", 900, 30_000, {"grow": 145, "prune": 1, "reset": 4}, runs)
    assert rows(fired) == [
        ["grow", "3", "145", "100", "300 to 400", "4,000 to 5,000", "0 to 10"],
        ["prune", "0 to 1", "1", "100", "100", "0", "7"],
    ]
    assert remarks(fired) == ["prune: full", "grow: paused (2 times)", "never: reset"]
    assert remarks(fired._replace(published={"grow": 145})) == ["prune: full", "grow: paused (2 times)"]


# Speed and crops


def test_models_are_rendered_by_turns(scene_folder, monkeypatch):
    """By a clock that renderings move on: 1 s a view in the first timed round, 2 s in the next, and so on.

    Model 1 takes twice that, and the round before them is slow; the middle one of the timed rounds counts.
    """
    scene = load_scene(scene_folder, test_every=4)
    n_views = len(scene.test_views)
    now, order = [0.0], []

    class Slow(int):
        def render(self, view):
            round_number = len(order) // (2 * n_views)
            now[0] += (round_number or 100.0) * (1.0 if self == 0 else 2.0)
            order.append(self)

    monkeypatch.setattr(speed.time, "perf_counter", lambda: now[0])
    middle = (speed.ROUNDS + 1) / 2
    assert speed.render_rates([Slow(0), Slow(1)], scene) == pytest.approx([1 / middle, 0.5 / middle], rel=CLOSED_FORM)
    assert order == ([0] * n_views + [1] * n_views) * (speed.ROUNDS + 1)


def test_best_window_by_hand():
    values = np.zeros((5, 6))
    values[1, 4] = values[2, 4] = 3.0
    values[4, 0] = 5.0
    assert best_window(values, 2, 2) == (1, 3, 1.5)
    assert best_window(values, 1, 1) == (4, 0, 5.0)
    assert best_window(values, 5, 6) == (0, 0, pytest.approx(11 / 30))


def test_best_window_is_the_best_of_all(rng):
    values = rng.normal(size=(9, 7))
    means = {(i, j): values[i : i + 4, j : j + 3].mean() for i in range(6) for j in range(5)}
    row, column, mean = best_window(values, 4, 3)
    assert mean == pytest.approx(means[row, column], rel=CLOSED_FORM) == pytest.approx(max(means.values()))


def test_difference_is_that_of_the_errors():
    truth = np.full((2, 3, 3), 100, np.uint8)
    too_bright, too_dark, far_off = truth + 10, truth - 10, truth.copy()
    far_off[0, 0] = (70, 100, 100)  # mean error 10, too
    assert not difference(truth, [too_bright, too_dark])[0, 0]
    assert difference(truth, [truth, too_dark])[1, 2] == 10.0
    assert difference(truth, [truth, far_off])[0, 0] == 10.0


def test_detail_is_where_an_edge_is():
    image = np.zeros((6, 8, 3), np.uint8)
    image[:, 4:] = 200
    assert np.flatnonzero(detail(image)[2]).tolist() == [3, 4]


def test_crops_show_what_differs(scene_folder):
    """One model is empty, so that its error is the photograph; each crop is of another view."""
    scene = load_scene(scene_folder, test_every=2)
    empty = Gaussians(*(np.zeros((0, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (3,), (0, 3))))
    trained = Trained(Model(empty), SPLATTING, np.zeros(3), "GSPLAT_MAIN", "cpu")
    crops = choose_crops([trained, trained], scene)
    assert len({crop.view for crop in crops}) == len(crops) == 4
    assert [crop.reason.split()[-2:] for crop in crops] == [["differ", "most"]] * 2 + [["most", "detail"]] * 2
    assert all(crop.truth.shape == (7, 10, 3) and not np.any(crop.renders) for crop in crops)
    assert len(choose_crops([trained], scene)) == 4
