"""What a newcomer meets: the version, the preview, how long it takes, what `info` says, films from the command line."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

import minisplat_ref
from minisplat_ref.app.cli import main
from minisplat_ref.app.reports.images import GAP
from minisplat_ref.app.runs.notices import describe_sizes
from minisplat_ref.app.runs.preview import FILE
from minisplat_ref.io import load_ply, read_image
from run_commands import write_room

WIDTH, HEIGHT = 32, 24
SETTINGS = {"n_views": 6, "width": WIDTH, "height": HEIGHT, "n_points": 60, "test_every": 4}


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SETTINGS)


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "previewed"
    assert main(["train", str(scene_folder), *OPTIONS, "--out", str(folder), "--preview"]) == 0
    return folder


OPTIONS = ["--recipe", "3dgs-accel", "--iterations", "10", "--test-every", "4"]


def test_version(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert caught.value.code == 0
    assert capsys.readouterr().out == f"minisplat-ref {minisplat_ref.__version__}\n"


def test_preview_is_the_last_render_and_changes_nothing(run_folder, scene_folder, tmp_path):
    shown = read_image(run_folder / FILE)
    assert shown.shape == (HEIGHT, 3 * WIDTH + 2 * GAP, 3)
    first = sorted((run_folder / "renders").iterdir())[0]
    np.testing.assert_array_equal(shown, read_image(first))
    assert main(["train", str(scene_folder), *OPTIONS, "--out", str(tmp_path / "plain")]) == 0
    assert not (tmp_path / "plain" / FILE).exists()
    for field, plain in zip(
        *(load_ply(path / "point_cloud.ply") for path in (run_folder, tmp_path / "plain")), strict=True
    ):
        np.testing.assert_array_equal(field, plain)


def test_preview_of_a_run_that_goes_on(run_folder, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    (folder / FILE).unlink()
    assert main(["train", "--resume", str(folder), "--iterations", "15", "--preview"]) == 0
    first = sorted((folder / "renders").iterdir())[0]
    np.testing.assert_array_equal(read_image(folder / FILE), read_image(first))


def test_info_has_no_empty_rows(run_folder, capsys):
    assert main(["info", str(run_folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = {line.split("  ")[0] for line in lines}
    assert {"recipe", "psnr", "Gaussians"} <= names and not {"lpips", "budget", "lpips reason", "minutes"} & names
    assert not any(line.endswith((" None", " {}", " False")) for line in lines)
    config = json.loads((run_folder / "config.json").read_text())
    assert config["settings"]["budget"] is None  # so that there was something to leave out


@pytest.mark.parametrize(
    ("sizes", "text"),
    [
        (4 * [(640, 480)], "640 x 480"),
        (3 * [(480, 640)] + [(640, 480)], "640 x 480 (1 of them) and 480 x 640 (3 of them)"),
        ([(9, 8), (8, 9), (7, 7), (10, 9)], "4 sizes from 7 x 7 to 10 x 9 (3 landscape, 1 portrait)"),
    ],
)
def test_mixed_sizes_are_told(sizes, text):
    assert describe_sizes(sizes) == text


def test_a_white_background_is_kept(scene_folder, tmp_path):
    folder = tmp_path / "white"
    assert main(["train", str(scene_folder), *OPTIONS, "--out", str(folder), "--background", "255,255,255"]) == 0
    config = json.loads((folder / "config.json").read_text())
    assert config["background"] == config["settings"]["background"] == [1, 1, 1]
    assert main(["eval", str(folder)]) == 0
    config["settings"]["background"] = [1, "white", 1]
    (folder / "config.json").write_text(json.dumps(config))
    assert main(["eval", str(folder)]) == 2


def test_film_of_an_orbit(run_folder, tmp_path, capsys):
    arguments = ["render", str(run_folder), "--cameras", "orbit", "--out", str(tmp_path / "views"), "--frames", "4"]
    assert main([*arguments, "--film", str(tmp_path / "orbit.gif"), "--fps", "10", "--arc", "90"]) == 0
    assert f"film: {tmp_path / 'orbit.gif'}" in capsys.readouterr().out
    with Image.open(tmp_path / "orbit.gif") as film:
        assert (film.n_frames, film.size, film.info["duration"]) == (4, (WIDTH, HEIGHT), 100)
    assert len(list((tmp_path / "views").glob("orbit_*.png"))) == 4


@pytest.mark.parametrize("option", [["--arc", "0"], ["--arc", "400"], ["--arc", "x"], ["--fps", "0"]])
def test_impossible_orbits_are_refused(run_folder, capsys, option):
    with pytest.raises(SystemExit) as caught:
        main(["render", str(run_folder), "--cameras", "orbit", *option])
    (line,) = capsys.readouterr().err.splitlines()
    assert caught.value.code == 2 and option[0] in line
