"""Changes by hand: which are tested, and what counts as noticed."""

import tomllib
from pathlib import Path

import pytest

from data_tools import rule_changes
from data_tools.rule_changes import CHANGES, Change, is_noticed, main, read_changes

CODE = "LIMIT = 3\nSTEP = 3\n\n\ndef is_large(x):\n    return x > LIMIT\n"
TEST = "from rules import is_large\n\n\ndef test_large():\n    assert is_large(4) and not is_large(3)\n"
REPO = Path(__file__).parents[2]


@pytest.fixture
def tests(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{REPO}")
    Path("rules.py").write_text(CODE)
    Path("test_rules.py").write_text(TEST)
    return [Path("test_rules.py")]


@pytest.mark.parametrize(
    ("old", "new", "noticed"),
    [
        ("LIMIT = 3", "LIMIT = 4", True),
        ("x > LIMIT", "x >= LIMIT", True),
        ("STEP = 3", "STEP = 4", False),
        (" = 3", " = 4", None),  # twice
        ("WEIGHT", "weight", None),
    ],
)
def test_a_change_is_noticed_by_a_test_that_fails(tests, old, new, noticed):
    assert is_noticed(Change(Path("rules.py"), old, new), tests, 60) is noticed
    assert Path("rules.py").read_text() == CODE


def test_a_change_of_a_file_that_is_gone_has_no_say(tests):
    assert is_noticed(Change(Path("other.py"), "a", "b"), tests, 60) is None


def test_changes_of_some_folders():
    tables = {"a/b.py": [["1", "2"], ["3", "4"]], "a/c/d.py": [["5", "6"]], "ab.py": [["7", "8"]]}
    assert [change.old for change in read_changes(tables, [])] == ["1", "3", "5", "7"]
    assert [change.old for change in read_changes(tables, [Path("a")])] == ["1", "3", "5"]
    assert [change.old for change in read_changes(tables, [Path("a/c"), Path("ab.py")])] == ["5", "7"]


def test_the_changes_of_the_repository_are_of_its_files():
    changes = read_changes(tomllib.loads(CHANGES.read_text()), [])
    assert {change.path for change in changes if not (REPO / change.path).is_file()} == set()
    assert [change for change in changes if change.old == change.new] == []
    texts = {path: (REPO / path).read_text(encoding="utf-8") for path in {change.path for change in changes}}
    assert [str(change) for change in changes if texts[change.path].count(change.old) != 1] == []  # no change would act
    assert len(set(changes)) == len(changes) > 300


@pytest.fixture
def command(tests, monkeypatch):
    Path("changes.toml").write_text('"rules.py" = [["STEP = 3", "STEP = 4"], ["x > ", "x < "], ["y", "z"]]\n')
    monkeypatch.setattr("sys.argv", ["rule_changes", "--changes", "changes.toml", "--seconds", "60"])
    monkeypatch.setattr(rule_changes, "copy_tree", lambda folder: Path.cwd())
    monkeypatch.setattr(rule_changes, "TABLE", tests[0])
    monkeypatch.setattr(rule_changes, "RULES", tests[0])
    monkeypatch.setattr(rule_changes.Imports, "tests_of", lambda self, path: tests)
    return main


def test_tests_that_fail_without_a_change_say_nothing(command):
    Path("rules.py").write_text(CODE.replace("LIMIT = 3", "LIMIT = 5"))
    with pytest.raises(SystemExit, match=r"rules\.py: its tests fail without a change: test_rules\.py"):
        command()


def test_the_sums_are_printed(command, capsys):
    command()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "1/3 survived rules.py: 'STEP = 3' -> 'STEP = 4'"
    assert lines[1].startswith("2/3 noticed") and lines[2].startswith("3/3 gone")
    assert lines[3] == "1 gone, 1 noticed, 1 survived"
