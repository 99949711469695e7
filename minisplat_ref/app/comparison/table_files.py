"""The table of a comparison as files for other programs: CSV with all digits, and LaTeX as it is printed.

``table.csv`` has a row for each metric of each recipe. ``table.tex`` is one ``tabular`` that needs no package, for the
``input`` of LaTeX: a row for each metric, a column for each recipe.
"""

import csv
import io
import re
from collections.abc import Sequence

from minisplat_ref.app.comparison.metrics import METRICS, RecipeMetrics, relation
from minisplat_ref.app.comparison.table import table_cells

COLUMNS = ("recipe", "metric", "meaning", "n", "mean", "std", "relation", "to_first", "error_to_first")
SPECIAL = {
    **{character: f"\\{character}" for character in "#$%&_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "±": r"$\pm$",
}


def csv_table(recipes: Sequence[RecipeMetrics]) -> str:
    """Return the table in CSV; a cell is empty where a value is not known.

    ``n`` values have the mean and the sample standard deviation ``std``: photographs where each was held out once, runs
    otherwise. ``to_first`` is the ratio of the mean to that of the first recipe, or the difference from it, as
    ``relation`` says; ``error_to_first`` is the standard error of a difference.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    first = recipes[0]
    for metric in METRICS:
        for recipe in recipes:
            mean, std = recipe.compute_spread(metric)
            n = len(recipe.photographs if recipe.is_per_photograph(metric) else recipe.runs)
            of_first = error = None
            if recipe is not first:
                of_first = relation(metric, recipe.compute_spread(metric), first.compute_spread(metric))
                if metric.relation == "difference":
                    error = recipe.error_of_difference(metric, first)
            row = (recipe.recipe, metric.key, metric.title, n, mean, std, metric.relation, of_first, error)
            writer.writerow("" if value is None else value for value in row)
    return text.getvalue()


def latex_table(recipes: Sequence[RecipeMetrics], caption: str) -> str:
    """Return the printed table as a ``tabular``, under the caption as a comment."""
    heading, *rows = table_cells(recipes)
    lines = [
        "% " + " ".join(caption.split()),
        r"\begin{tabular}{l" + "r" * len(recipes) + "}",
        r"\hline",
        " & ".join(map(escape_latex, heading)) + r" \\",
        r"\hline",
        *(" & ".join([escape_latex(row[0]), *map(_number, row[1:])]) + r" \\" for row in rows),
        r"\hline",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def escape_latex(text: str) -> str:
    """Return a text as LaTeX sets it, with its special characters escaped."""
    return "".join(SPECIAL.get(character, character) for character in text)


def _number(cell: str) -> str:
    """Return a cell with signs of numbers as minus, which is longer than a hyphen, and ratios with a cross."""
    signed = re.sub(r"(?<![\w.])-(?=\d)", "$-$", escape_latex(cell))
    return re.sub(r"(?<=\d)x(?=\))", r"$\\times$", signed)
