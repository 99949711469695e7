"""Measurements of the machine: the wrong get no figure, and what is compared takes turns. No time is asserted."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from data_tools.machine import (
    conversions,
    large_scene,
    limits,
    peak_memory,
    roofline,
    slopes,
    start_time,
    threads,
)
from data_tools.machine.__main__ import main
from data_tools.machine.contests import time_contests
from minisplat_ref.bench import training_time
from minisplat_ref.errors import InputError
from minisplat_ref.jit import compile as _jit
from minisplat_ref.oracle.tolerances import (
    BENCH_FLOAT32_GRADIENT,
    BENCH_FLOAT32_IMAGE,
    BENCH_FLOAT32_LOSS,
)
from minisplat_ref.training.adam import adam_step
from minisplat_ref.training.loop import train
from tiny_bench import tiny, tiny_workloads, with_pixel  # noqa: F401

ROOT = Path(__file__).parents[2]

PEAK = ("peak", "bound")
pytestmark = pytest.mark.usefixtures("tiny_workloads")


def test_roofline_holds_kernels_against_the_limits(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "N", 1_000)
    monkeypatch.setattr(training_time, "ROOM", {"n_views": 2, "width": 48, "height": 36, "n_points": 500})
    file = tmp_path / "roofline.json"
    assert main(["roofline", "--iterations", "2", "--repeats", "1", "--json", str(file)]) == 0
    cases = {case["name"]: case for case in json.loads(file.read_text())["cases"]}
    assert {"roof/synth forward", "roof/synth backward", "roof/adam 1,000", "stage/sort and bin"} <= set(cases)
    assert ("threads/iteration/adam_update" in cases) == (numba.get_num_threads() > 1)
    assert 1e-9 < cases["stage/project and SH, both ways"]["error"] < BENCH_FLOAT32_GRADIENT


def test_bad_input_is_one_line(capsys):
    assert main(["roofline", "--iterations", "1", "--workloads", "garden"]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "minisplat-ref: " not in line]
    assert len(lines) == 1 and "--data" in lines[0]


def test_conversions_are_measured_format_by_format(tmp_path):
    file = tmp_path / "conversions.json"
    command = ["conversions", "--gaussians", "300", "--formats", ".splat,.glb", "--json", str(file)]
    # In a process of its own: a child begins with the peak of its parent, which here has run other tests.
    assert subprocess.run([sys.executable, "-m", "data_tools.machine", *command], cwd=ROOT).returncode == 0
    first, second = json.loads(file.read_text())["cases"]
    assert first["name"] == ".splat" and first["file MB"] == 0 and second["name"] == ".glb"
    assert 0 < first["CPU seconds"] and 30 < first["peak MB"] < 1000


def test_conversions_that_take_too_much_fail(monkeypatch, capsys):
    monkeypatch.setattr(conversions, "WITHIN", 1e6)
    monkeypatch.setattr(conversions, "SECONDS", 0.01)
    assert main(["conversions", "--gaussians", "10", "--formats", ".splat,.ksplat"]) == 1
    printed = capsys.readouterr().out
    assert "more than 1 MB; more than 0 s" in printed and "exit code 2" in printed and "not written" in printed


def test_a_conversion_that_does_not_end_is_ended(monkeypatch):
    monkeypatch.setattr(conversions, "GIVE_UP", 0.2)
    spent = conversions.run([sys.executable, "-c", "import time; time.sleep(60)"])
    assert spent.code == 124 and spent.seconds < 10


def test_kernels_are_kept_apart_from_those_of_the_package():
    """In a folder inside the package's, which is named by a hash of the file that they are in."""
    for module, kernel in ((roofline, roofline._forward_lines), (limits, limits._copy)):
        kept = Path(_jit.cache_folder(kernel.__wrapped__))
        assert kept.name.startswith(f"{module.__name__.rpartition('.')[2]}-")
        assert kept.parent.name == _jit.source_hash()


def test_straight_lines_do_the_arithmetic_of_a_hit():
    lines = roofline.StraightLines(2)
    lines.forward()
    lines.backward()
    assert 0 < lines.image_error() < BENCH_FLOAT32_IMAGE
    assert 0 < lines.gradient_error() < BENCH_FLOAT32_GRADIENT
    assert lines.n_evaluations == 2 * roofline.N_PASSES * roofline.N_HITS * 32 * 16
    for copy, i in np.ndindex(2, roofline.N_SUMS):
        lines.sums[copy, i] *= 1.01
        assert lines.gradient_error() > BENCH_FLOAT32_GRADIENT
        lines.sums[copy, i] /= 1.01
    lines.drawn[1, -1, -1, -1] += 0.01
    assert lines.image_error() > BENCH_FLOAT32_IMAGE


def test_threads_give_the_same_bytes():
    cases = time_contests(threads.threads(tiny()), repeats=1)
    assert len(cases) == (numba.get_num_threads() > 1)
    assert all(case.passed and case.figures["x"] > 0 for case in cases)


def test_training_on_one_thread_gives_the_same_bytes(monkeypatch):
    monkeypatch.setattr(training_time, "ROOM", {"n_views": 2, "width": 48, "height": 36, "n_points": 500})
    if numba.get_num_threads() == 1:
        assert threads.thread_cases(None, 1, iterations=1) == []
        return
    cases = {case.name.removeprefix("threads/iteration/"): case for case in threads.thread_cases(None, 1, 1)}
    assert {"composite_vjp", "adam_update", "rest", "whole iteration", "straight line"} <= set(cases)
    assert all(case.passed and case.figures["x"] > 0 for case in cases.values())

    def train_otherwise_on_one(*args, state, **kwargs):
        state.gaussians.means[0] += numba.get_num_threads() == 1
        return train(*args, state=state, **kwargs)

    monkeypatch.setattr(threads, "train", train_otherwise_on_one)
    assert not any(case.passed for case in threads.thread_cases(None, 1, 1))


def test_adam_moves_the_part_that_is_seen(monkeypatch):
    monkeypatch.setattr(limits, "N", 1_000)
    whole, part = time_contests(limits.adams(), repeats=1)
    assert whole.passed and part.passed and part.name == "roof/adam 30% of 1,000"

    def step_of_all(parameters, gradient, state, rates, rule, rows):
        return adam_step(parameters, gradient, state, rates, rule._replace(is_visible_only=False), rows)

    monkeypatch.setattr(limits, "adam_step", step_of_all)
    whole, part = time_contests(limits.adams(), repeats=1)
    assert whole.passed and not part.passed


def test_time_against_hits_is_fitted_and_checked(monkeypatch, tmp_path):
    monkeypatch.setattr(slopes, "VIEWS", ((200, (32, 24)), (800, (32, 24)), (400, (64, 48))))
    file = tmp_path / "slopes.json"
    assert main(["slopes", "--repeats", "1", "--json", str(file)]) == 0
    *views, by_hits, by_size = json.loads(file.read_text())["cases"]
    assert len(views) == 3 and all(view["ms"] > 0 and view["flips %"] < 0.1 for view in views)
    assert views[1]["ns a hit"] == pytest.approx(1e6 * views[1]["ms"] / views[1]["hits"])
    assert views[0]["hits"] < views[1]["hits"] < 800 * 32 * 24
    assert by_hits["name"].endswith("hits") and by_size["name"].endswith("pixels")
    assert by_hits["spread"] >= 1


def test_slopes_of_powers_are_their_exponents():
    costs = np.array([1e3, 1e4, 3e5])
    assert slopes.fit_slope(costs, 5 * costs**0.7) == pytest.approx((0.7, 1.0))
    assert slopes.fit_slope([1, 10, 100], [1, 20, 100])[1] == pytest.approx(2 ** (2 / 3))


def test_a_wrong_image_has_no_slope(monkeypatch):
    monkeypatch.setattr(slopes, "VIEWS", ((200, (32, 24)), (400, (32, 24))))
    monkeypatch.setattr(slopes, "CPU", with_pixel(np.nan))
    assert not any(case.passed for case in slopes.slope_cases(1))
    assert slopes.flipped_pixels(np.full((2, 2, 3), np.nan), np.zeros((2, 2, 3))) == 1


def test_peak_memory_is_that_of_the_arrays(monkeypatch):
    monkeypatch.setattr(peak_memory, "N", 2000)
    monkeypatch.setattr(peak_memory, "SIZE", (640, 480))
    case = peak_memory.memory_case()
    figures = case.figures
    assert case.passed, case
    assert figures["moments MB"] == 2 * figures["model MB"] == pytest.approx(2 * 2000 * 59 * 4 / 1e6)
    assert figures["images MB"] == pytest.approx(640 * 480 * (3 + 4 * 7) / 1e6)
    assert figures["pairs MB"] == pytest.approx(48 * figures["pairs"] / 1e6) and figures["pairs"] > 1000
    terms = sum(value for name, value in figures.items() if name.endswith("MB") and name.split()[0] not in PEAK)
    assert figures["bound MB"] == pytest.approx(terms)
    assert figures["peak MB"] > figures["images MB"] / 2  # they are there, whatever else is


def test_a_wrong_image_has_no_peak(monkeypatch):
    monkeypatch.setattr(peak_memory, "N", 500)
    monkeypatch.setattr(peak_memory, "SIZE", (32, 24))
    monkeypatch.setattr(peak_memory, "CPU", with_pixel(1.1))
    case = peak_memory.memory_case()
    assert not case.passed and "float64" in case.note


def test_a_large_training_takes_what_was_foreseen(monkeypatch):
    """The case is real, on photographs so small that the program itself takes more."""
    monkeypatch.setattr(large_scene, "SIZE", (640, 480))
    monkeypatch.setattr(large_scene, "N_TRACED", 4)
    monkeypatch.setattr(large_scene, "N_POINTS", 200)
    monkeypatch.setattr(large_scene, "TOLERANCE", 100)
    moderate = large_scene.Large("small", 6, 300, None)
    case = large_scene.large_case(moderate)
    figures = case.figures
    assert case.passed, case
    assert figures["Gaussians"] == 300 and figures["GB if all in memory"] == pytest.approx(6 * 640 * 480 * 3 / 1e9)
    assert figures["foreseen MB"] == pytest.approx(640 * 480 * 52 / 1e6, rel=0.1)
    assert figures["x foreseen"] == pytest.approx(figures["peak MB"] / figures["foreseen MB"])
    assert figures["whole process MB"] > figures["peak MB"] > figures["foreseen MB"] / 2


def test_a_large_training_that_takes_too_much_has_failed(monkeypatch):
    def run(command, **_):
        results = {"foreseen": 100.0, "peak": 121.0, "process": 500.0, "n_gaussians": 5, "note": ""}
        (Path(command[3]) / large_scene.RESULT).write_text(json.dumps(results))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(large_scene, "write_photographs", lambda *_: None)
    monkeypatch.setattr(large_scene.subprocess, "run", run)
    case = large_scene.large_case(large_scene.Large("small", 8, None, 499.0))
    assert not case.passed and "not within 20%" in case.note and "more than 0 kB" in case.note
    monkeypatch.setattr(large_scene, "TOLERANCE", 0.22)
    assert large_scene.large_case(large_scene.Large("small", 8, None, 500.0)).passed


def test_start_is_timed_by_the_command(monkeypatch):
    monkeypatch.setattr(start_time, "WARM_STARTS", 1)
    folders = []
    kernels = os.environ.get("NUMBA_CACHE_DIR", str(_jit.cache_root()))
    start = start_time._start
    # An empty folder would take as long as compiling does; the commands themselves are real.
    monkeypatch.setattr(
        start_time, "_start", lambda scene, run, folder: folders.append(folder) or start(scene, run, Path(kernels))
    )
    cold, warm = start_time.start_cases()
    assert cold.passed and warm.passed, (cold, warm)
    assert folders[0] == folders[1] and folders[0].name == "kernels"
    assert cold.figures["first iteration s"] > 0 and 0 < cold.figures["error of loss"] < BENCH_FLOAT32_LOSS
    monkeypatch.setattr(start_time, "_reference_loss", lambda scene: 0.1)
    assert not any(case.passed for case in start_time.start_cases())


def test_a_start_that_fails_says_why(tmp_path):
    with pytest.raises(InputError, match=r"code 2.*no such folder"):
        start_time._start(tmp_path / "absent", tmp_path / "run", tmp_path / "kernels")
