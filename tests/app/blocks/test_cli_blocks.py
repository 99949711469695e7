"""``train --blocks`` end to end: the folder, the merge, every phase killed and continued, workers, refusals."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from minisplat_ref.app.blocks import train as train_module
from minisplat_ref.app.blocks.merge import merge
from minisplat_ref.app.blocks.plan import load_block_training, load_plan, too_large
from minisplat_ref.app.cli import main, train_blocks
from minisplat_ref.app.runs import checkpoints, cluster, continued_part
from minisplat_ref.app.runs.continued_part import continue_part, find_beginning
from minisplat_ref.app.runs.progress import read_log
from minisplat_ref.app.runs.scene_part import read_region
from minisplat_ref.app.runs.settings import configure_recipe, load, load_photographs
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.io import load_ply
from minisplat_ref.io.frames import return_points
from minisplat_ref.reference.compositing import composite_all_pairs
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.pace import Pace
from run_commands import contents, in_process, read_json, refused, write_room  # noqa: F401  (a fixture)
from scenes import activated, as_dtype

SCENE = {"n_views": 8, "width": 32, "height": 24, "n_points": 120, "test_every": 4}
OPTIONS = ["--recipe", "3dgs-accel", "--iterations", "16", "--test-every", "4", "--seed", "3"]
BLOCKS = ["--blocks", "2x1"]
FILES = ("plan.json", "plan.png", "point_cloud.ply", "blocks/0-0.npz", "blocks/1-0/point_cloud.ply")


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SCENE)


@pytest.fixture(scope="module")
def finished(scene_folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("blocks") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train_module, "train_here", in_process)
        assert begin(scene_folder, out) == 0
    return out


def begin(scene_folder, out, *options):
    return main(["train", str(scene_folder), *OPTIONS, *BLOCKS, "--out", str(out), *options])


def same_files(one, other):
    return [name for name in FILES if (one / name).read_bytes() != (other / name).read_bytes()] == []


def test_the_folder_is_a_run_with_its_plan(finished, capsys):
    plan = read_json(finished / "plan.json")
    assert plan["grid"] == [2, 1] and plan["coarse_iterations"] == 4
    assert [block["name"] for block in plan["blocks"]] == ["0-0", "1-0"]
    assert sum(block["cameras"] for block in plan["blocks"]) == 8
    # Of 16 iterations of 8 photographs the last 3 are the merged model's, and the coarse training has done a quarter.
    for block in plan["blocks"]:
        assert block["iterations"] == round(13 * block["photographs"] / 8)
        assert block["done_by_coarse"] == round(block["iterations"] / 4)
        run = read_json(finished / "blocks" / block["name"] / "metrics.json")
        assert run["iterations"] == block["iterations"]
    of_blocks = sum(block["iterations"] - block["done_by_coarse"] for block in plan["blocks"])
    assert plan["joint_iterations"] == 3 and plan["iterations"] == 4 + of_blocks + 3
    metrics = read_json(finished / "metrics.json")
    assert metrics["iterations"] == 16 and len(metrics["per_view"]) == 3
    assert metrics["train_seconds"] > 0
    assert "Trained in blocks" in (finished / "report.html").read_text()
    assert main(["eval", str(finished), "--out", str(finished.parent / "eval")]) == 0
    assert main(["info", str(finished)]) == 0
    assert "16 iterations" in capsys.readouterr().out


def test_the_whole_is_of_the_cores_and_its_last_iterations_are_joint(finished):
    """Gaussians, moments and statistics are those of the blocks; three iterations of 16 are left, for all of them."""
    training, plan = load_block_training(finished), load_plan(finished)
    state, left_out = merge(training, plan, load_photographs(training.settings))
    assert (state.step, state.adam.step, left_out) == (13, 13, [])
    blocks = []
    for planned in plan.blocks:
        folder = training.run_folder_for(planned.block.name)
        block = checkpoints.load(folder, load(folder))
        xy = plan.plane.coordinates(return_points(block.gaussians.means, block.frame))
        low, high = planned.block.core
        rows = (xy[:, 0] >= low[0]) & (xy[:, 0] < high[0])
        assert 0 < rows.sum() < len(rows) and block.adam.second.means[rows].any() and block.stats
        blocks.append((block, rows))
    for part in (
        lambda s: s.gaussians,
        lambda s: s.adam.first,
        lambda s: s.adam.second,
        lambda s: s.stats.values(),
    ):
        of_blocks = zip(*(tuple(field[rows] for field in part(block)) for block, rows in blocks), strict=True)
        for merged, fields in zip(part(state), of_blocks, strict=True):
            np.testing.assert_array_equal(merged, np.concatenate(fields))
    end = load_ply(finished / "point_cloud.ply")
    assert len(end.means) == n_rows(state.gaussians)
    assert 0 < np.abs(end.means - return_points(state.gaussians.means, state.frame)).max()
    records = {record["step"]: record for record in read_log(finished / "log.jsonl")}
    losses = [read_log(training.run_folder_for(p.block.name) / "log.jsonl")[-1]["loss"] for p in plan.blocks]
    assert list(records)[-1] == 16 and records[13]["loss"] == pytest.approx(np.mean(losses))
    assert records[13]["model_mb"] == sum(field.nbytes for field in state.gaussians) / 1e6


def find_first_rows(plan, planned, coarse, scene, least):
    """The coarse model's Gaussians of the region, and those that fill so many pixels of the part by the reference."""
    inside, n = planned.block.region.contains(plan.plane.coordinates(coarse.gaussians.means)), n_rows(coarse.gaussians)
    weights = np.zeros(n)
    for view in scene.train_views:
        splats = REFERENCE.project(*activated(as_dtype(coarse.gaussians, np.float64)), view.camera, GSPLAT_MAIN)
        size = view.camera.width, view.camera.height
        weights += composite_all_pairs(splats, np.eye(n), np.zeros(n), *size, GSPLAT_MAIN)[0][view.mask].sum(axis=0)
    assert (np.abs(weights - least) > 1e-3).all()  # float32 decides as float64 does
    return inside, weights > least


def test_blocks_start_from_the_coarse_model_in_their_regions(finished):
    training, plan = load_block_training(finished), load_plan(finished)
    folder = finished / "blocks" / "coarse"
    coarse = checkpoints.load(folder, load(folder))
    for planned in plan.blocks:
        settings = read_json(finished / "blocks" / planned.block.name / "config.json")["settings"]
        assert settings["init"] == str(finished / "blocks" / "coarse")
        (first, *_) = (finished / "blocks" / planned.block.name / "log.jsonl").read_text().splitlines()
        scene = load_photographs(load(finished / "blocks" / planned.block.name))
        inside, needed = find_first_rows(plan, planned, coarse, scene, 1.0)
        assert json.loads(first)["n_gaussians"] == (inside | needed).sum() > inside.sum()
    assert training.shape == (2, 1)


def test_blocks_continue_the_coarse_training(finished, monkeypatch):
    """Gaussians, moments and statistics are those of its end; rates and dates are those of the whole at that time."""
    training, plan = load_block_training(finished), load_plan(finished)
    coarse = checkpoints.load(training.run_folder_for("coarse"), load(training.run_folder_for("coarse")))
    assert (coarse.step, coarse.adam.step) == (4, 4) and coarse.adam.second.means.any() and coarse.stats
    monkeypatch.setattr(continued_part, "WEIGHT_MIN", 20.0)  # all fill a pixel of these small photographs
    whole = configure_recipe(training.settings)
    for planned in plan.blocks:
        settings = load(training.run_folder_for(planned.block.name))
        scene = load_photographs(settings)
        state = continue_part(settings, read_region(Path(settings.block)), scene)
        inside, needed = find_first_rows(plan, planned, coarse, scene, 20.0)
        assert (inside & ~needed).any() and (needed & ~inside).any()
        rows = inside | needed
        assert not rows.all()
        assert (state.step, state.adam.step, state.view_order) == (planned.n_done, 4, [])
        for ours, theirs in (
            (state.gaussians, coarse.gaussians),
            (state.adam.first, coarse.adam.first),
            (state.adam.second, coarse.adam.second),
            (state.stats.values(), coarse.stats.values()),
        ):
            for field, of_coarse in zip(ours, theirs, strict=True):
                np.testing.assert_array_equal(field, of_coarse[rows])
        part = configure_recipe(settings)
        assert scene.extent == load_photographs(training.settings).extent
        assert part.iterations == planned.iterations
        for of_part, of_whole in ((planned.n_done, 4), (planned.iterations, 16)):
            ours, theirs = part.rates_at(of_part, scene.extent, Pace()), whole.rates_at(of_whole, scene.extent, Pace())
            assert ours == pytest.approx(theirs, rel=0.2)  # dates are rounded to one iteration of seven


def test_a_part_needs_the_run_that_it_continues(scene_folder, finished, tmp_path, refused):
    part = ["--block", finished / "blocks" / "0-0.json", "--whole-iterations", "16"]
    line = refused("train", scene_folder, *OPTIONS, *part, "--out", tmp_path / "out")
    assert "needs its run: give --init" in line


@pytest.mark.parametrize(("n", "n_done", "expected"), [(14, 4, 4), (1200, 600, 300), (1, 4, 0), (3, 16, 2)])
def test_beginning_of_a_part(n, n_done, expected):
    """A quarter of 14 is 3.5, and one iteration at least is left."""
    assert find_beginning(n, 16 if n < 100 else 2400, n_done) == expected


def test_a_block_reads_nothing_of_the_model(scene_folder, finished, tmp_path, monkeypatch):
    """Neither to begin nor to continue: its folder is away while blocks train, with the same bytes in the end."""
    out, model, hidden = tmp_path / "out", scene_folder / "sparse", scene_folder / "hidden"
    trained = []

    def train_without_model(words):
        if "blocks/coarse" in words[words.index("--out") + 1]:
            return in_process(words)
        model.rename(hidden)
        try:
            trained.append(words)
            return in_process(words)
        finally:
            hidden.rename(model)

    monkeypatch.setattr(train_module, "train_here", train_without_model)
    assert begin(scene_folder, out) == 0
    assert len(trained) == 2 and same_files(out, finished)
    model.rename(hidden)
    try:
        assert main(["train", "--resume", str(out / "blocks" / "1-0"), "--iterations", "20"]) == 0
    finally:
        hidden.rename(model)


SLOWLY = [pytest.param(phase, marks=pytest.mark.slow) for phase in ("coarse", "1-0")]


@pytest.mark.parametrize("phase", ["0-0", "plan", "merge", *SLOWLY])
def test_what_was_killed_continues(scene_folder, finished, tmp_path, monkeypatch, phase, capfd):
    """Ctrl-C in a training, an error of the program in the plan and in the merge: the same bytes in the end."""
    out = tmp_path / "out"

    def press_ctrl_c(words):
        if str(words[words.index("--out") + 1]).endswith(phase):
            raise KeyboardInterrupt
        return in_process(words)

    def break_down(*_):
        raise RuntimeError("killed")

    monkeypatch.setattr(train_module, "train_here", press_ctrl_c)
    with monkeypatch.context() as patch:
        if phase == "plan":
            patch.setattr(train_module, "draw_plan", break_down)
        if phase == "merge":
            patch.setattr(train_module, "write_history", break_down)
        if phase in ("plan", "merge"):
            with pytest.raises(RuntimeError, match="killed"):
                begin(scene_folder, out)
        else:
            assert begin(scene_folder, out) == 130
            assert f"interrupted; to continue: minisplat-ref train --resume {out}" in capfd.readouterr().err
    monkeypatch.setattr(train_module, "train_here", in_process)
    assert main(["train", "--resume", str(out)]) == 0
    assert same_files(out, finished)


def test_the_whole_is_trained_further(finished, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    for name, data in contents(finished).items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(data)
    assert main(["train", "--resume", str(out), "--iterations", "18"]) == 0
    assert "going on from iteration 16 to 18" in capsys.readouterr().out
    assert read_json(out / "metrics.json")["iterations"] == 18


def test_adaptive_decides_for_each_block(scene_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(train_module, "train_here", in_process)
    out = tmp_path / "out"
    words = ["train", str(scene_folder), *BLOCKS, "--iterations", "6", "--test-every", "4", "--out", str(out)]
    assert main(words) == 0
    assert read_json(out / "blocks" / "coarse" / "config.json")["settings"]["recipe"] == "3dgs-accel"
    steps = [read_json(out / "blocks" / name / "metrics.json")["iterations"] for name in ("0-0", "1-0")]
    metrics = read_json(out / "metrics.json")
    assert metrics["iterations"] == max(steps) < 6 and metrics["has_ended_early"]


def test_memory_is_foreseen(finished):
    training, plan = load_block_training(finished), load_plan(finished)
    for planned in plan.blocks:  # at most 8 photographs of 32 x 24, and 120 Gaussians of 59 numbers, 4 times
        assert planned.megabytes == 1
    large = plan._replace(blocks=tuple(p._replace(megabytes=m) for p, m in zip(plan.blocks, (300, 500), strict=True)))
    assert too_large(training, large, 2, 800e6) is None and too_large(training, large, 1, 500e6) is None
    sentence = too_large(training, large, 2, 799e6)
    assert sentence.startswith("the 2 largest blocks take 0.8 GB with photographs and first Gaussians, and 0.8 GB are")
    assert "; give fewer --workers, or begin again with a finer grid, such as --blocks 2x2" in sentence
    alone = too_large(training._replace(shape=(1, 2)), large, 1, 1e6)
    assert alone.startswith("the largest block takes 0.5 GB with photographs") and "--workers" not in alone


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2])
def test_workers_give_the_same_bytes(scene_folder, finished, tmp_path, n):
    pytest.importorskip("distributed")
    assert begin(scene_folder, tmp_path / "out", "--workers", str(n)) == 0
    assert same_files(tmp_path / "out", finished)


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["coarse", "1-0"])
def test_a_killed_worker_loses_nothing(scene_folder, finished, tmp_path, monkeypatch, phase):
    pytest.importorskip("distributed")
    out, killed, check = tmp_path / "out", [], cluster._check

    def kill_soon(client, site):
        check(client, site)
        pids = client.run(os.getpid)

        def kill():
            while not (out / "blocks" / phase).exists():
                time.sleep(0.02)
            os.kill(next(iter(pids.values())), signal.SIGKILL)
            killed.append(phase)

        is_planned = (out / "plan.png").exists()  # trainings have a cluster before the plan, and another one after
        if is_planned == (phase != "coarse"):
            threading.Thread(target=kill, daemon=True).start()

    monkeypatch.setattr(cluster, "_check", kill_soon)
    assert begin(scene_folder, out, "--workers", "1") == 0
    assert phase in killed and same_files(out, finished)


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["blocks/coarse", "blocks/0-0", "plan.png", "config.json"])
def test_the_scheduler_is_killed(scene_folder, finished, tmp_path, phase):
    """SIGKILL of the program that has the scheduler and makes the plan and the merge."""
    pytest.importorskip("distributed")
    out = tmp_path / "out"
    words = ["train", str(scene_folder), *OPTIONS, *BLOCKS, "--out", str(out), "--workers", "1"]
    with subprocess.Popen([sys.executable, "-m", "minisplat_ref", *words]) as process:
        while not (out / phase).exists():
            assert process.poll() is None
            time.sleep(0.002)
        process.kill()
    assert not (out / "metrics.json").exists()
    assert main(["train", "--resume", str(out), "--workers", "1"]) == 0
    assert same_files(out, finished)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--init", "x"], "--init does not go with --blocks (blocks start from a coarse model)"),
        (["--max-drop", "0.1"], "--max-drop does not go with --blocks"),
        (["--eval-every", "5"], "--eval-every does not go with --blocks"),
        (["--blocks", "9x1"], "--blocks 9x1 cannot be made, a slab has 8 cameras for 9 blocks"),
        (["--set", "exposure=learned"], "recipe 3dgs-accel also trains"),
        (["--recipe", "lens"], "--blocks needs photographs without distortion"),
    ],
)
def test_what_does_not_go_with_blocks(scene_folder, tmp_path, refused, options, said):
    assert said in refused("train", scene_folder, *OPTIONS, *BLOCKS, "--out", tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()


def test_the_settings_of_another_run_go_with_blocks(finished, refused):
    config = ["--config", finished, "--out", finished, *BLOCKS]
    assert "does not go with --blocks" not in refused("train", *config)  # but the folder is taken
    assert "--minutes does not go with --blocks" in refused("train", *config, "--minutes", "1")


def test_workers_are_for_blocks(scene_folder, tmp_path, refused):
    line = refused("train", scene_folder, *OPTIONS, "--workers", "2", "--out", tmp_path / "out")
    assert "--workers and --cluster train blocks at once" in line


def test_unfinished_blocks_take_no_other_options(scene_folder, tmp_path, monkeypatch, refused):
    def press_ctrl_c(words):
        raise KeyboardInterrupt

    monkeypatch.setattr(train_module, "train_here", press_ctrl_c)
    out = tmp_path / "out"
    assert begin(scene_folder, out) == 130
    assert "already holds a training in blocks" in refused("train", scene_folder, *OPTIONS, "--out", out)
    assert "have not ended: leave out --iterations" in refused("train", "--resume", out, "--iterations", "20")
    (out / "plan.json").write_text('{"grid": [2]}')
    assert "has no grid of two whole numbers" in refused("train", "--resume", out)


def test_a_coarse_training_that_is_refused_leaves_nothing(scene_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(train_module, "train_here", lambda words: 2)
    assert begin(scene_folder, tmp_path / "out") == 2
    assert not (tmp_path / "out").exists()
    assert set(train_blocks.WHOLE_ONLY) >= {"minutes", "budget", "lpips_weights", "preview", "view", "max_bytes"}
