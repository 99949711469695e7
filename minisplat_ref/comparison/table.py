"""The table of a comparison as text: a row per measure, a column per recipe."""

from collections.abc import Sequence

from minisplat_ref.comparison.measures import MEASURES, Measure, RecipeMeasures, relation

NOT_REACHED = "not reached"


def table_cells(recipes: Sequence[RecipeMeasures]) -> list[list[str]]:
    """Return the table: the heading, then a row per measure, each beginning with what it is."""
    heading = ["", *(recipe.recipe for recipe in recipes)]
    return [heading, *([measure.title, *_row(measure, recipes)] for measure in MEASURES if _is_known(measure, recipes))]


def _is_known(measure: Measure, recipes: Sequence[RecipeMeasures]) -> bool:
    """Return False for the distance to a true surface where there is no such thing; what else lacks is told."""
    return measure.key != "chamfer" or any(run[measure.key] is not None for recipe in recipes for run in recipe.runs)


def _row(measure: Measure, recipes: Sequence[RecipeMeasures]) -> list[str]:
    first = recipes[0]
    return [
        _value(measure, recipe) + (_relation(measure, recipe, first) if recipe is not first else "")
        for recipe in recipes
    ]


def _value(measure: Measure, recipe: RecipeMeasures) -> str:
    mean, std = recipe.spread_of(measure)
    if mean is None:
        return _missing(measure, recipe)
    deviation = "" if std is None else f" ± {std:{measure.format}}"
    return f"{mean:{measure.format}}{deviation}"


def _missing(measure: Measure, recipe: RecipeMeasures) -> str:
    if measure.key not in ("seconds_to_first", "iterations_to_first"):
        return "null"
    n_reached = sum(run[measure.key] is not None for run in recipe.runs)
    return f"{NOT_REACHED} by {len(recipe.runs) - n_reached} of {len(recipe.runs)}" if n_reached else NOT_REACHED


def _relation(measure: Measure, recipe: RecipeMeasures, first: RecipeMeasures) -> str:
    related = relation(measure, recipe.spread_of(measure), first.spread_of(measure))
    if related is None:
        return ""
    if measure.relation == "ratio":
        return f" ({related:.3g}x)"
    error = recipe.error_of_difference(measure, first)
    return f" ({related:+{measure.format}}" + (")" if error is None else f" ± {error:{measure.format}})")
