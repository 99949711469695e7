"""Times of blocks on several machines, by hand."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from data_tools import block_times
from data_tools.block_times import Phases, main, read_phases, row_of, time_of_blocks

PHASES = Phases(coarse=10.0, plan=4.0, blocks=(30.0, 50.0, 20.0, 40.0), merge=6.0, n_read=(), n_written=())


@pytest.mark.parametrize(
    ("n_machines", "end"),
    [
        (1, 140.0),
        (2, 90.0),  # 30 and 20 and 40 on one, 50 on the other
        (3, 60.0),  # 20 and 40 on the third
        (4, 50.0),
        (9, 50.0),
    ],
)
def test_blocks_go_to_the_machine_that_is_free_first(n_machines, end):
    assert time_of_blocks(PHASES.blocks, n_machines) == end


def test_rows_by_hand():
    assert row_of(PHASES, 1) == ["1", "10", "4", "140", "6", "160", "1.00", "100%"]
    # 160 / 110; 160 of the 220 seconds of two machines.
    assert row_of(PHASES, 2) == ["2", "10", "4", "90", "6", "110", "1.45", "73%"]


@pytest.mark.parametrize(("is_continued", "n_first", "n_written"), [(True, 50, (530, 640)), (False, 60, (30, 40))])
def test_what_is_read_of_a_run(tmp_path, monkeypatch, is_continued, n_first, n_written):
    """Two blocks: the first shows a.png and b.png, the second b.png; those that continue need checkpoints."""
    run, photographs = tmp_path / "run", tmp_path / "scene" / "images"
    photographs.mkdir(parents=True)
    (photographs / "a.png").write_bytes(bytes(1000))
    (photographs / "b.png").write_bytes(bytes(200))
    sizes = {"coarse/checkpoint.npz": 50, "coarse/point_cloud.ply": 60, "0-0.npz": 7, "1-0.npz": 9}
    sizes |= {"0-0/point_cloud.ply": 30, "1-0/point_cloud.ply": 40}
    sizes |= {"0-0/checkpoint.npz": 500, "1-0/checkpoint.npz": 600}
    for name, size in sizes.items():
        (run / "blocks" / name).parent.mkdir(parents=True, exist_ok=True)
        (run / "blocks" / name).write_bytes(bytes(size))
    ends = {"blocks/coarse/metrics.json": 100, "plan.json": 104, "metrics.json": 321}
    ends |= {"blocks/0-0/metrics.json": 210, "blocks/1-0/metrics.json": 320}
    for seconds, (name, end) in enumerate(ends.items(), 5):
        (run / name).write_text(json.dumps({"train_cpu_seconds": seconds}))
        os.utime(run / name, (end, end))
    parts = {"0-0": [["a", 3, 4], ["b", 3, 4]], "1-0": [["b", 3, 4]]}
    for name, masks in parts.items():
        (run / "blocks" / f"{name}.json").write_text(json.dumps({"masks": masks}))
    blocks = [SimpleNamespace(block=SimpleNamespace(name=name)) for name in parts]
    settings = SimpleNamespace(scene=str(tmp_path / "scene"))
    folders = {"run_folder_for": lambda name: run / "blocks" / name}
    training = SimpleNamespace(settings=settings, is_continued=is_continued, **folders)
    monkeypatch.setattr(block_times, "load_plan", lambda folder: SimpleNamespace(blocks=blocks))
    monkeypatch.setattr(block_times, "load_block_training", lambda folder: training)
    in_parts = [(run / "blocks" / f"{name}.json").stat().st_size for name in parts]
    assert read_phases(run) == Phases(
        coarse=5.0,
        plan=4.0,
        blocks=(8.0, 9.0),
        merge=1.0,
        n_read=(in_parts[0] + 7 + n_first + 1200, in_parts[1] + 9 + n_first + 200),
        n_written=n_written,
    )


@pytest.mark.parametrize(
    ("words", "reason"), [([], "no training in blocks that has ended"), (["--machines", "1,0"], "0")]
)
def test_bad_input_is_one_line(tmp_path, capsys, words, reason):
    assert main([str(tmp_path), *words]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("block_times: error: ") and reason in line


def test_the_modules_first_line_is_its_help(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    assert Path(block_times.__file__).read_text().split('"""')[1].split("\n")[0][:40] in capsys.readouterr().out
