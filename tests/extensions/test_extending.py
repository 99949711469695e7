"""docs/EXTENDING.md is true: its code is that of the files it names, its commands parse, its links lead somewhere."""

import importlib
import itertools
import json
import re
import shlex
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import minisplat_ref
from data_tools.claims import find_claim
from data_tools.claims.__main__ import parser_of
from minisplat_ref import InputError, extensions, load_scene
from minisplat_ref.app.cli import _find_parser, main
from minisplat_ref.extensions.extension import _check_parts, find_recipe, load_extension, load_extensions
from minisplat_ref.io.frames import Unit
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.methods import RECIPES
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.population_check import fields_read
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import WORLD_UNITS
from minisplat_ref.training.schedule import action_name
from photo_scenes import write_transforms
from scenes import as_dtype, make_gaussians

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
        if option == "--extension" and value != "round":
            assert load_extension(value).name == value
        if option == "--recipe" and value != "round":
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
def round_(tmp_path, monkeypatch):
    file, text = BLOCKS[-1]
    assert file == "mine/round/__init__.py"
    (tmp_path / "mine" / "round").mkdir(parents=True)
    (tmp_path / file).write_text(text)
    monkeypatch.setattr(extensions, "__path__", [*extensions.__path__, str(tmp_path / "mine")])
    importlib.invalidate_caches()
    yield load_extension("round")
    del sys.modules["minisplat_ref.extensions.round"]


@pytest.fixture
def scene(tmp_path):
    folder = write_transforms(tmp_path / "scene", fl_x=40.0, ply_file_path="points.ply")
    save_ply(folder / "points.ply", as_dtype(make_gaussians(np.random.default_rng(0), 20, depth=0.0), np.float32))
    return folder


def test_its_gradients_are_right(round_, capsys):
    assert main(["oracle", "gradients", "--extension", "round", "--backend", "reference"]) == 0
    assert "cases passed" in capsys.readouterr().out


def test_it_trains_as_the_page_says(round_, scene, tmp_path, capsys):
    """And its PLY is that of round Gaussians of 3DGS, which every command and every program takes."""
    (command,) = (line for line in COMMANDS if "--recipe round" in line)
    places = {"SCENE": str(scene), "runs/round": str(tmp_path / "out")}
    words = [places.get(word, word) for word in shlex.split(command)[1:]]
    assert main([*words, "--iterations", "30"]) == 0
    plain = load_ply(tmp_path / "out" / "point_cloud.ply")
    assert_array_equal(plain.log_scales, np.repeat(plain.log_scales[:, :1], 3, axis=1))
    assert_array_equal(plain.quats, np.tile(np.float32([1, 0, 0, 0]), (len(plain.means), 1)))
    before = json.loads((tmp_path / "out" / "metrics.json").read_text())["psnr"]
    assert main(["eval", str(tmp_path / "out")]) == 0
    assert main(["train", "--resume", str(tmp_path / "out"), "--iterations", "40"]) == 0
    assert main(["convert", str(tmp_path / "out" / "point_cloud.ply"), str(tmp_path / "a.spz")]) == 0
    assert before is None or before > 0


@pytest.mark.parametrize(
    ("change", "refusal"),
    [
        (
            lambda r, ours: (r._replace(events=GS_ACCEL.events), ours),
            "action clone_and_split needs log_scales, quats, which population round Gaussians has not",
        ),
        (
            lambda r, ours: (r, ours._replace(units={**ours.units, "log_radius": Unit.LENGTH})),
            "a unit of log_radius, which it has not: give units of its own fields, which are means, log_radii,",
        ),
        (
            lambda r, ours: (r, ours._replace(units=WORLD_UNITS)),
            "a unit of log_scales, which it has not",
        ),
        (
            lambda r, ours: (r, ours._replace(population=Wrong, extend=one_column, rates=Rates({}))),
            r"has log_scales \[N, 1\], and everywhere else that is \[N, 3\]: give the field another name",
        ),
    ],
)
def test_what_it_lacks_is_told_before_the_first_iteration(round_, scene, change, refusal):
    recipe, representation = change(round_.recipes[0], round_.representation)
    with pytest.raises(InputError, match=refusal):
        initial_state(load_scene(scene, test_every=0), recipe._replace(representation=representation), 0)


class Wrong(NamedTuple):
    means: np.ndarray
    log_scales: np.ndarray


def one_column(gaussians, rng):
    return Wrong(gaussians.means, gaussians.log_scales[:, :1])


def test_a_population_that_no_ply_holds_needs_its_own_files(round_):
    for change in ({"save": save_ply}, {"load": load_ply}):
        with pytest.raises(InputError, match="no quats, log_scales, which a PLY of 3DGS has: give it"):
            _check_parts(round_._replace(**change), "round", "mine/round")


def test_fields_that_an_action_reads():
    """Through partial functions, functions that it calls, and defaults; not those of another action."""
    read = {action_name(event): fields_read(event.action) for event in GS_ACCEL.events}
    assert read["collect_gradients"] == set()
    assert read["prune_faint"] == {"opacity_logits"} and read["prune_large"] == {"log_scales"}
    assert read["clone_and_split"] == {"log_scales", "quats"}, "of random_children, its default, too"
    assert "sh_dc" in fields_read(lambda state, iteration: state.gaussians._replace(sh_dc=1))


@pytest.mark.parametrize("name", [*RECIPES, *(recipe.name for e in load_extensions() for recipe in e.recipes)])
def test_every_recipe_has_the_fields_of_its_actions(name):
    recipe = find_recipe(name)
    fields = set(recipe.representation.population._fields)
    assert all(fields_read(event.action) <= fields for event in recipe.events)
