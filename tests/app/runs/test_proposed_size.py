"""What ``train`` says of large photographs."""

import re

import pytest

from minisplat_ref.app.cli import main
from run_commands import write_room


@pytest.fixture(scope="module")
def large_scene(tmp_path_factory):
    """Five portraits, as many as adaptive needs, of 640 x 960 pixels, the smallest that are remarked on."""
    options = {"n_views": 5, "width": 640, "height": 960, "n_points": 60, "test_every": 0}
    return write_room(tmp_path_factory.mktemp("scenes") / "large", **options)


def proposals(capsys):
    return [line for line in capsys.readouterr().err.splitlines() if "take long" in line]


def test_a_size_is_proposed_with_what_it_saves(large_scene, tmp_path, capsys):
    options = ["--iterations", "2", "--test-every", "0"]
    assert main(["train", str(large_scene), "--out", str(tmp_path / "run"), *options]) == 0
    (line,) = proposals(capsys)
    assert "photographs of 640 x 960 take long: with --downscale 2 they are 320 x 480" in line
    small, large = map(float, re.search(r"takes ([\d.e-]+) s instead of ([\d.e-]+) s", line).groups())
    assert 0 < small < large
    chosen = ["--downscale", "1", "--out", str(tmp_path / "chosen"), *options]
    assert main(["train", str(large_scene), *chosen]) == 0
    assert not proposals(capsys), "whoever names a size has chosen it"
