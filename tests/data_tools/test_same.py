"""Comparing two worktrees: what is left out of the comparison, and how their times are set beside each other."""

import json
from pathlib import Path

import pytest

from data_tools import same_results, same_speed

ROOT = Path(__file__).parents[2]


def test_times_and_words_are_no_figures():
    report = {"RMS": 0.1, "ms forward": 3.0, "cases": [{"name": "a", "seconds": 1.0, "figures": {"x": 2}}, "b"]}
    assert same_results.figures_of(report) == {"RMS": 0.1, "cases": [{"figures": {"x": 2}}]}


def test_every_recipe_is_compared():
    options = same_results.recipe_options()
    assert {"3dgs", "adaptive", "mini-splatting2-d"} <= options.keys() and len(options) > 15
    assert options["micro"] == ["--extension", "micro", "--recipe", "micro"]


def test_what_differs_is_named(monkeypatch, tmp_path, capsys):
    """The second tree trains one recipe to other bytes."""
    monkeypatch.setattr(same_results, "recipe_options", lambda: {"a": [], "b": []})
    monkeypatch.setattr(same_results, "run", lambda tree, *arguments: None)
    monkeypatch.setattr(same_results, "check", lambda tree, name, out: {"error": 1e-9})

    def train(tree, scene, options, out, iterations):
        return {"sha256": str(tree == ROOT) if out.name.endswith("b") else "same", "psnr": 20.0, "ssim": 0.5}

    monkeypatch.setattr(same_results, "train", train)
    monkeypatch.setattr("sys.argv", ["same_results", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        same_results.main()
    rows = [line for line in capsys.readouterr().out.splitlines() if "DIFFERENT" in line]
    assert ended.value.code == 1 and len(rows) == 1 and "b" in rows[0]


def test_trees_alternate_and_rounds_are_compared(monkeypatch, tmp_path, capsys):
    """Before takes 2 s in every round; now 2, 3 and 4 s: the median of the ratios is 1.5."""
    order = []
    of_now = iter([9.0, 2.0, 3.0, 4.0])  # the first one compiles

    def run(tree, *arguments, kernels=None):
        if "bench" in arguments:
            figures = {"least forward ms": 1.0, "least both ms": 2.0}
            Path(arguments[-1]).write_text(json.dumps({"cases": [{"name": "reference"}, figures]}))
        if arguments[0] == "-c":
            order.append(tree.root == ROOT)
            return str(next(of_now) if tree.root == ROOT else 2.0)
        return ""

    monkeypatch.setattr(same_speed.Tree, "run", run)
    monkeypatch.setattr("sys.argv", ["same_speed", str(tmp_path)])
    same_speed.main()
    assert order == [False, True, True, False, False, True, True, False]
    [row] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| iteration")]
    assert [cell.strip() for cell in row.split("|")[2:-1]] == ["2,000.0", "2,000.0", "1.50", "1.00 to 2.00"]
