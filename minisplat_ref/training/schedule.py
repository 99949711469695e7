"""What a recipe is made of: events with their iterations, rates, milestones; and how it is scaled and described."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from minisplat_ref.errors import InputError
from minisplat_ref.training.adam import AdamRule
from minisplat_ref.training.rates import LearningRates, LogLinear, Rewind
from minisplat_ref.types import GeometricWeights

Action = Callable[..., None]
"""``action(state, iteration)``; see :mod:`minisplat_ref.methods`. Settings are bound with ``functools.partial``."""


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
    least_step: int = 0
    """The action never happens before this iteration, however far the recipe is compressed."""

    def is_due(self, step: int) -> bool:
        """Return whether the action belongs to iteration ``step``, counted from 1."""
        is_inside = max(self.start + 1, self.least_step) <= step and (self.stop is None or step < self.stop)
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
    least_step: int = 0
    """The action does not happen at all if scaling moves it before this iteration."""

    def is_due(self, step: int) -> bool:
        """Return whether the action belongs to iteration ``step``, counted from 1."""
        return step == self.step and step >= self.least_step

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
    half_size_until: int = 0
    """Iterations that train on views of half the width and height, from the first on (Mini-Splatting2)."""
    least_views: int = 1
    """Training views without which the method makes no sense."""
    short_run_exponent: float = 0.0
    """p of the factor ``(published / iterations)^p`` by which :func:`scaled` raises the rates of runs that are shorter
    than published; that of the means by the square of it."""
    geometry: GeometricWeights = GeometricWeights()
    """Geometric loss terms beside the photometric one; none in any of the papers here."""


def scaled(recipe: Recipe, iterations: int) -> Recipe:
    """Return the recipe for another number of iterations, all milestones moved in proportion.

    Start, stop and period of each event, the spherical-harmonic milestones and the length of the position schedule are
    multiplied by ``iterations / recipe.iterations`` and rounded to the nearest integer (ties to even); a one-time event
    happens at iteration 1 at the earliest, a period is at least the event's ``least_period``. Because the period is
    rounded by itself, the number of events can differ by a few from the original's. What must not come before its
    ``least_step`` is left out of runs that are too short for it. Thresholds stay; so do learning rates, unless the
    recipe has a ``short_run_exponent``.

    Raises
    ------
    InputError
        ``iterations`` is below 1.
    """
    if iterations < 1:
        raise InputError(f"iterations is {iterations}: give at least 1")
    factor = iterations / recipe.iterations
    raised = max(1.0, 1 / factor) ** recipe.short_run_exponent
    others = recipe.learning_rates._asdict()
    means_rate = others.pop("means")
    rewind = means_rate.rewind
    return recipe._replace(
        iterations=iterations,
        learning_rates=LearningRates(
            means=LogLinear(
                means_rate.first * raised**2,
                means_rate.last * raised**2,
                max(1, _scaled(means_rate.steps, factor)),
                rewind and Rewind(_scaled(rewind.at, factor), _scaled(rewind.to, factor)),
            ),
            **{name: rate * raised for name, rate in others.items()},
        ),
        sh_milestones=tuple(_scaled(milestone, factor) for milestone in recipe.sh_milestones),
        events=tuple(event.scaled(factor) for event in recipe.events),
        half_size_until=_scaled(recipe.half_size_until, factor),
    )


def configured(recipe: Recipe, **settings: Any) -> Recipe:
    """Return the recipe with settings of its events replaced, each wherever an event has it.

    Raises
    ------
    InputError
        No event has such a setting.
    """
    for name, value in settings.items():
        if not any(name in _settings(event) for event in recipe.events):
            raise InputError(f"recipe {recipe.name} has no {name.replace('_', ' ')} to set: leave it out")
        recipe = recipe._replace(
            events=tuple(
                event._replace(action=partial(event.action, **{name: value})) if name in _settings(event) else event
                for event in recipe.events
            )
        )
    return recipe


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
        "geometry": recipe.geometry._asdict(),
        "sh_milestones": list(recipe.sh_milestones),
        "events": [_describe_event(event) for event in recipe.events],
    }


def _describe_event(event: Event) -> dict[str, Any]:
    settings = {name: _describe_setting(value) for name, value in _settings(event).items()}
    return {"event": type(event).__name__, **event._asdict(), "action": _name(event.action), "settings": settings}


def _describe_setting(value: Any) -> Any:
    return _name(value) if callable(value) else value


def _name(function: Any) -> str:
    """Return what a function is called; a partial by the function inside."""
    function = function.func if isinstance(function, partial) else function
    return getattr(function, "__name__", repr(function))


def _settings(event: Event) -> dict[str, Any]:
    return dict(event.action.keywords) if isinstance(event.action, partial) else {}
