"""``photos``: from photographs to a report and a film, what it prints, and that it continues."""

import re
from pathlib import Path

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.app.cli import photos as photos_command
from minisplat_ref.app.runs.proposed_size import comfortable_factor
from run_commands import interrupt_at, write_room
from textured_world import HEIGHT, WIDTH, take_photographs, write_photographs

SCENE = {"n_views": 12, "width": 48, "height": 36, "n_points": 100, "test_every": 8}


@pytest.fixture
def out(tmp_path):
    """A folder in which the cameras have been found."""
    write_room(tmp_path / "out" / "scene", **SCENE)
    (tmp_path / "photos").mkdir()
    return tmp_path / "out"


def photos(out, *options):
    return main(["photos", str(out.parent / "photos"), "--out", str(out), *options])


def steps_of(text):
    """Return the commands that were printed and run, however the program was started."""
    programs = r"\$ .*?minisplat[_-]ref (\S+)"
    return [match[1] for match in map(re.compile(programs).match, text.splitlines()) if match]


def test_from_photographs_to_a_film(tmp_path, capsys):
    shots = take_photographs(np.random.default_rng(3), (1.1 * WIDTH,) * 9)
    write_photographs(tmp_path / "photos", shots, (24.0,) * 9)
    out = tmp_path / "out"
    assert photos(out, "--minutes", "0.1", "--downscale", "4") == 0
    printed = capsys.readouterr().out
    assert steps_of(printed) == ["sfm", "train", "convert", "render"]
    assert ": 9 of 9 photographs (100%)" in printed and f" of {WIDTH // 4} x {HEIGHT // 4}," in printed
    assert all((out / name).exists() for name in ("scene/sparse/0", "run/report.html", "run/metrics.json", "film.gif"))
    page, report, live, smaller = printed.splitlines()[-4:]
    assert page == f"the scene, in any browser: open {out / 'scene.html'}" and (out / "scene.html").exists()
    assert report.endswith(f": open {out / 'run' / 'report.html'}")
    assert live.endswith(f" view {out / 'run'}") and "pip install 'minisplat_ref[viewer]'" in live
    assert smaller.startswith("make it smaller: ") and " simplify " in smaller


def test_what_is_there_is_not_done_again(out, capsys, monkeypatch):
    """After an interruption of the training it continues there; at the end nothing is left to do."""
    with monkeypatch.context() as patched:
        interrupt_at(7, patched)
        assert photos(out, "--minutes", "0.1") == 130
    assert steps_of(capsys.readouterr().out) == ["train"]
    assert photos(out) == 0
    assert steps_of(capsys.readouterr().out) == ["train", "convert", "render"]
    (out / "film.gif").unlink()
    assert photos(out) == 0
    assert steps_of(capsys.readouterr().out) == ["render"]
    assert photos(out) == 0
    assert steps_of(capsys.readouterr().out) == []


def test_a_folder_that_is_not_there(tmp_path, capsys):
    assert photos(tmp_path / "out") == 2
    assert "is no folder: give the folder of your photographs" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "folder"), [("trip.2024", "trip.2024"), ("walk.mp4", "walk")])
def test_results_are_named_after_the_folder_or_the_video(name, folder, tmp_path, monkeypatch):
    """The point in a folder's name begins no suffix."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_bytes(b"") if name.endswith(".mp4") else (tmp_path / name).mkdir()
    asked = []
    monkeypatch.setattr(photos_command, "do", lambda *words: asked.append(words) or 1)
    assert main(["photos", name, "--downscale", "1"]) == 1
    assert asked[0][:4] == ("sfm", Path(name), "--out", Path("splats") / folder / "scene")


@pytest.mark.parametrize(
    ("size", "factor"),
    [((640, 480), 1), ((959, 500), 1), ((960, 500), 2), ((700, 1280), 2), ((1281, 9), 3), ((4000, 3000), 7)],
)
def test_a_size_that_trains_in_minutes(size, factor):
    """From 960 pixels on, the smallest factor after which the longer side has at most 640."""
    assert comfortable_factor(*size) == factor
