"""Input that makes no sense is refused in one line, which names what was probably meant or where it comes from."""

import numpy as np
import pytest

import minisplat_ref as ms
from minisplat_ref.app.cli import main
from minisplat_ref.datasets import synthetic
from minisplat_ref.errors import InputError
from minisplat_ref.methods import RECIPES
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.types import view_from
from photo_scenes import colored_image, write_transforms
from scenes import as_dtype, make_camera, make_gaussians


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Run a command in an empty folder that must be refused in one line, and leave nothing; return the line."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        def found():
            files = (path for path in tmp_path.rglob("*.*") if path.parent.name != "__pycache__")
            return {path: path.stat().st_mtime_ns for path in files}

        before = found()
        assert main([str(word) for word in words]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert found().items() <= before.items()
        return line.removeprefix("minisplat-ref: error: ")

    return run


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ("train", "scene", "--recipe", "adaptve", "--out", "o"),
            "recipe 'adaptve' does not exist; did you mean adaptive?",
        ),
        (
            ("train", "scene", "--recipe", "3dgs", "--extension", "antialising", "--out", "o"),
            "extension 'antialising' does not exist; did you mean antialiasing?",
        ),
        (("extensions", "surfel"), "extension 'surfel' does not exist; did you mean surfels?"),
        (("synthetic", "rooom", "--out", "o"), "there is no synthetic scene 'rooom'; did you mean room?"),
        (
            ("train", "scene", "--set", "minslope=1", "--out", "o"),
            "recipe adaptive has no minslope to set; did you mean min_slope?",
        ),
        (("oracle", "compare", "gspla"), "'gspla' is neither a folder of dumps nor a renderer; did you mean gsplat?"),
    ],
)
def test_the_nearest_name_not_all(refused, tmp_path, words, line):
    write_transforms(tmp_path / "scene", n=4)
    assert refused(*words) == line


def test_where_nothing_is_near_all_are_named(refused, tmp_path):
    write_transforms(tmp_path / "scene", n=4)
    assert "does not exist: choose from 3dgs, 3dgs-accel, " in refused(
        "train", "scene", "--recipe", "qqq", "--out", "o"
    )


MODULE = "def rasterization(means): pass\ndef helper(x): pass\n_hidden = print\n"


def test_a_module_is_told_its_functions(refused, tmp_path):
    (tmp_path / "my_own_module.py").write_text(MODULE)
    line = refused("oracle", "compare", "my_own_module")
    assert "give my_own_module:rasterization, or another of its functions: rasterization, helper" in line
    line = refused("oracle", "compare", "my_own_module:rasterizatoin")
    assert line == "module my_own_module has no 'rasterizatoin'; did you mean rasterization?"
    line = refused("oracle", "compare", "my_ownmodule:rasterization")
    assert line == "module my_ownmodule is not found; did you mean my_own_module?"


def test_photographs_of_a_pixel_are_refused_before_cameras_are_looked_for(refused, tmp_path):
    (tmp_path / "photos").mkdir()
    from minisplat_ref.io.images import write_image

    write_image(tmp_path / "photos" / "a.png", colored_image(1))
    line = refused("photos", "photos", "--downscale", "1000", "--out", "o")
    assert "--downscale 1000 leaves 1 x 1 pixels" in line and "give at most" in line


def test_full_memory_recommends_options_that_there_are(refused, monkeypatch):
    def full(*_, **__):
        raise MemoryError

    monkeypatch.setattr(synthetic, "make_scene", full)
    line = refused("synthetic", "room", "--out", "o")
    assert line == "memory is full: give less at a time (--width, --height, --views, --supersampling)"


@pytest.mark.parametrize("weight", [-1.0, float("nan"), float("inf")])
def test_a_weight_of_the_loss_is_at_least_0(weight):
    scene = synthetic.make_scene("room", n_views=3, width=16, height=12, supersampling=1, n_points=20).scene
    recipe = RECIPES["3dgs"]
    wrong = recipe._replace(losses=(recipe.losses[0]._replace(weight=weight),))
    with pytest.raises(InputError, match=f"loss term {recipe.losses[0].name} by {weight:g}: a weight is at least 0"):
        initial_state(scene, wrong, 0)


def test_what_render_takes(rng):
    gaussians, camera = as_dtype(make_gaussians(rng, 5), np.float32), make_camera(16, 12)
    ms.render(gaussians, camera)
    for arguments, message in (
        (("scene.ply",), "the first is a str: ms.load_ply"),
        ((camera, gaussians), "the first is a Camera"),
        ((gaussians,), "there is no camera: pass scene.train_views"),
        ((gaussians, view_from(camera)), "the second is a View: pass view.camera"),
    ):
        with pytest.raises(InputError, match=message):
            ms.render(*arguments)
