"""The tables of what is published: their form, and a row beside a clone that agrees, differs, or is not there."""

import re
import subprocess

import pytest

from data_tools.published import __main__ as command
from data_tools.published.check import Verdict, find, judge, read
from data_tools.published.constants import CONSTANTS
from data_tools.published.relatives import TABLES
from data_tools.published.rows import Source, after, between, code, every, has, kept, once, ours, paper, says

ARGUMENTS = """class OptimizationParams:
    self.scaling_lr = 0.007
    self.scaling_lr = 0.005  # the last one counts
    self.scaling_lr_final = 1e-6
    self.iterations = 30_000
    self.opacity_lr = 0.05/2
    parser.add_argument("--simp_iteration1", type=int, default = 15_000)
    "n_neurons": 64,
    const float near_n = 0.2f;
"""


@pytest.fixture
def clones(tmp_path):
    """A clone whose work tree says something else than its commit."""
    folder = tmp_path / "someone" / "splats"
    folder.mkdir(parents=True)
    git = ["git", "-C", str(folder), "-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run([*git, "init", "-q"], check=True)
    (folder / "arguments.py").write_text(ARGUMENTS)
    subprocess.run([*git, "add", "arguments.py"], check=True)
    subprocess.run([*git, "commit", "-qm", "release"], check=True)
    (folder / "arguments.py").write_text(ARGUMENTS.replace("0.005", "0.009"))
    return tmp_path


@pytest.fixture
def source(clones):
    done = subprocess.run(
        ["git", "-C", str(clones / "someone" / "splats"), "rev-parse", "HEAD"], capture_output=True, text=True
    )
    read.cache_clear()
    return Source("someone/splats", done.stdout.strip(), "arguments.py")


@pytest.mark.parametrize(
    ("symbol", "number"),
    [
        ("scaling_lr", 0.005),
        ("scaling_lr_final", 1e-6),
        ("iterations", 30_000),
        ("simp_iteration1", 15_000),
        ("n_neurons", 64),
        ("near_n", 0.2),
        (r"scaling_lr = ([\d.]+)", 0.007),
        (r"opacity_lr = [\d.]+/(\d)", 2),
        ("lr", None),
        (r"rotation_lr = ([\d.]+)", None),
    ],
)
def test_symbols_find_numbers(symbol, number):
    assert find(symbol, ARGUMENTS) == number


def test_a_row_is_compared_with_its_commit(clones, source):
    """A planted clone: what it says, what it does not, what we keep otherwise, and what is not there at all."""
    rows = {
        **code(source, same=says(0.005, "scaling_lr"), other=says(0.004, "scaling_lr"), gone=says(1.0, "warm_up")),
        **code(source, has=has(True, "class OptimizationParams"), has_not=has(True, "class ModelParams")),
        **kept("slower", source, kept=says(0.001, "scaling_lr", numbers=(0.005,))),
        **kept("slower", source, moved=says(0.001, "scaling_lr", numbers=(0.006,))),
        **code(Source("someone/else", source.commit, source.path), away=says(0.005, "scaling_lr")),
        **code(source._replace(path="train.py"), no_file=says(0.005, "scaling_lr")),
        **paper("section 4", stated=2),
        **ours("no source has it", own=3),
    }
    verdicts = {name: judge(row, clones) for name, row in rows.items()}
    assert verdicts == {
        "same": Verdict("agrees", (0.005,)),
        "other": Verdict("differs", (0.005,)),
        "gone": Verdict("differs", (None,)),
        "has": Verdict("agrees"),
        "has_not": Verdict("differs"),
        "kept": Verdict("kept", (0.005,)),
        "moved": Verdict("differs", (0.005,)),
        "away": Verdict("no clone"),
        "no_file": Verdict("no clone"),
        "stated": Verdict("paper"),
        "own": Verdict("ours"),
    }


def test_dates_by_hand():
    assert between(2, 6, "stop").value == [[3, 4, 5]]
    assert every(100, 500, 100, "a", "b", "c", but=(300,)) == ([[200, 400]], ("a", "b", "c"), (100, 500, 100))
    assert once(7, "at") == ([[7]], ("at",), (7,))
    assert after(0.5, 1_000, "w", "from") == ((0.5, 1_001), ("w", "from"), (0.5, 1_000))
    assert says((1, 2), "a", "b").numbers == (1, 2) and list(code(None, a__b=says(1, "c"))) == ["a.b"]


@pytest.mark.parametrize("place", [*TABLES, "modules"])
def test_every_row_says_where(place):
    """Code with a commit and a symbol for each number; a paper; or a reason. Values that differ have one, too."""
    for name, row in (TABLES | {"modules": CONSTANTS})[place].items():
        if isinstance(row.source, Source):
            assert re.fullmatch(r"[\w.-]+/[\w.-]+", row.source.repository), name
            assert re.fullmatch(r"[0-9a-f]{40}", row.source.commit), name
            assert row.symbols and len(row.symbols) in (len(row.numbers), len(row.symbols) * (not row.numbers)), name
            assert all(re.compile(symbol).groups == 1 for symbol in row.symbols if row.numbers and "(" in symbol), name
        else:
            assert (row.source != "") != (row.reason != ""), name
        is_number = isinstance(row.value, float) and len(row.numbers) == 1 and "(" not in row.symbols[0]
        if is_number and not row.reason and row.value != row.numbers[0]:
            assert name in DERIVED, (name, row)


DERIVED = {"rate.log_scales"}  # numbers of a source that are multiplied there before they are used


def test_the_command_prints_rows_and_fails_where_one_differs(clones, source, monkeypatch, capsys):
    good, bad = (
        code(source, a=says(0.005, "scaling_lr")),
        code(source, b=says([[1, 2, 3, 4]], "iterations", numbers=(4,))),
    )
    monkeypatch.setattr(command, "CONSTANTS", paper("section 4", c=2))
    monkeypatch.setattr(command, "TABLES", {"first": good, "second": good})
    assert command.main([str(clones)]) == 0
    printed = capsys.readouterr().out
    assert "first: a" in printed and "second: a" not in printed and "1 agrees, 1 paper" in printed
    monkeypatch.setattr(command, "TABLES", {"first": good | bad})
    assert command.main([str(clones), "--only", "differs"]) == 1
    printed = capsys.readouterr().out
    assert "| 1, 2, ..., 4 (4) | 30000" in printed and "first: a" not in printed
    away = code(Source("a/b", source.commit, "c.py"), d=says(1, "e"))
    monkeypatch.setattr(command, "TABLES", {"first": away})
    assert command.main([str(clones)]) == 0
    assert "not read: a/b@" in capsys.readouterr().err
