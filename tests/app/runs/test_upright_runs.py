"""What is up, from the command line: recorded by a run, shown by page, film and glTF, and overridden."""

import json
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.app.cli import main
from minisplat_ref.io import load_ply
from minisplat_ref.io.formats.glb import GLB
from minisplat_ref.io.upright import FILE
from run_commands import OPTIONS, SCENE, refused, write_room  # noqa: F401  (a fixture)

ALONG_X = {"up": [1, 0, 0], "source": "the ground"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a scene that says that x is up."""
    folder = tmp_path_factory.mktemp("upright")
    write_room(folder / "nook", **SCENE)
    (folder / "nook" / FILE).write_text(json.dumps(ALONG_X))
    assert main(["train", str(folder / "nook"), *OPTIONS, "--out", str(folder / "run")]) == 0
    return folder / "run"


def page_of(path):
    return json.loads(re.search(r'id="scene">(.*?)</script>', path.read_text(), re.DOTALL).group(1))


def test_a_run_keeps_what_its_scene_records(run, tmp_path, capsys):
    assert json.loads((run / "config.json").read_text())["up"] == ALONG_X
    assert main(["convert", str(run), str(tmp_path / "a.html")]) == 0
    assert "up is 1.00,0.00,0.00, by the ground (--up says it otherwise)" in capsys.readouterr().out
    page = page_of(tmp_path / "a.html")
    assert page["up"] == [1, 0, 0]
    assert all(-view["R"][1][0] >= abs(view["R"][0][0]) - 1e-9 for view in page["views"])
    assert any(view["width"] < view["height"] for view in page["views"])


def test_without_a_record_cameras_and_points_show_it(tmp_path):
    write_room(tmp_path / "nook", **SCENE)
    assert main(["train", str(tmp_path / "nook"), *OPTIONS, "--out", str(tmp_path / "run")]) == 0
    recorded = json.loads((tmp_path / "run" / "config.json").read_text())["up"]
    assert_allclose(recorded["up"], [0, 0, 1], atol=0.02)
    assert "held alike" in recorded["source"]


def test_a_film_is_upright(run, tmp_path, capsys):
    for options, axis in (((), 0), (("--up", "0,0,-1"), 2)):
        assert main(["render", str(run), "--cameras", "orbit", "--frames", "2", "--out", str(tmp_path), *options]) == 0
        direction = re.search("up is (.*?), by", capsys.readouterr().out).group(1)
        assert abs(np.array(direction.split(","), float)[axis]) == 1


def test_gltf_is_upright_with_its_colours(run, tmp_path):
    """A quarter about the viewing axis: the scene's x is up in glTF; scales stay, and other formats keep the axes."""
    assert main(["convert", str(run), str(tmp_path / "a.glb")]) == 0
    assert main(["convert", str(run), str(tmp_path / "b.glb"), "--up", "0,-1,0"]) == 0
    turned, straight = (GLB.decode((tmp_path / name).read_bytes(), name) for name in ("a.glb", "b.glb"))
    plain = load_ply(run / "point_cloud.ply")
    assert_allclose(straight.means, plain.means, atol=1e-6)
    assert_allclose(-turned.means[:, 1], plain.means[:, 0], atol=1e-5)
    assert_allclose(np.sort(turned.log_scales), np.sort(plain.log_scales), atol=1e-4)
    assert_allclose((turned.sh_rest**2).sum(axis=1), (plain.sh_rest**2).sum(axis=1), atol=1e-5)


def test_what_up_cannot_be(run, tmp_path, refused):
    assert "--up is for pages (.html) and for .glb" in refused("convert", run, tmp_path / "a.spz", "--up", "0,0,1")
    line = refused("convert", run, tmp_path / "a.html", "--up", "sideways")
    assert "neither X,Y,Z nor one of the photographs, such as view_" in line and "NAME:left" in line
    assert not any(tmp_path.iterdir())
