"""A training that is killed continues with the same bytes: five points of ``python -m data_tools.kill_points``."""

import json
import shutil

import pytest

from data_tools.kill_points.points import POINTS
from data_tools.kill_points.survival import differences, kill_and_go_on, limit_files, prepare

SAMPLE = {
    "evaluation: half a line of curve.jsonl": "iteration 179",
    "training: half of an Adam step": "iteration 0",
    "event: population new, moments old": "iteration 0",
    "checkpoint: the one before kept": "iteration 59, 1 unfinished",
    "evaluation: first image there": "iteration 240, 1 unfinished",
}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return prepare(tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.parametrize("point", SAMPLE)
def test_killed_trainings_go_on(undisturbed, tmp_path, point):
    assert kill_and_go_on(point, *undisturbed, tmp_path / "run") == (point, SAMPLE[point], "resumed, same bytes", True)


def test_a_limit_to_the_size_of_files(undisturbed, tmp_path):
    row = limit_files(*undisturbed, tmp_path / "run")
    assert row.is_good and "cannot be written (File too large)" in row.left, row


def test_there_are_thirty_points():
    assert len(POINTS) >= 30


@pytest.mark.parametrize("name", ["point_cloud.ply", "metrics.json", "log.jsonl", "curve.jsonl", "renders"])
def test_differences_are_seen(undisturbed, tmp_path, name):
    """What compares must notice: each kind of file, changed a little."""
    _, whole = undisturbed
    other = shutil.copytree(whole, tmp_path / "other")
    assert differences(whole, other) == ""
    path = next((other / name).iterdir()) if name == "renders" else other / name
    if name == "metrics.json":
        path.write_text(json.dumps({**json.loads(path.read_text()), "iterations": 1}))
    else:
        path.write_bytes(
            path.read_bytes().replace(b'"n_gaussians": ', b'"n_gaussians": 1') + b"\n" * (".json" not in name)
        )
    assert differences(whole, other) == f"other {name}"
    (other / "more").mkdir()
    assert differences(whole, other).startswith("more in one only, ")
