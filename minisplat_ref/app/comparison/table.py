"""The table of a comparison as text: a row per metric, a column per recipe."""

from collections.abc import Sequence

from minisplat_ref.app.comparison.metrics import METRICS, Metric, RecipeMetrics, relation

NOT_REACHED = "not reached"


def table_cells(recipes: Sequence[RecipeMetrics]) -> list[list[str]]:
    """Return the table: the heading, then a row per metric, each beginning with its name."""
    heading = ["", *(recipe.recipe for recipe in recipes)]
    return [heading, *([metric.title, *_row(metric, recipes)] for metric in METRICS if _is_known(metric, recipes))]


def photograph_cells(recipes: Sequence[RecipeMetrics]) -> list[list[str]]:
    """Return the table of the PSNR of each photograph that was held out once, with the differences from the first."""

    def cell(ours: float | None, first: float | None, is_first: bool) -> str:
        if ours is None:
            return "null"
        return f"{ours:.2f}" + ("" if is_first or first is None else f" ({ours - first:+.2f})")

    heading = ["PSNR (dB)", *(recipe.recipe for recipe in recipes)]
    first = recipes[0].photographs
    rows = [
        [name, *(cell(r.photographs[name]["psnr"], first[name]["psnr"], r is recipes[0]) for r in recipes)]
        for name in first
    ]
    return [heading, *rows]


def _is_known(metric: Metric, recipes: Sequence[RecipeMetrics]) -> bool:
    """Return False for the distance to a true surface where there is no such thing; what else lacks is told."""
    return metric.key != "chamfer" or any(run[metric.key] is not None for recipe in recipes for run in recipe.runs)


def _row(metric: Metric, recipes: Sequence[RecipeMetrics]) -> list[str]:
    first = recipes[0]
    return [
        _value(metric, recipe) + (_relation(metric, recipe, first) if recipe is not first else "") for recipe in recipes
    ]


def _value(metric: Metric, recipe: RecipeMetrics) -> str:
    mean, std = recipe.compute_spread(metric)
    if mean is None:
        return _missing(metric, recipe)
    width = recipe.compute_error(metric) if recipe.is_per_photograph(metric) else std
    deviation = "" if width is None else f" ± {width:{metric.format}}"
    return f"{mean:{metric.format}}{deviation}"


def _missing(metric: Metric, recipe: RecipeMetrics) -> str:
    if metric.key not in ("seconds_to_first", "iterations_to_first"):
        return "null"
    n_reached = sum(run[metric.key] is not None for run in recipe.runs)
    return f"{NOT_REACHED} by {len(recipe.runs) - n_reached} of {len(recipe.runs)}" if n_reached else NOT_REACHED


def _relation(metric: Metric, recipe: RecipeMetrics, first: RecipeMetrics) -> str:
    related = relation(metric, recipe.compute_spread(metric), first.compute_spread(metric))
    if related is None:
        return ""
    if metric.relation == "ratio":
        return f" ({related:.3g}x)"
    error = recipe.error_of_difference(metric, first)
    return f" ({related:+{metric.format}}" + (")" if error is None else f" ± {error:{metric.format}})")
