"""Recipes: all that distinguishes one training method from another, as data.

A recipe is written for its published number of iterations; :func:`scaled` compresses or stretches it. Events act after
the optimiser step of their iteration, in the order in which they are listed.
"""

from minisplat_ref.errors import InputError
from minisplat_ref.recipes.gaussian_splatting import GS, GS_ACCEL
from minisplat_ref.recipes.mini_splatting import MINI_SPLATTING, MINI_SPLATTING_D
from minisplat_ref.recipes.mini_splatting2 import MINI_SPLATTING2, MINI_SPLATTING2_D
from minisplat_ref.recipes.schedule import At, During, Event, Every, Recipe, configured, describe, scaled

__all__ = ["RECIPES", "At", "During", "Event", "Every", "Recipe", "configured", "describe", "get_recipe", "scaled"]

RECIPES = {
    recipe.name: recipe
    for recipe in (GS, GS_ACCEL, MINI_SPLATTING, MINI_SPLATTING_D, MINI_SPLATTING2, MINI_SPLATTING2_D)
}
"""All recipes by name."""


def get_recipe(name: str, iterations: int | None = None) -> Recipe:
    """Return the recipe of that name, scaled if ``iterations`` is given.

    Raises
    ------
    InputError
        There is no such recipe, or ``iterations`` is below 1.
    """
    if name not in RECIPES:
        raise InputError(f"recipe {name!r} does not exist: choose from {', '.join(RECIPES)}")
    return RECIPES[name] if iterations is None else scaled(RECIPES[name], iterations)
