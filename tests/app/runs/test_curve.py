"""``train --eval-every``: which records there are; that measuring takes no training time and changes nothing."""

import json
import shutil
import signal
import time

import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.app.runs import curve
from minisplat_ref.app.runs import progress as progress_module
from minisplat_ref.app.runs import run as training
from minisplat_ref.app.runs.progress import Progress, read_log
from minisplat_ref.datasets.synthetic.surface import surface_distance, true_surface
from minisplat_ref.io import load_ply, load_scene
from minisplat_ref.metrics import Evaluation
from run_commands import write_room

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
ITERATIONS, EVAL_EVERY = 20, 8
MEASURED = [8, 16, 20]


def train(scene_folder, out, *options):
    options = ["--iterations", str(ITERATIONS), "--test-every", "4", *options]
    return main(["train", str(scene_folder), *options, "--out", str(out)])


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SCENE)


@pytest.fixture(scope="module")
def measured(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "measured"
    assert train(scene_folder, folder, "--eval-every", str(EVAL_EVERY)) == 0
    return folder


def qualities(folder):
    """Records without their times, which no two runs share."""
    return [{**record, "seconds": None, "cpu_seconds": None} for record in read_log(folder / "curve.jsonl")]


def chamfer_of(run_folder, scene_folder):
    surface = true_surface(scene_folder, load_scene(scene_folder, test_every=4))
    return surface_distance(load_ply(run_folder / "point_cloud.ply"), surface)


def test_records(measured, scene_folder):
    records = read_log(measured / "curve.jsonl")
    assert [record["step"] for record in records] == MEASURED
    metrics = json.loads((measured / "metrics.json").read_text())
    of_the_end = {name: metrics[name] for name in ("psnr", "ssim", "n_gaussians")}
    assert records[-1] == {
        "step": ITERATIONS,
        "seconds": metrics["train_seconds"],
        "cpu_seconds": metrics["train_cpu_seconds"],
        **of_the_end,
        "chamfer": chamfer_of(measured, scene_folder),
    }
    assert len({record["chamfer"] for record in records}) == len(MEASURED)
    assert 0 < records[0]["seconds"] < records[1]["seconds"] < records[2]["seconds"]
    assert 0 < records[0]["cpu_seconds"] < records[1]["cpu_seconds"] < records[2]["cpu_seconds"]
    assert records[0]["psnr"] != records[1]["psnr"]


def test_measuring_does_not_change_the_result(measured, scene_folder, tmp_path):
    assert train(scene_folder, tmp_path / "run") == 0
    assert not (tmp_path / "run" / "curve.jsonl").exists()
    assert (tmp_path / "run" / "point_cloud.ply").read_bytes() == (measured / "point_cloud.ply").read_bytes()


def test_interrupted_and_resumed(measured, scene_folder, tmp_path, monkeypatch):
    report_step = Progress.__call__

    def press_ctrl_c(progress, report):
        report_step(progress, report)
        if report.step == 12:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__call__", press_ctrl_c)
        assert train(scene_folder, tmp_path / "run", "--eval-every", str(EVAL_EVERY)) == 130
    assert [record["step"] for record in qualities(tmp_path / "run")] == [8, 12]
    assert main(["train", "--resume", str(tmp_path / "run")]) == 0
    resumed = qualities(tmp_path / "run")
    assert [record["step"] for record in resumed] == [8, 12, 16, 20]
    assert [record for record in resumed if record["step"] != 12] == qualities(measured)


def test_the_clock_stands_while_views_are_measured(scene_folder, tmp_path, monkeypatch):
    """Each measurement takes 1000 seconds by a clock that is put forward."""
    real_clock, real_evaluate, put_forward = time.perf_counter, training.evaluate, []

    def slow_evaluate(*args):
        put_forward.append(1000.0)
        return real_evaluate(*args)

    monkeypatch.setattr(progress_module.time, "perf_counter", lambda: real_clock() + sum(put_forward))
    monkeypatch.setattr(training, "evaluate", slow_evaluate)
    assert train(scene_folder, tmp_path / "run", "--eval-every", "5") == 0
    assert len(put_forward) == 3
    for name in ("curve.jsonl", "log.jsonl"):
        assert read_log(tmp_path / "run" / name)[-1]["seconds"] < 1000


def test_no_distance_where_the_surface_is_not_known(scene_folder, tmp_path):
    folder = tmp_path / "photographs"
    shutil.copytree(scene_folder, folder, ignore=shutil.ignore_patterns("depths"))
    assert train(folder, tmp_path / "run", "--eval-every", str(EVAL_EVERY)) == 0
    assert all("chamfer" not in record for record in read_log(tmp_path / "run" / "curve.jsonl"))


def test_records_after_the_checkpoint_are_dropped(tmp_path):
    path = tmp_path / "curve.jsonl"
    curve.keep_until(path, 0)
    for step in (5, 10, 10, 15):
        curve.append(path, step, 0.5 * step, Evaluation(20.0, 0.5, None, None, []), 7)
    assert [record["step"] for record in read_log(path)] == [5, 10, 15]
    curve.keep_until(path, 12)
    assert [record["step"] for record in read_log(path)] == [5, 10]


def test_equal_images_have_a_psnr_that_json_can_hold(tmp_path):
    path = tmp_path / "curve.jsonl"
    curve.append(path, 1, 0.5, Evaluation(float("inf"), 1.0, None, None, []), 7)
    assert read_log(path)[0]["psnr"] == 100.0
