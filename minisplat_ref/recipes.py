"""Recipes: all that distinguishes one training method from another, as data.

A recipe is written for its published number of iterations; :func:`scaled` compresses or stretches it. Events act after
the optimiser step of their iteration, in the order in which they are listed.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from minisplat_ref import events
from minisplat_ref.errors import InputError
from minisplat_ref.optim.adam import AdamRule
from minisplat_ref.optim.schedules import LearningRates, LogLinear

Action = Callable[..., None]
"""``action(state, iteration)``; see :mod:`minisplat_ref.events`. Settings are bound with ``functools.partial``."""


class During(NamedTuple):
    """Act in every iteration with ``start < step < stop``. Scaling keeps it at every iteration."""

    action: Action
    start: int = 0
    stop: int | None = None
    needs_blend_stats: bool = False
    """Render these iterations with blend statistics, for the action to find in ``iteration.output.stats``."""

    def is_due(self, step: int) -> bool:
        """Return whether the action belongs to iteration ``step``, counted from 1."""
        return self.start < step and (self.stop is None or step < self.stop)

    def scaled(self, factor: float) -> "During":
        """Return the event with all milestones multiplied by ``factor``."""
        return self._replace(start=_scaled(self.start, factor), stop=_scaled_limit(self.stop, factor))


class Every(NamedTuple):
    """Act at the multiples of ``period`` with ``start < step < stop``, except those of ``skip``."""

    period: int
    action: Action
    start: int = 0
    stop: int | None = None
    skip: int | None = None
    least_period: int = 1
    """Scaling does not make the period shorter than this."""

    def is_due(self, step: int) -> bool:
        """Return whether the action belongs to iteration ``step``, counted from 1."""
        is_inside = self.start < step and (self.stop is None or step < self.stop)
        is_skipped = self.skip is not None and step % self.skip == 0
        return is_inside and step % self.period == 0 and not is_skipped

    def scaled(self, factor: float) -> "Every":
        """Return the event with all milestones multiplied by ``factor`` and the period at least ``least_period``."""
        return self._replace(
            period=max(self.least_period, _scaled(self.period, factor)),
            start=_scaled(self.start, factor),
            stop=_scaled_limit(self.stop, factor),
            skip=None if self.skip is None else max(1, _scaled(self.skip, factor)),
        )


class At(NamedTuple):
    """Act once, at iteration ``step``."""

    step: int
    action: Action

    def is_due(self, step: int) -> bool:
        """Return whether the action belongs to iteration ``step``, counted from 1."""
        return step == self.step

    def scaled(self, factor: float) -> "At":
        """Return the event with its iteration multiplied by ``factor``, at least the first."""
        return self._replace(step=max(1, _scaled(self.step, factor)))


Event = During | Every | At


class Recipe(NamedTuple):
    """A training method."""

    name: str
    iterations: int
    """One training view each."""
    learning_rates: LearningRates
    adam: AdamRule
    sh_degree: int
    """Degree that the initial Gaussians store."""
    sh_milestones: tuple[int, ...]
    """Iterations at which the rendered degree rises by one, starting from 0."""
    dssim_weight: float
    """w in the loss (1 - w) L1 + w (1 - SSIM)."""
    has_random_background: bool
    """Render each iteration over a random colour rather than the scene's background."""
    events: tuple[Event, ...]
    """What happens besides gradient steps; several due in one iteration act in this order."""


def scaled(recipe: Recipe, iterations: int) -> Recipe:
    """Return the recipe for another number of iterations, all milestones moved in proportion.

    Start, stop and period of each event, the spherical-harmonic milestones and the length of the position schedule are
    multiplied by ``iterations / recipe.iterations`` and rounded to the nearest integer (ties to even); a one-time event
    happens at iteration 1 at the earliest, a period is at least the event's ``least_period``. Because the period is
    rounded by itself, the number of events can differ by a few from the original's. Learning rates and thresholds stay.

    Raises
    ------
    InputError
        ``iterations`` is below 1.
    """
    if iterations < 1:
        raise InputError(f"iterations is {iterations}: give at least 1")
    factor = iterations / recipe.iterations
    means_rate = recipe.learning_rates.means
    return recipe._replace(
        iterations=iterations,
        learning_rates=recipe.learning_rates._replace(
            means=means_rate._replace(steps=max(1, _scaled(means_rate.steps, factor)))
        ),
        sh_milestones=tuple(_scaled(milestone, factor) for milestone in recipe.sh_milestones),
        events=tuple(event.scaled(factor) for event in recipe.events),
    )


def _scaled(step: int, factor: float) -> int:
    return round(step * factor)


def _scaled_limit(step: int | None, factor: float) -> int | None:
    return None if step is None else _scaled(step, factor)


def describe(recipe: Recipe) -> dict[str, Any]:
    """Return the recipe in numbers, strings, lists and dicts, for ``config.json`` and to compare two recipes."""
    return {
        **recipe._asdict(),
        "learning_rates": {**recipe.learning_rates._asdict(), "means": recipe.learning_rates.means._asdict()},
        "adam": recipe.adam._asdict(),
        "sh_milestones": list(recipe.sh_milestones),
        "events": [_describe_event(event) for event in recipe.events],
    }


def _describe_event(event: Event) -> dict[str, Any]:
    action = event.action if isinstance(event.action, partial) else partial(event.action)
    return {
        "event": type(event).__name__,
        **event._asdict(),
        "action": getattr(action.func, "__name__", repr(action.func)),
        "settings": dict(action.keywords),
    }


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


# Densification needs the mean gradient over about all views, and time to settle: each event multiplies the Gaussians
# by up to two, so that events compressed to every few iterations let their number explode. What an opacity reset fades
# needs some hundred iterations to come back.
_densifying = partial(Every, 100, stop=15_000, least_period=100)

_3DGS = Recipe(
    name="3dgs",
    iterations=30_000,
    learning_rates=LearningRates(
        means=LogLinear(1.6e-4, 1.6e-6, 30_000),
        quats=1e-3,
        log_scales=5e-3,
        opacity_logits=5e-2,
        sh_dc=2.5e-3,
        sh_rest=2.5e-3 / 20,
    ),
    adam=AdamRule(is_visible_only=False, has_bias_correction=True),
    sh_degree=3,
    sh_milestones=(1_000, 2_000, 3_000),
    dssim_weight=0.2,
    has_random_background=False,
    events=(
        During(events.collect_gradients, stop=15_000),
        _densifying(partial(events.clone_and_split, threshold=2e-4, size_fraction=0.01), start=500),
        _densifying(partial(events.prune_faint, least_opacity=0.005), start=500),
        _densifying(partial(events.prune_large, size_fraction=0.1), start=3_000),
        Every(3_000, partial(events.reset_opacity, ceiling=0.01), stop=15_000, least_period=300),
        At(500, partial(events.reset_opacity_on_white, ceiling=0.01)),
    ),
)

_3DGS_ACCEL = _3DGS._replace(
    name="3dgs-accel",
    learning_rates=_3DGS.learning_rates._replace(opacity_logits=2.5e-2),
    adam=AdamRule(is_visible_only=True, has_bias_correction=False),
)

RECIPES = {recipe.name: recipe for recipe in (_3DGS, _3DGS_ACCEL)}
"""``3dgs``: Kerbl et al. 2023 as released. ``3dgs-accel``: the same with the authors' later optimiser settings."""
