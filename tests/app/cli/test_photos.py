"""``photos``: from photographs to a report and a film, what it prints, and that it continues."""

import base64
import json
import re
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from minisplat_ref.app.cli import main
from minisplat_ref.app.cli import photos as photos_command
from minisplat_ref.app.runs import next_steps
from minisplat_ref.app.runs.proposed_size import comfortable_factor
from minisplat_ref.app.runs.settings import load_up
from minisplat_ref.errors import InputError
from minisplat_ref.io import write_image
from minisplat_ref.io.upright import read_up
from minisplat_ref.methods.adaptive import numbers
from run_commands import interrupt_at, write_room
from textured_world import HEIGHT, WIDTH, take_photographs, write_photographs

SCENE = {"n_views": 12, "width": 48, "height": 36, "n_points": 100, "test_every": 8}


@pytest.fixture
def out(tmp_path):
    """A folder in which the cameras have been found."""
    write_room(tmp_path / "out" / "scene", **SCENE)
    (tmp_path / "photos").mkdir()
    return tmp_path / "out"


@pytest.fixture
def asked(monkeypatch):
    """The commands that are run; trainings are of 30 iterations, however long they may take."""
    commands, real = [], photos_command.do

    def shortened(*words):
        commands.append(words)
        return real(*words, *(("--iterations", "30") if words[0] == "train" and "--resume" not in words else ()))

    monkeypatch.setattr(photos_command, "do", shortened)
    return commands


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
    page, film, report, live, surface, smaller, *_ = printed.rpartition("\n\n")[2].splitlines()
    assert page == f"to look at, in any browser: open {out / 'scene.html'}", "what there is to see comes first"
    assert film == f"a film: open {out / 'film.gif'}" and report.endswith(f": open {out / 'run' / 'report.html'}")
    assert live.endswith(f" view {out / 'run'}") and surface.endswith(f" mesh {out / 'run'} --out {out / 'mesh.ply'}")
    assert smaller.startswith("make it smaller: ") and " simplify " in smaller
    check_report_shows_the_scene(out / "run" / "report.html", out)
    assert "<title>out</title>" in (out / "scene.html").read_text(), "the page has the name of the folder, too"


def check_report_shows_the_scene(report, folder):
    """It is named after the folder, links to the page, shows the film, and recommends what is left to do."""
    text = report.read_text(encoding="utf-8")
    assert f"<h1>{folder.name}</h1>" in text
    (link,) = re.findall(r'<a href="(.*?)">', text)
    assert (report.parent / link).resolve() == (folder / "scene.html").resolve()
    (film,) = re.findall(r'src="data:image/webp;base64,(.*?)"', text)
    with Image.open(BytesIO(base64.b64decode(film))) as shown, Image.open(folder / "film.gif") as written:
        assert 80 < shown.n_frames <= 96, "equal ones are kept once"
        assert shown.size == written.size
    following = text.partition("What to try next")[2]
    assert " view " in following and " photos PHOTOS" in following and "scene.html" not in following


def test_extras_are_named_where_they_are_missing(out, asked, capsys, monkeypatch):
    assert photos(out) == 0
    capsys.readouterr()
    missing = set()
    monkeypatch.setattr(next_steps, "find_spec", lambda package: None if package in missing else package)
    assert photos(out) == 0
    assert "pip install" not in capsys.readouterr().out
    missing |= {"viser", "skimage"}
    assert photos(out) == 0
    live, surface = [line for line in capsys.readouterr().out.splitlines() if "pip install" in line]
    assert "'minisplat_ref[viewer]'): " in live and " view " in live
    assert "'minisplat_ref[meshes]'): " in surface and " mesh " in surface


def test_what_is_there_is_not_done_again(out, asked, capsys, monkeypatch):
    """After an interruption of the training it continues there; at the end nothing is left to do."""
    with monkeypatch.context() as patched:
        interrupt_at(7, patched)
        assert photos(out) == 130
    assert steps_of(capsys.readouterr().out) == ["train"]
    assert photos(out) == 0
    assert steps_of(capsys.readouterr().out) == ["train", "convert", "render"]
    (out / "film.gif").unlink()
    assert photos(out) == 0
    assert steps_of(capsys.readouterr().out) == ["render"]
    assert photos(out) == 0
    assert steps_of(capsys.readouterr().out) == []


def test_another_up_makes_page_and_film_again_and_is_recorded(out, asked, capsys):
    assert photos(out) == 0
    page, film = (out / "scene.html").read_bytes(), (out / "film.gif").read_bytes()
    capsys.readouterr()
    assert photos(out, "--up", "0,0,1") == 0
    assert steps_of(capsys.readouterr().out) == ["convert", "render"]
    assert (out / "scene.html").read_bytes() != page and (out / "film.gif").read_bytes() != film
    for recorded in (load_up(out / "run"), read_up(out / "scene")):
        np.testing.assert_array_equal(recorded.direction, [0, 0, 1])
    for same in ((), ("--up", "0,0,2")):
        assert photos(out, *same) == 0
        assert steps_of(capsys.readouterr().out) == []
    page = (out / "scene.html").read_bytes()
    assert photos(out, "--up", "nobody") == 2
    assert "--up nobody is neither X,Y,Z nor one of the photographs" in capsys.readouterr().err
    assert (out / "scene.html").read_bytes() == page and (load_up(out / "run").direction == [0, 0, 1]).all()


def test_a_folder_that_is_not_there(tmp_path, capsys):
    assert photos(tmp_path / "out") == 2
    assert "is no folder: give the folder of your photographs" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "folder"), [("trip.2024", "trip.2024"), ("walk.mp4", "walk")])
def test_results_are_named_after_the_folder_or_the_video(name, folder, tmp_path, monkeypatch):
    """The point in a folder's name begins no suffix."""
    monkeypatch.chdir(tmp_path)
    if name.endswith(".mp4"):
        (tmp_path / name).write_bytes(b"")
    else:
        (tmp_path / name).mkdir()
        write_image(tmp_path / name / "a.png", np.zeros((30, 40, 3), np.uint8))
    asked = []

    def refuse(*words):
        asked.append(words)
        raise InputError("no cameras")

    monkeypatch.setattr(photos_command, "do", refuse)
    assert main(["photos", name, "--downscale", "1"]) == 2
    assert asked[0][:4] == ("sfm", Path(name), "--out", Path("splats") / folder / "scene")


@pytest.mark.parametrize(
    ("size", "factor"),
    [((640, 480), 1), ((959, 500), 1), ((960, 500), 2), ((700, 1280), 2), ((1281, 9), 3), ((4000, 3000), 7)],
)
def test_a_size_that_trains_in_minutes(size, factor):
    """From 960 pixels on, the smallest factor after which the longer side has at most 640."""
    assert comfortable_factor(*size) == factor


@pytest.mark.parametrize(
    ("n_views", "options", "n_needed", "recipe"),
    [(6, (), 3, "adaptive"), (5, ("0",), 3, "adaptive"), (3, ("0",), 3, "adaptive"), (3, ("0",), 4, "3dgs-accel")],
)
def test_few_photographs_are_all_trained_on(tmp_path, asked, capsys, monkeypatch, n_views, options, n_needed, recipe):
    """Of six one is held out, of five none; if adaptive needed four, three would be trained on by another recipe."""
    monkeypatch.setattr(numbers, "TRAIN_VIEWS_MIN", n_needed)
    write_room(tmp_path / "out" / "scene", **(SCENE | {"n_views": n_views - 1}))  # and one more is held out
    (tmp_path / "photos").mkdir()
    assert photos(tmp_path / "out") == 0
    held_out = re.findall("--test-every ([0-9]+)", " ".join(map(str, asked[0])))
    assert asked[0][0] == "train" and tuple(held_out) == options
    used = json.loads((tmp_path / "out" / "run" / "config.json").read_text())["recipe"]
    assert used["name"] == recipe
    said = f"{n_views} photographs: all are trained on, and none is left to measure"
    assert (said in capsys.readouterr().err) == bool(options)
    assert (tmp_path / "out" / "film.gif").exists()
