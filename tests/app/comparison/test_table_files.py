"""The table of a comparison in CSV and LaTeX, read back."""

import csv
import io
import re

import pytest

from minisplat_ref.app.comparison.metrics import METRICS, RecipeMetrics
from minisplat_ref.app.comparison.table import table_cells
from minisplat_ref.app.comparison.table_files import COLUMNS, csv_table, escape_latex, latex_table

VALUES = {metric.key: 3.0 for metric in METRICS}


def runs(*changes):
    return [VALUES | change for change in changes]


RECIPES = [
    RecipeMetrics("3dgs", runs({"psnr": 20.1, "n_gaussians": 3}, {"psnr": 20.3, "n_gaussians": 6})),
    RecipeMetrics("my_own", runs({"psnr": 1 / 3, "n_gaussians": 9}, {"psnr": 1 / 7, "n_gaussians": 9})),
]


def rows_of(text):
    return {(row["recipe"], row["metric"]): row for row in csv.DictReader(io.StringIO(text, newline=""))}


def test_csv_has_all_digits():
    rows = rows_of(csv_table(RECIPES))
    assert len(rows) == len(METRICS) * 2 and all(tuple(row) == COLUMNS for row in rows.values())
    for recipe in RECIPES:
        for metric in METRICS:
            mean, std = recipe.compute_spread(metric)
            row = rows[recipe.recipe, metric.key]
            assert (float(row["mean"]), float(row["std"])) == (mean, std) and row["n"] == "2"
            assert row["meaning"] == metric.title
    own = rows["my_own", "psnr"]
    assert own["relation"] == "difference"
    assert float(own["to_first"]) == (1 / 3 + 1 / 7) / 2 - (20.1 + 20.3) / 2
    assert float(own["error_to_first"]) == pytest.approx(abs((1 / 3 - 20.1) - (1 / 7 - 20.3)) / 2, rel=1e-12)
    assert (rows["my_own", "n_gaussians"]["relation"], rows["my_own", "n_gaussians"]["to_first"]) == ("ratio", "2.0")
    assert rows["3dgs", "psnr"]["to_first"] == rows["3dgs", "psnr"]["error_to_first"] == ""


def test_csv_of_one_run_and_of_what_is_not_known():
    rows = rows_of(csv_table([RecipeMetrics('a,"b"', runs({"lpips": None, "chamfer": None}))]))
    row = rows['a,"b"', "lpips"]
    assert (row["n"], row["mean"], row["std"], row["to_first"]) == ("1", "", "", "")
    assert rows['a,"b"', "psnr"]["std"] == ""
    assert rows['a,"b"', "best_iteration"]["relation"] == ""


def test_photographs_count_where_each_is_held_out_once():
    held_out = {
        name: {"psnr": value} | dict.fromkeys(("psnr_exposed", "psnr_corrected", "ssim", "lpips"))
        for name, value in (("a", 20.0), ("b", 21.0), ("c", 25.0))
    }
    rows = rows_of(csv_table([RecipeMetrics("3dgs", runs({}, {}), held_out)]))
    assert (rows["3dgs", "psnr"]["n"], rows["3dgs", "psnr"]["mean"]) == ("3", "22.0")
    assert rows["3dgs", "n_gaussians"]["n"] == "2"


def read_latex(text):
    """The cells of a tabular, with its escapes and signs undone; every special character must be escaped."""
    lines = [line for line in text.splitlines() if not line.startswith("%")]
    assert lines[0].startswith(r"\begin{tabular}{") and lines[-1] == r"\end{tabular}"
    n_columns = len(re.fullmatch(r"\\begin\{tabular\}\{([lr]+)\}", lines[0])[1])
    rows = [line for line in lines[1:-1] if line != r"\hline"]
    assert lines.count(r"\hline") == 3
    cells = []
    for row in rows:
        assert row.endswith(r" \\")
        found = re.split(r"(?<!\\)&", row.removesuffix(r" \\"))
        assert len(found) == n_columns
        plain = [cell.strip().replace(r"$\pm$", "±").replace("$-$", "-").replace(r"$\times$", "x") for cell in found]
        assert not any(re.search(r"(?<!\\)[#$%&_{}~^]", cell) for cell in plain)
        cells.append([re.sub(r"\\([#$%&_{}])", r"\1", cell) for cell in plain])
    return cells


def test_latex_says_what_is_printed():
    text = latex_table(RECIPES, "room; a\nmachine of 100 %")
    assert read_latex(text) == table_cells(RECIPES)
    assert text.startswith("% room; a machine of 100 %\n") and "{lrr}" in text
    assert r"my\_own" in text and r"$\pm$" in text and r"(3$\times$)" not in text and r"$\times$)" in text
    assert re.search(r"\(\$-\$\d", text)  # a minus, not a hyphen
    assert "best PSNR on the way" in text and text.isascii()


def test_special_characters_are_escaped():
    assert escape_latex(r"a_b & 5% {x} #1 $2") == r"a\_b \& 5\% \{x\} \#1 \$2"
    words = ("textasciitilde", "textasciicircum", "textless", "textgreater", "textbackslash")
    assert escape_latex("~^<>\\\u00b1") == "".join(f"\\{word}{{}}" for word in words) + r"$\pm$"
