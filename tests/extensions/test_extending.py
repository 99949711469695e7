"""docs/EXTENDING.md is true: its code is that of the files it names, its commands parse, its links lead somewhere."""

import importlib
import itertools
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

import minisplat_ref
from data_tools.claims import find_claim
from data_tools.claims.__main__ import parser_of
from minisplat_ref import extensions
from minisplat_ref.app.cli import _find_parser, main
from minisplat_ref.extensions.extension import find_recipe, load_extension
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.training.losses import Rendered
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.types import Model
from photo_scenes import write_transforms
from scenes import as_dtype, make_gaussians
from tolerances import GRADIENT_REL, GRADIENT_STEP

PACKAGE = Path(minisplat_ref.__file__).parent
PAGE = PACKAGE.parent / "docs" / "EXTENDING.md"
TEXT = PAGE.read_text(encoding="utf-8")
WORDS_MAX = 2000  # ten minutes at 200 words a minute


def code_blocks():
    """Python of the page with the last file that was named on a line before it."""
    file = None
    for match in re.finditer(r"^`(\S+\.py)`:$|`(\S+\.py)`:\n|```python\n(.*?)```", TEXT, re.MULTILINE | re.DOTALL):
        file = match[1] or match[2] or file
        if match[3]:
            yield file, match[3]


BLOCKS = list(code_blocks())
COMMANDS = [
    line
    for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)
    for line in block.splitlines()
    if "export" not in line
]


def test_it_is_read_in_ten_minutes():
    assert len(TEXT.split()) < WORDS_MAX
    assert max(map(len, TEXT.splitlines())) <= 220  # of a table's rows; text is broken at 120
    assert all(len(line) <= 120 for line in TEXT.splitlines() if not line.startswith("|"))


def test_there_is_something_to_check():
    assert len(BLOCKS) >= 8 and len(COMMANDS) >= 12
    assert {file for file, _ in BLOCKS} >= {f"minisplat_ref/extensions/velocity/{f}.py" for f in ("__init__", "model")}


@pytest.mark.parametrize(("file", "block"), BLOCKS[:-1], ids=lambda text: text.strip().splitlines()[0][:40])
def test_code_stands_in_its_file(file, block):
    source = (PACKAGE.parent / file).read_text(encoding="utf-8")
    position = 0
    for part in block.split("...\n"):
        position = source.find(part, position)
        assert position >= 0, f"{file} no longer holds this:\n{part}"
        position += len(part)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_parse(command, tmp_path, monkeypatch):
    program, *arguments = shlex.split(command)
    if program == "python":
        assert arguments[:2] == ["-m", "data_tools.claims"]
        parser_of(arguments[2], find_claim(arguments[2])).parse_args(arguments[3:])
        return
    assert program == "minisplat-ref"
    assert callable(_find_parser(arguments).parse_args(arguments).run)
    for option, value in itertools.pairwise(arguments):
        if option == "--extension" and value != "faint":
            assert load_extension(value).name == value
        if option == "--recipe":
            assert find_recipe(value).name == value


def test_links_lead_somewhere():
    links = re.findall(r"\]\(([^)]+)\)", TEXT)
    assert len(links) >= 6
    for link in links:
        assert (PAGE.parent / link).exists(), link


def test_the_tree_is_the_folder():
    tree = TEXT.partition("velocity/\n")[2].partition("```")[0]
    files = {line.split()[0] for line in tree.splitlines() if line.strip()}
    assert files == {path.name for path in (PACKAGE / "extensions" / "velocity").glob("*.py")}


def test_the_table_names_what_there_is():
    lines = [line for line in TEXT.splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]
    assert len(rows) == 8
    for seam, _, file, callers, _ in rows:
        assert hasattr(module_at(file.strip("`")), seam)
        named = re.findall(r"`(\w+)` of `(\S+\.py)`", callers)
        assert len(named) == callers.count(" of ") > 0
        for name, place in named:
            assert hasattr(module_at(place), name), f"{name} is not in {place}"


def module_at(file):
    return importlib.import_module("minisplat_ref." + file.removesuffix(".py").strip("/").replace("/", "."))


# The extension that the page spells out


@pytest.fixture
def faint(tmp_path, monkeypatch):
    file, text = BLOCKS[-1]
    assert file == "mine/faint/__init__.py"
    (tmp_path / "mine" / "faint").mkdir(parents=True)
    (tmp_path / file).write_text(text)
    monkeypatch.setattr(extensions, "__path__", [*extensions.__path__, str(tmp_path / "mine")])
    importlib.invalidate_caches()
    yield load_extension("faint")
    del sys.modules["minisplat_ref.extensions.faint"]


def test_its_gradient_is_right(faint, rng):
    recipe = configure(find_recipe("3dgs-accel", extension="faint"), faint=0.01, power=0.5)
    term = recipe.losses[-1]
    gaussians = make_gaussians(rng, 5)
    blank = Rendered(None, {}, None, None, Model(gaussians), 1, None)
    v = term.function(blank)[1].gaussians["opacity_logits"]
    assert term.weight == 0.01 and np.abs(v).min() > 0
    for row in range(5):
        step = np.where(np.arange(5) == row, GRADIENT_STEP, 0.0)
        above, below = (
            term.function(blank._replace(model=Model(gaussians._replace(opacity_logits=gaussians.opacity_logits + s))))[
                0
            ]
            for s in (step, -step)
        )
        assert (above - below) / (2 * GRADIENT_STEP) == pytest.approx(v[row], rel=GRADIENT_REL)


def test_it_trains_as_the_page_says(faint, tmp_path):
    """The same training with and without: the opacities are lower with it."""
    scene = write_transforms(tmp_path / "scene", fl_x=40.0, ply_file_path="points.ply")
    save_ply(scene / "points.ply", as_dtype(make_gaussians(np.random.default_rng(0), 20, depth=0.0), np.float32))
    (command,) = (line for line in COMMANDS if "faint=" in line)
    arguments = [str(scene) if word == "SCENE" else word for word in shlex.split(command)[1:]]
    logits = []
    for options in (arguments, ["train", str(scene)]):
        out = tmp_path / f"out{len(logits)}"
        assert main([*options, "--recipe", "3dgs-accel", "--iterations", "30", "--out", str(out)]) == 0
        logits.append(load_ply(out / "point_cloud.ply").opacity_logits.mean())
    assert logits[0] < logits[1]
