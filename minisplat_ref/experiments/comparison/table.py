"""The table of a comparison as text: a row per measure, a column per recipe."""

from collections.abc import Sequence

from minisplat_ref.experiments.comparison.measures import MEASURES, Measure, RecipeMeasures, Spread, relation

NOT_REACHED = "not reached"


def table_cells(recipes: Sequence[RecipeMeasures]) -> list[list[str]]:
    """Return the table: the heading, then a row per measure, each beginning with what it is."""
    heading = ["", *(recipe.recipe for recipe in recipes)]
    return [heading, *([measure.title, *_row(measure, recipes)] for measure in MEASURES)]


def _row(measure: Measure, recipes: Sequence[RecipeMeasures]) -> list[str]:
    first, *others = (recipe.spread_of(measure) for recipe in recipes)
    cells = [_value(measure, first, recipes[0])]
    for recipe, value in zip(recipes[1:], others, strict=True):
        related = relation(measure, value, first)
        cells.append(_value(measure, value, recipe) + ("" if related is None else f" ({_relation(measure, related)})"))
    return cells


def _value(measure: Measure, value: Spread, recipe: RecipeMeasures) -> str:
    if value.mean is None:
        return _missing(measure, recipe)
    deviation = "" if value.std is None else f" ± {value.std:{measure.format}}"
    return f"{value.mean:{measure.format}}{deviation}"


def _missing(measure: Measure, recipe: RecipeMeasures) -> str:
    if measure.key != "seconds_to_first":
        return "null"
    n_reached = sum(run[measure.key] is not None for run in recipe.runs)
    return f"{NOT_REACHED} by {len(recipe.runs) - n_reached} of {len(recipe.runs)}" if n_reached else NOT_REACHED


def _relation(measure: Measure, related: float) -> str:
    return f"{related:+{measure.format}}" if measure.relation == "difference" else f"{related:.3g}x"
