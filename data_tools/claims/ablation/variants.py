"""Recipes with one change: without one mechanism, or with a published rule in place of ours.

Each change is a function of a published recipe, and returns a recipe that it does not concern unchanged.
:func:`variants_of` scales the changed recipes to the length of the trainings. ``docs/FIDELITY.md`` says why we deviate.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from minisplat_ref.methods import gaussian_splatting, mini_splatting, mini_splatting2
from minisplat_ref.rendering import Request
from minisplat_ref.strategy import simplify as simplification
from minisplat_ref.strategy.blur_split import principal_axis_children
from minisplat_ref.training.adam import AdamState
from minisplat_ref.training.recipe_settings import configure, settings_of
from minisplat_ref.training.schedule import (
    At,
    DatedEvent,
    During,
    Event,
    Every,
    Recipe,
    does,
    firing_steps,
    scale_recipe,
    without,
)
from minisplat_ref.training.smaller_views import SIDE_MIN, halve_large_views
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Model, View

FULL = "everything"
Change = Callable[[Recipe], Recipe]


def with_settings(**settings: Any) -> Change:
    """Return a function that replaces settings of a recipe, and returns a recipe without all of them unchanged."""
    return lambda recipe: configure(recipe, **settings) if settings.keys() <= settings_of(recipe).keys() else recipe


def with_bias_correction(recipe: Recipe) -> Recipe:
    """Return 3dgs-accel with bias correction, the baseline of Mini-Splatting2's tables; other recipes have it."""
    return recipe._replace(adam=recipe.adam._replace(has_bias_correction=True))


def as_3dgs_prunes(recipe: Recipe) -> Recipe:
    """Return the recipe with the size limit of 3DGS, which is the same near and far."""

    def changed(event: Event) -> Event:
        if not does(event, mini_splatting.prune_large_by_distance):
            return event
        return event._replace(action=partial(gaussian_splatting.prune_large, size_fraction=0.1))

    return recipe._replace(events=tuple(map(changed, recipe.events)))


def with_all_events(recipe: Recipe) -> Recipe:
    """Return the recipe with all published density events and opacity resets, however few iterations lie between."""
    events = (event._replace(min_gap=1) if isinstance(event, Every) else event for event in recipe.events)
    return recipe._replace(events=tuple(events))


def with_culled_depths(recipe: Recipe) -> Recipe:
    """Return the recipe that renders culled views for its depths, if it culls views: Mini-Splatting2."""

    def changed(event: Event) -> Event:
        settings = event.action.keywords if isinstance(event.action, partial) else {}
        if not does(event, mini_splatting.reinitialise_from_depth) or settings.get("drawn_mass") is None:
            return event
        return event._replace(action=partial(reinitialise_from_culled, **settings))

    return recipe._replace(events=tuple(map(changed, recipe.events)))


def reinitialise_from_culled(state: TrainState, iteration: Iteration, **settings: Any) -> None:
    """Start again from the depths of culled views.

    Otherwise like :func:`mini_splatting.reinitialise_from_depth`: importance is still measured with all Gaussians.
    """
    rendered_by = iteration.render_settings

    def render(model: Model, view: View, request: Request) -> Any:
        if "surface" in request.wants and mini_splatting.is_culling(state):
            request = request._replace(is_visible=state.stats["is_visible"][:, view.view_id])
        return rendered_by.renderer.render(model, view, request)

    renderer = rendered_by.renderer._replace(render=render)
    culled = iteration._replace(render_settings=rendered_by._replace(renderer=renderer))
    mini_splatting.reinitialise_from_depth(state, culled, **settings)


TAKES_ITS_STEP = (
    gaussian_splatting.reset_opacity,
    gaussian_splatting.reset_opacity_on_white,
    mini_splatting.store_sh,
    mini_splatting.restart_adam,
    mini_splatting2.stop_culling,
)
"""Actions for which the released code loses no step, or only the step of the array that they overwrite anyway.

``store_sh`` and ``restart_adam`` act beside an action that is not listed, which loses the step.
"""


def with_lost_steps(recipe: Recipe) -> Recipe:
    """Return the recipe without the gradient steps that the released code loses.

    The released code replaces the parameters after it has computed their gradients and before it takes the step. The
    new tensors have no gradient, so the step does nothing; the last iteration takes none at all. Here events follow the
    step, so the recipe undoes the step before such an event.
    """
    before: list[tuple[int, Any, AdamState[Any]]] = []  # number of the previous iteration, and the state at its end

    def copied(bundle: Any) -> Any:
        return bundle._make(field.copy() for field in bundle)

    def remember(state: TrainState, iteration: Iteration) -> None:
        adam = state.adam._replace(first=copied(state.adam.first), second=copied(state.adam.second))
        before[:] = [(iteration.step, copied(state.gaussians), adam)]

    def undo_step(state: TrainState, iteration: Iteration) -> None:
        if before and before[0][0] == iteration.step - 1:
            _, state.gaussians, state.adam = before[0]

    edits = [event for event in recipe.events if isinstance(event, DatedEvent) and not does(event, *TAKES_ITS_STEP)]
    undoing = [event._replace(action=undo_step) for event in (*edits, At(recipe.iterations, undo_step))]
    events = (*undoing, *recipe.events, During(remember))
    return recipe._replace(events=events)


def without_half_size(recipe: Recipe) -> Recipe:
    """Return the recipe with views at full size from the start; ``adaptive`` has its own rule."""
    return recipe if recipe.cooling is not None else without(recipe, halve_large_views)


def with_half_size_of_small_views(recipe: Recipe) -> Recipe:
    """Return the recipe with half-size views however small they are, down to a tile."""
    return recipe if recipe.cooling is not None else with_settings(min_side=SIDE_MIN)(recipe)


HALVES = with_settings(draw_children=principal_axis_children)
"""With children that are cut on the longest axis; the released code, and so the recipes, draw them at random."""

MECHANISMS: Mapping[str, Change] = {
    "blur split": partial(without, action=mini_splatting.collect_blur),
    "random children": HALVES,
    "blur split and random children": lambda recipe: HALVES(without(recipe, mini_splatting.collect_blur)),
    "reinitialisation": partial(without, action=mini_splatting.reinitialise_from_depth),
    "sky guard": with_settings(depth_tolerance=None),
    "intersection preservation": with_settings(is_intersecting=False),
    "sampling": with_settings(choose=simplification.by_rank),  # keeps the most important ones instead
    "restart": partial(without, action=mini_splatting.restart_from_means),
    "culling": with_settings(visibility_mass=1.0),  # every Gaussian with any weight in a view is visible
    "clone": with_settings(factor=1),
    "half-size warm-up": without_half_size,
    "last prune": partial(without, action=mini_splatting.prune_tail),
}
"""The published recipe without each mechanism; a recipe that does not have it stays unchanged.

Blur split has four forms. The split by gradients uses the same rule for children, and its effect has to be separated
from that of blur split, so the rule for children is also exchanged where there is no blur split.
"""

DEVIATIONS: Mapping[str, Change] = {
    "least blurred area": with_settings(min_area=0),
    "cap of the population": with_settings(max_per_pixel=math.inf),
    "sky guard": with_settings(depth_tolerance=None),
    "size limit by distance": as_3dgs_prunes,
    "size limit of new points": with_settings(largest_size=math.inf),
    "least size to halve": with_half_size_of_small_views,
    "raised rates": lambda recipe: recipe._replace(short_run_exponent=0.0),
    "fewer events": with_all_events,
    "depths of whole views": with_culled_depths,
    "no step lost": with_lost_steps,
    "no bias correction": with_bias_correction,
}
"""A recipe with the published rule in place of each of ours."""

ACTIONS: Mapping[str, Callable[..., Any]] = {
    "blur split": gaussian_splatting.clone_and_split,
    "random children": gaussian_splatting.clone_and_split,
    "blur split and random children": gaussian_splatting.clone_and_split,
    "reinitialisation": mini_splatting.reinitialise_from_depth,
    "sky guard": mini_splatting.reinitialise_from_depth,
    "intersection preservation": mini_splatting.simplify,
    "sampling": mini_splatting.simplify,
    "restart": mini_splatting.restart_from_means,
    "culling": mini_splatting2.aggressive_clone,
    "clone": mini_splatting2.aggressive_clone,
    "half-size warm-up": halve_large_views,
    "last prune": mini_splatting.prune_tail,
}
"""The action through which a mechanism acts."""


def variants_of(published: Recipe, iterations: int, rules: Mapping[str, Change] = MECHANISMS) -> dict[str, Recipe]:
    """Return the recipe scaled to ``iterations``, and each changed recipe that differs from it within this length."""

    def of_length(recipe: Recipe) -> Recipe:
        return scale_recipe(recipe, iterations)._replace(short_run_exponent=0.0)  # the rates are already raised

    full = of_length(published)
    variants = {name: of_length(take_out(published)) for name, take_out in rules.items()}
    differ = {name: variant for name, variant in variants.items() if with_strides(variant) != with_strides(full)}
    return {FULL: full, **{name: v for name, v in differ.items() if name not in MECHANISMS or has_date(full, name)}}


def with_strides(recipe: Recipe) -> Recipe:
    """Return the recipe with the gaps that its events have: a lower bound that moves no date makes no difference."""
    events = (event._replace(min_gap=event.stride) if isinstance(event, Every) else event for event in recipe.events)
    return recipe._replace(events=tuple(events))


def has_date(recipe: Recipe, mechanism: str) -> bool:
    """Return whether a mechanism acts in some iteration of the recipe."""
    return bool(firing_steps(recipe, ACTIONS[mechanism]))
