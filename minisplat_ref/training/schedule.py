"""A training method as data: what happens when; how to scale it to another length, change its settings, describe it.

Events act after the optimiser step of their iteration, in the order in which they are listed.
"""

import functools
import inspect
import math
import sys
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from functools import partial
from typing import Any, NamedTuple

from minisplat_ref.errors import InputError
from minisplat_ref.rendering import Renderer
from minisplat_ref.training.adam import AdamRule
from minisplat_ref.training.calibration import CALIBRATIONS, Calibration
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.pace import Cooling, Pace
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import GAUSSIANS, Representation
from minisplat_ref.types import Model

Action = Callable[..., str | None]
"""``action(state, iteration)``; see :mod:`minisplat_ref.training.state`. Its settings are bound with ``partial``."""

START = "starts_densely"
"""The setting of :attr:`Recipe.starts_densely`."""
DSSIM = "dssim_weight"
"""The setting of :func:`minisplat_ref.training.losses.photometric`, a share."""

BLEND_STATS = frozenset({"stats"})
"""For ``During.wants``: the action finds blend statistics in ``iteration.output.stats``."""


class During(NamedTuple):
    """Act in every iteration with ``start < step < stop``. Scaling keeps it at every iteration."""

    action: Action
    start: int = 0
    stop: int | None = None
    wants: frozenset[str] = frozenset()
    """What to render in these iterations for the action; see :class:`minisplat_ref.rendering.Request`."""
    reads_parameters: bool = True
    """Whether the action reads or changes parameters or moments, for which a GPU copies all of them in each of these
    iterations. If it seldom does, it may say False and call ``iteration.fetch()`` before."""

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
    """Least number of iterations between two actions, and from the last one to ``stop``. Where compression would go
    below it, only every second published iteration stays, or every third, and so on, counted back from ``stop``."""
    factor: Fraction = Fraction(1)
    """Length of the run, divided by the published length."""

    @property
    def stride(self) -> int:
        """Return the number of published iterations from one action that stays to the next."""
        return self.period * math.ceil(self.min_gap / (self.period * self.factor))

    def is_due(self, step: int) -> bool:
        """Return whether the action belongs to iteration ``step``, counted from 1."""
        length, of = self.factor.as_integer_ratio()  # the action published at p comes at p length / of
        first, last = (2 * step - 1) * of // (2 * length), (2 * step + 1) * of // (2 * length)
        multiples = range(first + -first % self.period, last + 1, self.period)
        return any(self._stays(published) and _scale_step(published, self.factor) == step for published in multiples)

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

    Here the action is ``action(scene)``, called once, before the training. It returns how often to halve the views in
    width and height; see :mod:`minisplat_ref.training.smaller_views`.
    """

    action: Callable[..., Any]
    start: int = 0
    until: int | None = None
    """The last such iteration; None: until the training decides to proceed."""

    def is_due(self, step: int) -> bool:
        """Return whether iteration ``step``, counted from 1, may see smaller views."""
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
    """What happens besides gradient steps; several due in one iteration act in this order."""
    min_views: int = 1
    """Least number of training views that the method needs."""
    short_run_exponent: float = 0.0
    """p of the factor ``(published / iterations)^p`` by which :func:`scale` raises the rates of runs shorter than
    published; the rate of the means is raised by its square."""
    calibrations: tuple[Calibration, ...] = CALIBRATIONS
    """Parameters of each photograph, and a sky; all are off unless asked for."""
    representation: Representation = GAUSSIANS
    """What is trained and how it is rendered."""
    starts_densely: bool = False
    """Begin with stereo's points, too, not with the sparse points alone (:mod:`minisplat_ref.training.dense_start`)."""
    cooling: Cooling | None = None
    """How a method without a schedule ends: its milestones do not scale with the length, and ``iterations`` is a limit.
    None for methods with a schedule."""

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
        """Return the learning rates of an iteration in a scene of this extent; they fall during a cool-down."""
        rates = self.rates
        values = rates.at(step, extent)
        if self.cooling is None or pace.cooling_from is None:
            return values
        factor, factor_per_extent = self.cooling.factors(step, pace)
        return {name: v * (factor_per_extent if name in rates.per_extent else factor) for name, v in values.items()}

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
        """Return what terms and events of an iteration want rendered."""
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
    the calibration has a ``short_run_exponent``. A recipe that decides its own length keeps everything but the limit.

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

    def of_calibration(calibration: Calibration) -> Calibration:
        raised = shortening**calibration.short_run_exponent
        return calibration._replace(rates=calibration.rates.scale(factor, raised, raised))

    return recipe._replace(
        iterations=iterations,
        learning_rates=recipe.learning_rates.scale(factor, raised, raised**2),
        sh_milestones=tuple(_scale_step(milestone, factor) for milestone in recipe.sh_milestones),
        losses=tuple(term.scale(factor) for term in recipe.losses),
        events=tuple(event.scale(factor) for event in recipe.events),
        calibrations=tuple(map(of_calibration, recipe.calibrations)),
        representation=recipe.representation._replace(
            rates=recipe.representation.rates.scale(factor, raised, raised**2)
        ),
    )


def _scale_step(step: int, factor: Fraction) -> int:
    return round(step * factor)


def _scale_limit(step: int | None, factor: Fraction) -> int | None:
    return None if step is None else _scale_step(step, factor)


# --- settings ---


def as_decided(recipe: Recipe, pace: Pace) -> Recipe:
    """Return the recipe with those calibrations on that a training has switched on."""
    return configure(recipe, **dict.fromkeys(pace.switched_on, True)) if pace.switched_on else recipe


def as_trained(recipe: Recipe, model: Model) -> Recipe:
    """Return the recipe with those calibrations on that a model has parameters of, given or decided upon."""
    on = {c.name: True for c in recipe.calibrations if c.initial(1).keys() <= model.shared.keys()}
    return configure(recipe, **on)


def settings_of(recipe: Recipe) -> dict[str, Any]:
    """Return the settings that :func:`configure` can replace, each with its present value, the first of several.

    Settings of events, of loss terms, and of the representation's ``extend``, ``shared``, ``from_file`` and renderer go
    by their own names; the weight of a loss term by the term's name; whether a calibration is on by the calibration's
    name; and ``starts_densely``.
    """
    events = [_settings(event.action) for event in recipe.events]
    terms = [{term.name: term.weight, **_settings(term.function)} for term in recipe.losses]
    switches = [{calibration.name: calibration.is_on for calibration in recipe.calibrations}]
    of = recipe.representation
    functions = (of.extend, of.shared, of.renderer.render, of.from_file)
    representation = [_settings(function) for function in functions if function is not None]
    start = [{START: recipe.starts_densely}]
    found = [*events, *terms, *switches, *representation, *start]
    return {name: value for settings in reversed(found) for name, value in settings.items()}


def configure(recipe: Recipe, **settings: Any) -> Recipe:
    """Return the recipe with settings replaced, each wherever the recipe has it; see :func:`settings_of`.

    Raises
    ------
    InputError
        The recipe has no such setting.
    """
    known = settings_of(recipe)
    for name, value in settings.items():
        if name not in known:
            raise InputError(f"recipe {recipe.name} has no {name} to set: choose from {', '.join(sorted(known))}")
        recipe = recipe._replace(
            events=tuple(event._replace(action=_with(event.action, name, value)) for event in recipe.events),
            losses=tuple(
                term._replace(
                    function=_with(term.function, name, value), weight=value if name == term.name else term.weight
                )
                for term in recipe.losses
            ),
            calibrations=tuple(
                calibration._replace(is_on=value) if name == calibration.name else calibration
                for calibration in recipe.calibrations
            ),
            representation=_with_setting(recipe.representation, name, value),
            starts_densely=value if name == START else recipe.starts_densely,
        )
    return recipe


def _with_setting(representation: Representation, name: str, value: Any) -> Representation:
    """Return a representation with another value of a setting of how it begins or is drawn, if it has one."""
    renderer = representation.renderer
    return representation._replace(
        extend=_with(representation.extend, name, value),
        shared=_with(representation.shared, name, value),
        from_file=representation.from_file and _with(representation.from_file, name, value),
        renderer=renderer._replace(render=_with(renderer.render, name, value)),
    )


def renderer_settings(renderer: Renderer, texts: Mapping[str, str]) -> tuple[str, ...]:
    """Return those of a run's settings, as ``NAME=VALUE`` without blanks, that are of its renderer."""
    known = _settings(renderer.render)
    return tuple("".join(f"{name}={text}".split()) for name, text in texts.items() if name in known)


def configure_renderer(renderer: Renderer, settings: Iterable[str]) -> Renderer:
    """Return a renderer with other settings; this inverts :func:`renderer_settings`.

    Raises
    ------
    InputError
        It has no such setting, or the text is not a value of its type.
    """
    known = _settings(renderer.render)
    for setting in settings:
        name, _, text = setting.partition("=")
        if name not in known:
            raise InputError(f"renderer {renderer.name} has no {name} to set: it has {', '.join(known) or 'none'}")
        renderer = renderer._replace(render=_with(renderer.render, name, _parse(name, text, known[name], True)))
    return renderer


def parse_settings(recipe: Recipe, texts: Mapping[str, str]) -> dict[str, Any]:
    """Return settings for :func:`configure` from text, each of the type of the present value.

    A function is given by its name, such as ``metric=outdoor``, one of :func:`alternatives_of` the present one. Text,
    such as the path of a folder, is taken as it is. For a number other than the weight of a loss term, ``none`` is
    None.

    Raises
    ------
    InputError
        The recipe has no such setting, or the text is not a value of its type.
    """
    known = settings_of(recipe)
    unknown = [name for name in texts if name not in known]
    if unknown:
        raise InputError(
            f"recipe {recipe.name} has no {', '.join(unknown)} to set: choose from {', '.join(sorted(known))}"
        )
    weights = {term.name for term in recipe.losses}
    values = {name: _parse(name, text, known[name], name not in weights) for name, text in texts.items()}
    for name in sorted(weights & values.keys()):
        if not 0 <= values[name] < math.inf:
            raise InputError(f"--set {name}={texts[name]}: a weight of the loss is at least 0; 0 leaves the term out")
    if DSSIM in values and not 0 <= values[DSSIM] <= 1:
        raise InputError(f"--set {DSSIM}={texts[DSSIM]}: the shares of L1 and D-SSIM are at least 0; give 0 to 1")
    return values


def configure_by_name(find: Callable[[str], Recipe], text: str) -> Recipe:
    """Return a recipe that ``find`` knows by name, with settings if there are: ``adaptive+min_slope=0.5``.

    Raises
    ------
    InputError
        There is no such recipe, it has no such setting, or the text is not a value of its type.
    """
    name, *settings = text.split("+")
    recipe = find(name)
    texts = dict(setting.partition("=")[::2] for setting in settings)
    return configure(recipe, **parse_settings(recipe, texts))


def _parse(name: str, text: str, present: Any, may_be_none: bool) -> Any:
    if callable(present):
        choices = alternatives_of(present)
        if text not in choices:
            raise InputError(f"--set {name}={text} names no function: choose from {', '.join(choices)}")
        return choices[text]
    if isinstance(present, bool):
        if text.lower() not in ("true", "false"):
            raise InputError(f"--set {name}={text} is neither true nor false")
        return text.lower() == "true"
    if isinstance(present, str):
        return text
    if text.lower() == "none" and may_be_none:
        return None
    try:
        number = int(text) if isinstance(present, int) else float(text) if isinstance(present, float) else _number(text)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        kind = "a whole number" if isinstance(present, int) else "a number"
        raise InputError(f"--set {name}={text} is not {kind}, as {name}={present} is")
    return number


def _number(text: str) -> int | float:
    """Return an integer if the text is one, else a float: a present value of None does not tell the type."""
    value = float(text)
    return int(value) if value.is_integer() else value


def alternatives_of(function: Callable[..., Any]) -> dict[str, Callable[..., Any]]:
    """Return by name the public functions in the module of this one that take the same arguments, itself among them.

    These are what ``--set`` takes for a setting that is a function.
    """
    names, module = list(inspect.signature(function).parameters), function.__module__
    functions = inspect.getmembers(sys.modules[module], inspect.isfunction)
    return {
        key: other
        for key, other in functions
        if other.__module__ == module and not key.startswith("_") and list(inspect.signature(other).parameters) == names
    }


def _settings(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the keyword arguments bound to a function."""
    return dict(function.keywords) if isinstance(function, partial) else {}


def _with(function: Callable[..., Any], name: str, value: Any) -> Callable[..., Any]:
    """Return a function with another value bound to ``name``, if one is."""
    return partial(function, **{name: value}) if name in _settings(function) else function


# --- description ---


def describe(recipe: Recipe) -> dict[str, Any]:
    """Return the recipe as numbers, strings, lists and dicts, for ``config.json`` and to compare two recipes."""
    cooling = {"cooling": recipe.cooling._asdict()} if recipe.cooling is not None else {}
    fields = {name: value for name, value in recipe._asdict().items() if name != "cooling"}
    representation = recipe.representation
    drawn = _named_settings(representation.renderer.render)
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
            **({"renderer": drawn} if drawn else {}),
        },
    }


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
    return {name: _name(value) if callable(value) else value for name, value in _settings(function).items()}


def _name(function: Any) -> str:
    """Return a function's name; a partial has that of the function inside."""
    function = function.func if isinstance(function, partial) else function
    return getattr(function, "__name__", repr(function))
