"""The methods, one file per paper: the actions of the method, and the recipe with their schedule.

A recipe is data (:mod:`minisplat_ref.training.schedule`), written for its published number of iterations.
"""

from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import suggest
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.methods.gaussian_splatting import GS, GS_ACCEL
from minisplat_ref.methods.mini_splatting import MINI_SPLATTING, MINI_SPLATTING_D
from minisplat_ref.methods.mini_splatting2 import MINI_SPLATTING2, MINI_SPLATTING2_D
from minisplat_ref.training.schedule import Recipe, scale_recipe

__all__ = ["RECIPES", "get_recipe"]

RECIPES = {
    recipe.name: recipe
    for recipe in (GS, GS_ACCEL, MINI_SPLATTING, MINI_SPLATTING_D, MINI_SPLATTING2, MINI_SPLATTING2_D, ADAPTIVE)
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
        raise InputError(f"recipe {name!r} does not exist{suggest(name, RECIPES)}")
    return RECIPES[name] if iterations is None else scale_recipe(RECIPES[name], iterations)
