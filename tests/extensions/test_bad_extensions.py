"""Extensions that are not as they should be: one line that names them, exit code 2, and everything else still works."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import minisplat_ref
from minisplat_ref import extensions
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions import extension as extension_module
from photo_scenes import write_transforms

ROOT = Path(minisplat_ref.__file__).parent.parent
IMPORTS = """
from typing import NamedTuple
import numpy as np
from minisplat_ref.extensions.extension import Extension
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.training.representation import GAUSSIANS
"""
NO_IMPORT = {
    "an error": ("raise RuntimeError('no\\nthing')", "RuntimeError: no thing"),
    "no Python": ("def broken(:", "SyntaxError"),
    "something missing": ("import not_there_at_all", "not_there_at_all"),
    "an exit": ("import sys; sys.exit('bye')", "SystemExit: bye"),
}


@pytest.fixture
def outside(tmp_path, monkeypatch):
    """Make an extension in a folder beside the package: ``outside(name, text, place)``."""
    loaded = set(sys.modules)

    def make(name, text, place="outside"):
        package = tmp_path / place / name.replace("-", "_")
        package.mkdir(parents=True)
        (package / "__init__.py").write_text(text)
        if str(package.parent) not in extensions.__path__:
            monkeypatch.setattr(extensions, "__path__", [*extensions.__path__, str(package.parent)])
        importlib.invalidate_caches()
        return package

    monkeypatch.setattr(extension_module, "_REPORTED", set())
    yield make
    for name in set(sys.modules) - loaded:
        if name.startswith("minisplat_ref.extensions."):
            del sys.modules[name]


@pytest.fixture
def refused(capfd):
    """Run a command line that must be refused; return the line that says why."""

    def run(*arguments):
        capfd.readouterr()
        assert main([str(argument) for argument in arguments]) == 2
        captured = capfd.readouterr()
        lines = captured.err.splitlines()
        assert len(lines) == 1 and lines[0].startswith("minisplat-ref: error: "), captured.err
        assert captured.out == ""
        return lines[0]

    return run


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    settings = {"n_views": 4, "width": 24, "height": 18, "n_points": 30}
    write_scene(make_scene("room", supersampling=1, **settings), folder, settings)
    return folder


SCHEDULED = ("--recipe", "3dgs-accel")  # which is content with four views


def train(scene, out, *options):
    return ["train", str(scene), "--iterations", "2", "--out", str(out), *map(str, options)]


# An extension that cannot be loaded


@pytest.mark.parametrize("how", NO_IMPORT)
def test_what_does_not_import_is_named(how, outside, refused, tmp_path, scene_folder):
    text, reason = NO_IMPORT[how]
    package = outside("broken", text)
    for command in (
        ["broken"],
        ["broken", "anything"],
        ["extensions", "broken"],
        train(scene_folder, tmp_path / "out", "--extension", "broken"),
        ["oracle", "gradients", "--extension", "broken"],
    ):
        line = refused(*command)
        assert f"extension broken in {package}" in line and reason in line and "mend or remove it" in line
    assert not (tmp_path / "out").exists()


def test_everything_else_works_beside_it(outside, tmp_path, scene_folder, capfd):
    outside("broken", "raise RuntimeError('nothing')")
    for command in (
        train(scene_folder, tmp_path / "core", "--recipe", "3dgs-accel"),
        train(
            scene_folder, tmp_path / "geometry", *SCHEDULED, "--extension", "geometry", "--set", "depth_smoothness=0.1"
        ),
        ["info", str(scene_folder)],
        ["eval", str(tmp_path / "core")],
        ["render", str(tmp_path / "core")],
        ["extensions", "velocity"],
        ["extensions"],
    ):
        assert main(command) == 0
        captured = capfd.readouterr()
        assert "warning" not in captured.err and "Traceback" not in captured.err
    assert re.search("^broken *$", captured.out, re.M) and re.search("^velocity +Linear motion", captured.out, re.M)
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    assert "broken" not in capfd.readouterr().err

    # A recipe of another extension is searched for in all; once, stderr says which could not be.
    assert main(train(scene_folder, tmp_path / "moving", "--recipe", "velocity")) == 0
    lines = [line for line in capfd.readouterr().err.splitlines() if "broken" in line]
    assert len(lines) == 1 and lines[0].startswith("minisplat-ref: warning: extension broken in ")


NOT_AN_EXTENSION = {
    "missing": ("", "has no EXTENSION that is an Extension"),
    "a word": ("EXTENSION = 'odd'", "has no EXTENSION that is an Extension"),
    "the class": (IMPORTS + "EXTENSION = Extension", "has no EXTENSION that is an Extension"),
    "another name": (IMPORTS + "EXTENSION = Extension('even')", "extension even lies in a folder called"),
    "one recipe": (
        IMPORTS + "EXTENSION = Extension('odd', recipes=(GS_ACCEL._replace(name='odd')))",
        "recipes is not a tuple of Recipe; write recipes=(...,)",
    ),
    "a list of losses": (IMPORTS + "EXTENSION = Extension('odd', losses=[1])", "losses is not a tuple of LossTerm"),
    "commands by name": (
        IMPORTS + "EXTENSION = Extension('odd', commands=('x',))",
        "commands is not a tuple",
    ),
    "a population": (
        IMPORTS + "EXTENSION = Extension('odd', representation=3)",
        "is not a Representation",
    ),
    "a recipe of the core": (
        IMPORTS + "EXTENSION = Extension('odd', recipes=(GS_ACCEL,))",
        "extension odd has a recipe 3dgs-accel, and so has the core",
    ),
}


@pytest.mark.parametrize("what", NOT_AN_EXTENSION)
def test_what_is_no_extension_is_named(what, outside, refused, scene_folder, tmp_path):
    text, reason = NOT_AN_EXTENSION[what]
    outside("odd", text)
    for command in (["extensions", "odd"], ["odd"], train(scene_folder, tmp_path / "out", "--extension", "odd")):
        line = refused(*command)
        assert reason in line and "odd" in line
    assert main(train(scene_folder, tmp_path / "core", "--recipe", "3dgs-accel")) == 0


# Two of a name, none of a name


def test_two_extensions_of_one_name(outside, refused, scene_folder, tmp_path):
    package = outside("velocity", "")
    for command in (
        ["extensions"],
        ["extensions", "geometry"],
        train(scene_folder, tmp_path / "x", "--recipe", "velocity"),
    ):
        line = refused(*command)
        assert "extension velocity is in " in line and f"and in {package}: rename one" in line
    for command in (
        train(scene_folder, tmp_path / "core", *SCHEDULED),
        ["eval", str(tmp_path / "core")],
        ["info", str(scene_folder)],
    ):
        assert main(command) == 0


def test_two_recipes_of_one_name(outside, refused, scene_folder, tmp_path):
    for name in ("left", "right"):
        outside(name, f"{IMPORTS}EXTENSION = Extension('{name}', recipes=(GS_ACCEL._replace(name='twice'),))")
    line = refused(*train(scene_folder, tmp_path / "out", "--recipe", "twice"))
    assert "recipe twice is in the extensions left and right: rename one" in line


def test_unknown_names(refused, scene_folder, tmp_path):
    line = refused(*train(scene_folder, tmp_path / "out", "--extension", "nowhere"))
    assert "extension 'nowhere' does not exist: choose from" in line and "velocity" in line
    line = refused(*train(scene_folder, tmp_path / "out", "--recipe", "nothing"))
    assert "recipe 'nothing' does not exist: choose from 3dgs," in line and "velocity" in line
    assert "'nowhere' does not exist" in refused("extensions", "nowhere")
    assert "'nowhere' does not exist" in refused("oracle", "gradients", "--extension", "nowhere")
    assert "has no speed to set" in refused(*train(scene_folder, tmp_path / "out", "--set", "speed=1"))


def test_recipe_of_another_extension(refused, scene_folder, tmp_path):
    line = refused(*train(scene_folder, tmp_path / "out", "--recipe", "velocity", "--extension", "surfels"))
    assert "recipe velocity belongs to extension velocity: leave out --extension surfels" in line


def test_an_extension_without_commands(refused):
    assert "extension geometry has no commands: see minisplat-ref extensions geometry" in refused("geometry")


def test_a_field_without_a_learning_rate(outside, refused, scene_folder, tmp_path):
    text = f"""{IMPORTS}
from minisplat_ref.types import Floats, Gaussians

class Glowing(NamedTuple):
    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    glow: Floats

def extend(gaussians, rng):
    return Glowing(*gaussians, np.zeros(len(gaussians.means), np.float32))

GLOWING = GAUSSIANS._replace(name="glowing Gaussians", population=Glowing, extend=extend)
EXTENSION = Extension("glow", recipes=(GS_ACCEL._replace(name="glow"),), representation=GLOWING)
"""
    outside("glow", text)
    line = refused(*train(scene_folder, tmp_path / "out", "--recipe", "glow"))
    assert "recipe glow has no learning rate for glow of glowing Gaussians" in line
    assert not (tmp_path / "out").exists()


# The variable


def run(*arguments, **environment):
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | environment
    command = [sys.executable, "-m", "minisplat_ref", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


def test_a_place_that_is_no_folder(tmp_path):
    (tmp_path / "file").touch()
    done = run("extensions", MINISPLAT_EXTENSIONS=str(tmp_path / "file"))
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("minisplat-ref: error: MINISPLAT_EXTENSIONS names") and done.stderr.count("\n") == 1
    assert run("--help", MINISPLAT_EXTENSIONS=str(tmp_path / "nowhere")).returncode == 0
    scene = write_transforms(tmp_path / "scene", fl_x=40.0)
    assert run("info", scene, MINISPLAT_EXTENSIONS=str(tmp_path / "nowhere")).returncode == 0
