"""``compare --resume``: what is finished is kept, what was cut off continues, what is something else is refused."""

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.app.comparison import runs as runs_module
from minisplat_ref.app.comparison.plan import Plan, load_plan, save_plan
from minisplat_ref.app.comparison.runs import make_settings, statuses
from minisplat_ref.app.runs.progress import Progress, read_log
from minisplat_ref.app.runs.settings import load as load_settings
from minisplat_ref.errors import InputError
from run_commands import in_process_silently, write_room

SCENE = {"n_views": 8, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
ITERATIONS = 12
OPTIONS = ["--recipes", "3dgs,3dgs-accel", "--iterations", str(ITERATIONS), "--test-every", "4", "--eval-every", "3"]
FIRST, SECOND = "3dgs-seed0", "3dgs-accel-seed0"


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SCENE)


@pytest.fixture(scope="module")
def stopped(scene_folder, tmp_path_factory):
    """A comparison that Ctrl-C ended after its first training, before its second."""
    folder = tmp_path_factory.mktemp("comparisons") / "stopped"

    def press_ctrl_c(words):
        if SECOND in words[-1]:
            raise KeyboardInterrupt
        return in_process_silently(words)

    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(io.StringIO()) as errors:
        patch.setattr(runs_module, "train_here", press_ctrl_c)
        assert main(["compare", str(scene_folder), *OPTIONS, "--out", str(folder)]) == 130
    lines = [line for line in errors.getvalue().splitlines() if "interrupted" in line]
    assert lines == [f"minisplat-ref: interrupted; to continue: minisplat-ref compare --resume {folder}"]
    assert {path.name for path in folder.iterdir()} == {"plan.json", FIRST}
    return folder


@pytest.fixture
def folder(stopped, tmp_path):
    return Path(shutil.copytree(stopped, tmp_path / "compared"))


def resume(folder):
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setattr(runs_module, "train_here", in_process_silently)
        assert main(["compare", "--resume", str(folder)]) == 0
    return [line for line in printed.getvalue().splitlines() if line.startswith("run ")]


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def steps(run):
    return [record["step"] for record in read_log(run / "curve.jsonl")]


def train_second(scene_folder, folder, *options):
    """Train what would be the second run, by hand."""
    command = ["train", str(scene_folder), "--recipe", "3dgs-accel", "--iterations", str(ITERATIONS)]
    return main([*command, "--test-every", "4", "--eval-every", "3", *options, "--out", str(folder / SECOND)])


def test_finished_runs_are_kept(folder, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    before = contents(folder / FIRST)
    headings = resume(Path("compared"))  # from elsewhere than where it was begun
    assert headings == [
        "run 1 of 2: 3dgs, seed 0, 12 iterations: finished, kept",
        "run 2 of 2: 3dgs-accel, seed 0, 12 iterations: started",
    ]
    assert contents(folder / FIRST) == before
    content = json.loads((folder / "compare.json").read_text())
    assert [recipe["runs"][0]["seed"] for recipe in content["recipes"]] == [0, 0]
    assert content["settings"]["eval_every"] == [3, 3]

    before = contents(folder / SECOND)
    (folder / "report.html").unlink()
    assert all(heading.endswith("finished, kept") for heading in resume(folder))
    assert contents(folder / SECOND) == before and (folder / "report.html").exists()


def test_a_run_that_was_cut_off_continues(scene_folder, folder, monkeypatch):
    """Its curve has a point where it was interrupted, which a run in one piece has not."""
    report_step = Progress.__call__

    def press_ctrl_c(progress, report):
        report_step(progress, report)
        if report.step == 7:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__call__", press_ctrl_c)
        assert train_second(scene_folder, folder) == 130
    assert resume(folder)[1] == "run 2 of 2: 3dgs-accel, seed 0, 12 iterations: continued from its checkpoint"
    assert steps(folder / SECOND) == [3, 6, 7, 9, 12]
    assert (folder / "compare.json").exists()


def test_a_run_that_was_killed_while_it_was_measured(scene_folder, folder):
    """All iterations are done and in the checkpoint, which is not to be trained again."""
    assert train_second(scene_folder, folder) == 0
    checkpoint = (folder / SECOND / "checkpoint.npz").read_bytes()
    (folder / SECOND / "metrics.json").unlink()
    assert resume(folder)[1].endswith("continued from its checkpoint")
    assert (folder / SECOND / "checkpoint.npz").read_bytes() == checkpoint
    assert json.loads((folder / SECOND / "metrics.json").read_text())["iterations"] == ITERATIONS


def test_a_run_without_a_checkpoint_is_started_again(scene_folder, folder):
    assert train_second(scene_folder, folder) == 0
    for name in ("metrics.json", "checkpoint.npz", "checkpoint-previous.npz"):
        (folder / SECOND / name).unlink()
    (folder / SECOND / "of_before").touch()
    assert resume(folder)[1].endswith("has no checkpoint, started again")
    assert steps(folder / SECOND) == [3, 6, 9, 12] and not (folder / SECOND / "of_before").exists()


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        (["--seed", "1"], "seed is 1 and not 0"),
        (["--set", "exposure=learned"], "set is {'exposure': 'learned'} and not {}"),
    ],
)
def test_runs_of_other_settings_are_refused(scene_folder, folder, capfd, options, difference):
    """Finished ones as well, and before anything is trained."""
    assert train_second(scene_folder, folder, *options) == 0
    before = contents(folder)
    capfd.readouterr()
    assert main(["compare", "--resume", str(folder)]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert f"{folder / SECOND} holds a run of other settings, {difference}" in line
    assert contents(folder) == before


def test_something_else_in_the_place_of_a_run(folder):
    (folder / SECOND).mkdir()
    assert statuses(load_plan(folder)) == ["finished", "new"]  # train was killed before it wrote anything
    (folder / SECOND / "notes.txt").touch()
    with pytest.raises(InputError, match="is not an empty folder"):
        statuses(load_plan(folder))


def test_a_new_comparison_in_its_place_is_refused(scene_folder, folder, capfd):
    assert main(["compare", str(scene_folder), *OPTIONS, "--out", str(folder)]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert f"{folder} already holds a comparison" in line and f"compare --resume {folder}" in line


def test_the_plan_comes_back(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = {"budget": 70, "simplify": None, "scene_type": "outdoor"}
    plan = Plan(Path("scene"), Path("out"), ("a", "b"), (300, 100), (0, 5), 2, 4, None, **options)
    Path("out").mkdir()
    save_plan(plan)
    assert load_plan(Path("out")) == plan._replace(scene=tmp_path / "scene")


def test_settings_are_those_that_train_writes(stopped):
    """Of a run that compare has trained, by the whole of config.json."""
    plan = load_plan(stopped)
    assert load_settings(stopped / FIRST) == make_settings(plan, plan.runs[0])


def test_killed_with_its_training(scene_folder, tmp_path):
    """The whole program dies in its second training; a new one continues with what is there."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "minisplat_ref", "compare", str(scene_folder), *OPTIONS, "--out", str(out)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
    ) as process:
        for line in process.stdout:
            if line.startswith(b"run 2 of 2"):
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    first, second = resume(out)
    assert first.endswith("finished, kept") and not second.endswith("finished, kept")
    assert steps(out / SECOND) == [3, 6, 9, 12] and (out / "report.html").exists()


def test_sigterm_is_handed_on_to_the_training(scene_folder, tmp_path):
    """`docker stop` tells the first process only; its training has to save, too, and not to go on alone."""
    out = tmp_path / "out"
    options = ["--recipes", "3dgs-accel", "--iterations", "20000", "--test-every", "4", "--eval-every", "20000"]
    command = [sys.executable, "-m", "minisplat_ref", "compare", str(scene_folder), *options, "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            if line.startswith("run 1 of 1"):
                break
        while not (out / SECOND / "checkpoint.npz").exists():  # of the start
            assert process.poll() is None
            time.sleep(0.05)
        process.terminate()
        _, errors = process.communicate()  # ends when nobody, the training included, holds the pipe
    assert process.returncode == 130
    assert "all saved" in errors and errors.count("compare --resume") == 1
    assert statuses(load_plan(out)) == ["cut off"]
