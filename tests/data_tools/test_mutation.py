"""Mutation: the tests that are run for a change, and the places that are not worth one."""

import random
import subprocess
import sys
from pathlib import Path

import pytest

from data_tools.sources import Imports, annotations, module_name

SOURCES = {
    "package/__init__.py": "from package.shapes import area\nfrom package.deep.inner import core",
    "package/shapes.py": "",
    "package/deep/__init__.py": "",
    "package/deep/inner.py": "",
    "package/deep/helper.py": "",
    "package/user.py": "from package.deep import helper",
    "package/lonely.py": "",
    "tests/test_area.py": "from package import area",
    "tests/test_shapes.py": "import package.shapes",
    "tests/test_much.py": "from package.shapes import area, volume, width",
    "tests/test_user.py": "from package.user import use",
    "tests/cli/test_cli.py": 'main(["inner", "--help"])',
}


@pytest.fixture
def imports(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, source in SOURCES.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(source)
    return Imports(*(sorted(Path(folder).rglob("*.py")) for folder in ("package", "tests")))


@pytest.mark.parametrize(
    ("module", "tests"),
    [
        # Named like it; then by how much is imported from it; also through the package that exports its names.
        ("package/shapes.py", ["test_shapes", "test_much", "test_area"]),
        # The package imports it, and is imported; and there is a command of that name.
        ("package/deep/inner.py", ["test_cli", "test_area"]),
        # No test imports it: those that import what does.
        ("package/deep/helper.py", ["test_user"]),
        ("package/lonely.py", []),
        ("package/__init__.py", ["test_area"]),
    ],
)
def test_tests_of_a_module(imports, module, tests):
    assert [path.stem for path in imports.tests_of(Path(module))] == tests


def test_modules_are_named_as_they_are_imported():
    assert module_name(Path("a/b/c.py")) == "a.b.c" and module_name(Path("a/b/__init__.py")) == "a.b"


def test_types_are_found_where_they_stand():
    source = "x: int | None = 1 | 2\n\ndef f(a: 'A', b=3) -> list[int]:\n    return a | b\n"
    assert annotations(source) == [((1, 3), (1, 13)), ((3, 22), (3, 31)), ((3, 9), (3, 12))]


@pytest.mark.parametrize(("seconds", "code"), [(0, 0), (60, 1)])
def test_what_comes_too_late_has_no_say(tmp_path, seconds, code):
    (tmp_path / "test_late.py").write_text("def test():\n    assert False\n")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "data_tools.deadline"]
    command += ["--seconds", str(seconds), "--rootdir", str(tmp_path), str(tmp_path)]
    assert subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True).returncode == code


def test_the_same_changes_are_drawn_again(imports, monkeypatch):
    pytest.importorskip("cosmic_ray", reason="of the extra [mutation]")
    from data_tools.mutation import SETTINGS, draw_changes, load_config

    module = Path("package/shapes.py")
    module.write_text("def f(a: int | None, b=2) -> int | None:\n    return a + b if a > 0 and not b < 7 else None\n")
    settings = load_config(Path(__file__).parents[2] / SETTINGS)
    draws = [draw_changes([module], settings, n, random.Random(3)) for n in (3, 3, 100)]
    first, second, every = (
        [(change.start_pos, change.operator_name) for item in draw for change in item.mutations] for draw in draws
    )
    assert first == second and len(set(first)) == 3
    places = [start for start, _ in every]
    assert len(places) >= 8 and len({start for start in places if start[0] == 1}) == 1  # b=2, but no type
