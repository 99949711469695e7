"""Lines by folder, and repetition: a tree whose counts can be told by hand."""

from pathlib import Path

import pytest

from data_tools.house import code_lines, count_repeated, main, measure_tree

BODY = "".join(f"    x = {k} + y\n" for k in range(6))
SHAPE = "".join(f"    a = {k + 10} + b\n" for k in range(6))


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """One function of six lines, twice to the letter and once with other names and numbers."""
    for name, text in {
        "minisplat_ref/one.py": f'"""Text."""\n\nimport os\n\ndef f(y):\n{BODY}',
        "minisplat_ref/io/two.py": f"def g(y):\n{BODY}",
        "minisplat_ref/io/three.py": f"# a comment\ndef h(b):\n{SHAPE}",
        "data_tools/own.py": "x = 1\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "tests").mkdir()
    return tmp_path


def test_lines_by_folder(tree):
    found = measure_tree(tree)
    # Files, lines, code, repeated to the letter, repeated by shape: there, the lines with def belong to the runs, too.
    assert found["minisplat_ref/*.py"] == [1, 11, 7, 6, 7]
    assert found["minisplat_ref/io"] == [2, 15, 14, 6, 14]
    assert found["minisplat_ref"] == [3, 26, 21, 12, 21]
    assert found["data_tools"] == [1, 1, 1, 0, 0]


def test_five_lines_are_no_run():
    lines = list("abcde")
    assert count_repeated([[*lines, "x"], [*lines, "y"]]) == [0, 0]
    assert count_repeated([[*lines, "x"], [*lines, "x"]]) == [6, 6]


def test_docstrings_comments_and_imports_are_no_code():
    assert code_lines(
        '"""Text\nof two lines."""\nfrom os import (\n    path,\n)\n\n# comment\nx = "text"  # why\n'
    ) == [('x = "text"', "_ = _")]


def test_two_trees_in_one_table(tree, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["house", str(tree), str(tree)])
    main()
    [line] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| minisplat_ref/io")]
    assert line.count("15") == 2
