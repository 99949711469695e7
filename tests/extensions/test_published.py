"""The dates and constants of all recipes with a paper, held to the tables of ``data_tools.published``.

Each row of these names the released code, at a commit, or the place in the paper; ``python -m data_tools.published
CLONES`` compares them with the code. What a row calls ours is a choice of this program, which has its reason beside it
in the code. ``adaptive`` has no paper.
"""

import functools
from functools import partial
from importlib import import_module

import pytest

from data_tools.published.constants import CONSTANTS
from data_tools.published.relatives import TABLES
from minisplat_ref.extensions.extension import find_recipe, load_extensions
from minisplat_ref.methods import RECIPES
from minisplat_ref.training.rates import LogLinear
from minisplat_ref.training.schedule import During, SmallerViews, action_name


@functools.cache
def dates_of(event, iterations):
    """The iterations of an event whose action is left out, as most recipes share them."""
    return [step for step in range(1, iterations + 1) if event.is_due(step)]


def settings_of(name, function):
    """The numbers bound to a function, and the names of the functions bound to it."""
    bound = function.keywords if isinstance(function, partial) else {}
    return {f"{name}.{key}": getattr(value, "__name__", value) for key, value in bound.items()}


def facts_of(recipe):
    """All dates and constants of a recipe, named as in the tables; several events of an action have lists."""
    facts = {name: getattr(recipe, name) for name in ("iterations", "min_views", "short_run_exponent")}
    facts |= {"sh_degree": (recipe.sh_degree, *recipe.sh_milestones), "adam": tuple(recipe.adam)}
    for name, rate in recipe.rates.of.items():
        is_number = not isinstance(rate, LogLinear)
        facts[f"rate.{name}"] = rate if is_number else (*rate[:3], *(rate.rewind or ()))
    facts["per_extent"] = sorted(recipe.rates.per_extent)
    for term in recipe.losses:
        facts |= {term.name: (term.weight, term.start + 1)} | settings_of(term.name, term.function)
        assert term.stop is None
    together = {}
    for event in recipe.events:
        name = action_name(event)
        facts.setdefault(name, []).append(dates_of(event._replace(action=None), recipe.iterations))
        gap = {f"{name}.min_gap": event.min_gap} if getattr(event, "min_gap", 1) > 1 else {}
        for key, value in (settings_of(name, event.action) | gap).items():
            together.setdefault(key, []).append(value)
    facts |= {key: found[0] if len(set(found)) == 1 else found for key, found in together.items()}
    facts |= settings_of("extend", recipe.representation.extend)
    return facts | settings_of("render", recipe.representation.renderer.render)


@pytest.mark.parametrize("name", TABLES)
def test_a_recipe_has_the_published_dates_and_constants(name):
    found, table = facts_of(find_recipe(name)), TABLES[name]
    assert found.keys() == table.keys()
    for key, row in table.items():
        expected = pytest.approx(row.value, rel=1e-12) if isinstance(row.value, float) else row.value
        assert found[key] == expected, (key, row.source)


def test_every_recipe_with_a_paper_has_a_table():
    names = {recipe.name for extension in load_extensions() for recipe in extension.recipes}
    assert names | RECIPES.keys() - {"adaptive"} <= TABLES.keys()


@pytest.mark.parametrize("name", CONSTANTS)
def test_a_constant_is_the_published_one(name):
    module, constant = name.rsplit(".", 1)
    assert getattr(import_module(module), constant) == pytest.approx(CONSTANTS[name].value, rel=1e-6)


@pytest.mark.parametrize("event", [During, SmallerViews])
def test_dates_leave_out_what_they_say(event):
    """By hand: strictly between for ``During``, the last one included for smaller views."""
    assert dates_of(event(None, 2, 5), 9) == ([3, 4] if event is During else [3, 4, 5])
