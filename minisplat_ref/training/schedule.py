"""A training method as data: its events and their iterations, scaling to another length, and a description.

Events act after the optimiser step of their iteration, in the order in which they are listed.
:mod:`minisplat_ref.training.recipe_settings` changes the settings of a recipe.
"""

import functools
import math
from collections.abc import Callable, Mapping
from fractions import Fraction
from functools import partial
from typing import Any, NamedTuple

from minisplat_ref.errors import InputError
from minisplat_ref.rendering import Renderer
from minisplat_ref.training.adam import AdamRule
from minisplat_ref.training.calibration import CALIBRATIONS, NONE, Calibration
from minisplat_ref.training.dropout import OPEN_LENGTH, drop_share
from minisplat_ref.training.losses import LossTerm, photometric, photometric_of_part
from minisplat_ref.training.pace import Cooling, Pace
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import GAUSSIANS, Representation

Action = Callable[..., str | None]
"""``action(state, iteration)``; see :mod:`minisplat_ref.training.state`. Its settings are bound with ``partial``."""

BLEND_STATS = frozenset({"stats"})
"""For ``During.wants``: the action finds blend statistics in ``iteration.output.stats``."""


class During(NamedTuple):
    """Act in every iteration with ``start < step < stop``. Scaling keeps it at every iteration."""

    action: Action
    start: int = 0
    stop: int | None = None
    wants: frozenset[str] = frozenset()
    """Outputs that the action needs in these iterations; see :class:`minisplat_ref.rendering.Request`."""
    reads_parameters: bool = True
    """Whether the action reads or changes parameters or moments, for which a GPU copies all of them in each of these
    iterations. An action that seldom does may have False here and call ``iteration.fetch()`` first."""

    def is_due(self, step: int) -> bool:
        """Return whether the action belongs to iteration ``step``, counted from 1."""
        return self.start < step and (self.stop is None or step < self.stop)

    def scale(self, factor: Fraction) -> "During":
        """Return the event with all milestones multiplied by ``factor``."""
        return self._replace(start=_scale_step(self.start, factor), stop=_scale_limit(self.stop, factor))


class Every(NamedTuple):
    """Act at the multiples of ``period`` with ``start < step < stop``, except those of ``skip``.

    These iterations are the published ones. In a run of another length the action comes at ``factor`` times each of
    them, rounded like every other milestone, so that the order of events stays and all gaps shrink alike.
    """

    period: int
    action: Action
    start: int = 0
    stop: int | None = None
    skip: int | None = None
    min_gap: int = 1
    """Minimum number of iterations between two actions, and from the last one to ``stop``. Where a shorter run would go
    below it, only every second published iteration stays, or every third, and so on, counted back from ``stop``."""
    factor: Fraction = Fraction(1)
    """Length of the run, divided by the published length."""

    @property
    def stride(self) -> int:
        """Return the number of published iterations from one action that stays to the next."""
        return self.period * math.ceil(self.min_gap / (self.period * self.factor))

    def is_due(self, step: int) -> bool:
        """Return whether the action belongs to iteration ``step``, counted from 1."""
        a, b = self.factor.as_integer_ratio()  # the action published for iteration p is due in round(p a / b)
        first, last = (2 * step - 1) * b // (2 * a), (2 * step + 1) * b // (2 * a)
        multiples = range(first + -first % self.period, last + 1, self.period)
        return any(self._stays(p) and _scale_step(p, self.factor) == step for p in multiples)

    def _stays(self, step: int) -> bool:
        """Return whether the action belongs to this multiple of the period in the published schedule, and stays."""
        if step <= self.start or (self.stop is not None and step >= self.stop):
            return False
        is_skipped = self.skip is not None and step % self.skip == 0
        end = 0 if self.stop is None else -(-self.stop // self.period) * self.period  # the first multiple too late
        return not is_skipped and (end - step) % self.stride == 0

    def scale(self, factor: Fraction) -> "Every":
        """Return the event for a run of ``factor`` times the length."""
        return self._replace(factor=self.factor * factor)

    def as_often(self, factor: Fraction) -> "Every":
        """Return the event with a gap that leaves as many actions in ``factor`` times the iterations."""
        return self._replace(min_gap=max(1, _scale_step(self.min_gap, factor)))


class At(NamedTuple):
    """Act once, in iteration ``step``."""

    step: int
    action: Action

    def is_due(self, step: int) -> bool:
        """Return whether the action belongs to iteration ``step``, counted from 1."""
        return step == self.step

    def scale(self, factor: Fraction) -> "At":
        """Return the event with its iteration multiplied by ``factor``, at least the first."""
        return self._replace(step=max(1, _scale_step(self.step, factor)))


class SmallerViews(NamedTuple):
    """Train on smaller views in the iterations with ``start < step <= until``.

    Here the action is ``action(scene)``, called once, before the training. It returns the number of times to halve the
    width and height of the views; see :mod:`minisplat_ref.training.smaller_views`.
    """

    action: Callable[..., Any]
    start: int = 0
    until: int | None = None
    """The last such iteration; None: until the training decides to proceed."""

    def is_due(self, step: int) -> bool:
        """Return whether iteration ``step``, counted from 1, may use smaller views."""
        return self.start < step and (self.until is None or step <= self.until)

    def scale(self, factor: Fraction) -> "SmallerViews":
        """Return the event with both milestones multiplied by ``factor``."""
        return self._replace(start=_scale_step(self.start, factor), until=_scale_limit(self.until, factor))


DatedEvent = Every | At
"""Acts in some iterations only, and may add or remove rows."""

Event = During | DatedEvent | SmallerViews


class Recipe(NamedTuple):
    """A training method."""

    name: str
    iterations: int
    """One training view each."""
    learning_rates: Rates
    adam: AdamRule
    sh_degree: int
    """Degree that the initial Gaussians store."""
    sh_milestones: tuple[int, ...]
    """Iterations at which the rendered degree rises by one, starting from 0."""
    losses: tuple[LossTerm, ...]
    """Terms of the loss."""
    has_random_background: bool
    """Render each iteration over a random colour rather than the scene's background."""
    events: tuple[Event, ...]
    """Events, besides gradient steps; those of the same iteration act in this order."""
    min_views: int = 1
    """Minimum number of training views."""
    short_run_exponent: float = 0.0
    """p of the factor ``(published / iterations)^p`` by which :func:`scale` raises the rates of runs shorter than
    published; the rate of the means is raised by its square."""
    calibrations: tuple[Calibration, ...] = CALIBRATIONS
    """Parameters of each photograph, and a sky; all are off unless switched on."""
    representation: Representation = GAUSSIANS
    """The population that is trained, and its renderer."""
    starts_densely: bool = False
    """Begin with points from stereo besides the sparse points (:mod:`minisplat_ref.training.dense_start`)."""
    dropout: float = 0.0
    """Share of the Gaussians that renderings of the training leave out in the end
    (:mod:`minisplat_ref.training.dropout`)."""
    exposure: str = NONE
    """Whence the photographs' exposures come, one of :data:`~minisplat_ref.training.calibration.EXPOSURE_SOURCES`."""
    cooling: Cooling | None = None
    """The end of a method without a schedule: its milestones do not scale with the length, and ``iterations`` is a
    limit. None for methods with a schedule."""

    @property
    def active_calibrations(self) -> tuple[Calibration, ...]:
        """Return the calibrations that are on."""
        return tuple(calibration for calibration in self.calibrations if calibration.is_on)

    @property
    def renderer(self) -> Renderer:
        """Return the representation's renderer, wrapped by the calibrations that are on."""
        return functools.reduce(
            lambda renderer, calibration: calibration.wrap(renderer),
            self.active_calibrations,
            self.representation.renderer,
        )

    @property
    def rates(self) -> Rates:
        """Return all learning rates: the recipe's, the representation's, the calibrations'."""
        rates = self.learning_rates.join(self.representation.rates)
        return functools.reduce(Rates.join, (calibration.rates for calibration in self.active_calibrations), rates)

    def rates_at(self, step: int, extent: float, pace: Pace) -> dict[str, float]:
        """Return the learning rates of an iteration in a scene of this extent; see :meth:`Cooling.factors`."""
        rates = self.rates
        values = rates.at(step, extent)
        if self.cooling is None:
            return values
        factor, factor_per_extent = self.cooling.factors(step, pace)
        return {name: v * (factor_per_extent if name in rates.per_extent else factor) for name, v in values.items()}

    def drop_share(self, step: int) -> float:
        """Return the share of the Gaussians that an iteration's rendering leaves out."""
        return drop_share(self.dropout, step, self.iterations if self.cooling is None else OPEN_LENGTH)

    def due_terms(self, step: int) -> list[LossTerm]:
        """Return the terms of an iteration's loss."""
        return [term for term in self.losses if term.is_due(step)]

    def due_events(self, step: int) -> list["During | DatedEvent"]:
        """Return the events that act in an iteration, in their order."""
        return [event for event in self.events if isinstance(event, During | DatedEvent) and event.is_due(step)]

    def may_edit(self, step: int) -> bool:
        """Return whether an event of an iteration may add or remove rows."""
        return any(isinstance(event, DatedEvent) for event in self.due_events(step))

    def wants(self, step: int) -> frozenset[str]:
        """Return the outputs of the renderer that terms and events of an iteration need."""
        collecting = [event.wants for event in self.due_events(step) if isinstance(event, During)]
        return frozenset().union(*(term.wants for term in self.due_terms(step)), *collecting)


def does(event: Event, *actions: Callable[..., Any]) -> bool:
    """Return whether an event's action is one of these, whatever settings are bound to it."""
    action: Callable[..., Any] = event.action
    return (action.func if isinstance(action, partial) else action) in actions


def firing_steps(recipe: Recipe, *actions: Callable[..., Any]) -> list[int]:
    """Return the iterations in which one of the actions of a recipe acts."""
    events = [event for event in recipe.events if does(event, *actions)]
    return [step for step in range(1, recipe.iterations + 1) if any(event.is_due(step) for event in events)]


def without(recipe: Recipe, action: Callable[..., Any]) -> Recipe:
    """Return the recipe without the events of ``action``."""
    return recipe._replace(events=tuple(event for event in recipe.events if not does(event, action)))


def scale_recipe(recipe: Recipe, iterations: int) -> Recipe:
    """Return the recipe for another number of iterations, all milestones moved in proportion.

    Every milestone is multiplied by ``iterations / recipe.iterations`` and rounded to the nearest integer (ties to
    even): those of each event and loss term, of the spherical harmonics and of the rates' schedules. So the order of
    events is that of the recipe, whatever the length. A one-time event happens at iteration 1 at the earliest; periodic
    ones may happen less often, see :attr:`Every.min_gap`. Thresholds stay; so do learning rates, unless the recipe or
    the calibration has a ``short_run_exponent``. A recipe that decides its own length changes only in its limit.

    Raises
    ------
    InputError
        ``iterations`` is below 1.
    """
    if iterations < 1:
        raise InputError(f"iterations is {iterations}: give at least 1")
    if recipe.cooling is not None:
        return recipe._replace(iterations=iterations)
    factor = Fraction(iterations, recipe.iterations)
    shortening = max(1.0, float(1 / factor))
    raised = shortening**recipe.short_run_exponent

    def scale_calibration(calibration: Calibration) -> Calibration:
        raised = shortening**calibration.short_run_exponent
        return calibration._replace(rates=calibration.rates.scale(factor, raised, raised))

    return _move_milestones(recipe, iterations, raised)._replace(
        calibrations=tuple(map(scale_calibration, recipe.calibrations)),
        representation=recipe.representation._replace(
            rates=recipe.representation.rates.scale(factor, raised, raised**2)
        ),
    )


def compress_recipe(recipe: Recipe, iterations: int) -> Recipe:
    """Return the recipe for a part of the scene that a share of the photographs shows, in that share of the iterations.

    A Gaussian of the part is as often in a photograph as in the recipe's own iterations, so learning rates stay, and
    periodic events stay as many. Photographs count by the part of their pixels that shows it.
    """
    factor = Fraction(iterations, recipe.iterations)
    as_often = (event.as_often(factor) if isinstance(event, Every) else event for event in recipe.events)
    of_part = recipe._replace(losses=tuple(map(_weigh_by_part, recipe.losses)), events=tuple(as_often))
    return _move_milestones(of_part, iterations, raised=1.0)


def _move_milestones(recipe: Recipe, iterations: int, raised: float) -> Recipe:
    """Return the recipe for another number of iterations, with rates ``raised`` times as high."""
    factor = Fraction(iterations, recipe.iterations)
    return recipe._replace(
        iterations=iterations,
        learning_rates=recipe.learning_rates.scale(factor, raised, raised**2),
        sh_milestones=tuple(_scale_step(milestone, factor) for milestone in recipe.sh_milestones),
        losses=tuple(term.scale(factor) for term in recipe.losses),
        events=tuple(event.scale(factor) for event in recipe.events),
    )


def _weigh_by_part(term: LossTerm) -> LossTerm:
    """Return the term for parts of photographs, if it is the photometric one; others have no mean over pixels."""
    function = term.function
    if not (isinstance(function, partial) and function.func is photometric):
        return term
    return term._replace(function=partial(photometric_of_part, **function.keywords))


def _scale_step(step: int, factor: Fraction) -> int:
    return round(step * factor)


def _scale_limit(step: int | None, factor: Fraction) -> int | None:
    return None if step is None else _scale_step(step, factor)


# --- description ---


def describe(recipe: Recipe) -> dict[str, Any]:
    """Return the recipe as numbers, strings, lists and dicts, for ``config.json`` and to compare two recipes."""
    cooling = {"cooling": recipe.cooling._asdict()} if recipe.cooling is not None else {}
    unused = {"cooling", *(() if recipe.dropout else ("dropout",))}
    fields = {name: value for name, value in recipe._asdict().items() if name not in unused}
    representation = recipe.representation
    renderer_settings = _named_settings(representation.renderer.render)
    role = "extend" if representation.from_file is None else "from_file"
    return {
        **fields,
        **cooling,
        "learning_rates": recipe.rates.describe(),
        "adam": recipe.adam._asdict(),
        "sh_milestones": list(recipe.sh_milestones),
        "losses": [_describe_term(term) for term in recipe.losses if term.weight != 0],
        "events": [_describe_event(event) for event in recipe.events],
        "calibrations": [calibration.name for calibration in recipe.active_calibrations],
        "representation": {
            "name": representation.name,
            **_describe_function(getattr(representation, role), role),
            **({"renderer": renderer_settings} if renderer_settings else {}),
        },
    }


def bound_settings(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the keyword arguments bound to a function."""
    return dict(function.keywords) if isinstance(function, partial) else {}


def action_name(event: Event) -> str:
    """Return the name of an event's action, as used by :func:`describe` and in the record of what fired."""
    return _name(event.action)


def _describe_event(event: Event) -> dict[str, Any]:
    return {
        "event": type(event).__name__,
        **_describe_fields({name: value for name, value in event._asdict().items() if name != "reads_parameters"}),
        **_describe_function(event.action, "action"),
    }


def _describe_term(term: LossTerm) -> dict[str, Any]:
    return {**_describe_fields(term._asdict()), **_describe_function(term.function, "function")}


def _describe_fields(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _plain(value) for name, value in fields.items()}


def _plain(value: Any) -> Any:
    """Return a value in a form that JSON can hold."""
    if isinstance(value, frozenset):
        return sorted(value)
    return str(value) if isinstance(value, Fraction) else value


def _describe_function(function: Callable[..., Any], role: str) -> dict[str, Any]:
    return {role: _name(function), "settings": _named_settings(function)}


def _named_settings(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the keyword arguments bound to a function, of functions their names."""
    return {name: _name(value) if callable(value) else value for name, value in bound_settings(function).items()}


def _name(function: Any) -> str:
    """Return a function's name; a partial has that of the function inside."""
    function = function.func if isinstance(function, partial) else function
    return getattr(function, "__name__", repr(function))
