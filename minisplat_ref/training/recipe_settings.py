"""Settings of a recipe: what ``train --set NAME=VALUE`` may name, and the recipe with other values.

A setting is a keyword argument that ``functools.partial`` has bound to a function of the recipe: an event's action, a
loss term, or a part of the representation. Its name is the argument's, so that no list of settings is kept anywhere.
Six more kinds have no function: weights of loss terms, calibrations that are on, the source of the exposures,
``starts_densely``, ``dropout`` and, of a recipe that decides its own length, ``hold_out_from``.
"""

import inspect
import math
import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import suggest
from minisplat_ref.rendering import Renderer
from minisplat_ref.training.calibration import EXPOSURE, EXPOSURE_SOURCES, HELD_EXPOSURE, LEARNED, REFINED, TRACKS
from minisplat_ref.training.exposure_gauge import hold_mean_exposure
from minisplat_ref.training.pace import Pace
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import During, Recipe, bound_settings, does
from minisplat_ref.types import Model

START = "starts_densely"
"""The setting of :attr:`Recipe.starts_densely`."""
DROPOUT = "dropout"
"""The setting of :attr:`Recipe.dropout`, a share."""
HOLD_OUT_FROM = "hold_out_from"
"""The setting of :attr:`minisplat_ref.training.pace.Cooling.hold_out_from`, a number of training views."""
DSSIM = "dssim_weight"
"""The setting of :func:`minisplat_ref.training.losses.photometric`, a share."""


def apply_decisions(recipe: Recipe, pace: Pace) -> Recipe:
    """Return the recipe with the calibrations on that a training has decided to use."""
    return _switch_on(recipe, pace.switched_on)


def match_calibrations(recipe: Recipe, model: Model) -> Recipe:
    """Return the recipe with the calibrations on that a model has parameters of."""
    return _switch_on(recipe, [c.name for c in recipe.calibrations if c.initial(1).keys() <= model.shared.keys()])


def _switch_on(recipe: Recipe, names: Collection[str]) -> Recipe:
    """Return the recipe with these calibrations on; exposures that the tracks show are not trained."""
    is_held = recipe.exposure == TRACKS
    return recipe._replace(
        calibrations=tuple(
            (HELD_EXPOSURE if is_held and c.name == EXPOSURE.name else c)._replace(is_on=True) if c.name in names else c
            for c in recipe.calibrations
        )
    )


def settings_of(recipe: Recipe) -> dict[str, Any]:
    """Return the settings that :func:`configure` can replace, with their present values (of several, the first).

    Arguments bound to events, loss terms, and the representation's ``extend``, ``shared``, ``from_file`` and renderer
    have their own names; the weight of a loss term and the switch of a calibration have the name of the term or
    calibration.
    """
    events = [bound_settings(event.action) for event in recipe.events]
    terms = [{term.name: term.weight, **bound_settings(term.function)} for term in recipe.losses]
    switches = [{calibration.name: calibration.is_on for calibration in recipe.calibrations}]
    source = [{EXPOSURE.name: recipe.exposure}]
    parts = recipe.representation
    functions = (parts.extend, parts.shared, parts.renderer.render, parts.from_file)
    representation = [bound_settings(function) for function in functions if function is not None]
    of_recipe = [{START: recipe.starts_densely, DROPOUT: recipe.dropout}]
    of_recipe += [{HOLD_OUT_FROM: recipe.cooling.hold_out_from}] if recipe.cooling else []
    found = [*events, *terms, *source, *switches, *representation, *of_recipe]
    return {name: value for settings in reversed(found) for name, value in settings.items()}


def configure(recipe: Recipe, **settings: Any) -> Recipe:
    """Return the recipe with settings replaced, each wherever it occurs; see :func:`settings_of`.

    Raises
    ------
    InputError
        The recipe has no such setting, or its renderer cannot leave out Gaussians.
    """
    known = settings_of(recipe)
    if settings.get(DROPOUT) and not recipe.representation.renderer.scales_opacities:
        name = recipe.representation.renderer.name
        raise InputError(
            f"recipe {recipe.name}: renderer {name} cannot make up for Gaussians that are left out; leave dropout at 0"
        )
    for name, value in settings.items():
        if name not in known:
            raise InputError(f"recipe {recipe.name} has no {name} to set{suggest(name, sorted(known))}")
        is_source = name == EXPOSURE.name
        if is_source and value not in EXPOSURE_SOURCES:
            raise InputError(f"exposure={value}: choose from {', '.join(EXPOSURE_SOURCES)}")
        recipe = recipe._replace(
            events=tuple(event._replace(action=_bind(event.action, name, value)) for event in recipe.events),
            losses=tuple(
                term._replace(
                    function=_bind(term.function, name, value), weight=value if name == term.name else term.weight
                )
                for term in recipe.losses
            ),
            calibrations=tuple(
                calibration._replace(is_on=value == LEARNED if is_source else value)
                if name == calibration.name
                else calibration
                for calibration in recipe.calibrations
            ),
            representation=_configure_representation(recipe.representation, name, value),
            starts_densely=value if name == START else recipe.starts_densely,
            dropout=value if name == DROPOUT else recipe.dropout,
            exposure=value if is_source else recipe.exposure,
            cooling=recipe.cooling._replace(hold_out_from=value)
            if recipe.cooling and name == HOLD_OUT_FROM
            else recipe.cooling,
        )
    return _hold_refined_exposures(recipe)


def _hold_refined_exposures(recipe: Recipe) -> Recipe:
    """Return the recipe with the event that holds the mean of exposures that are refined, first of all."""
    if recipe.exposure != REFINED or any(does(event, hold_mean_exposure) for event in recipe.events):
        return recipe
    return recipe._replace(events=(During(hold_mean_exposure, reads_parameters=False), *recipe.events))


def _configure_representation(representation: Representation, name: str, value: Any) -> Representation:
    """Return a representation with another value of a setting, wherever one of its functions has it."""
    renderer = representation.renderer
    return representation._replace(
        extend=_bind(representation.extend, name, value),
        shared=_bind(representation.shared, name, value),
        from_file=representation.from_file and _bind(representation.from_file, name, value),
        renderer=renderer._replace(render=_bind(renderer.render, name, value)),
    )


def renderer_settings(renderer: Renderer, texts: Mapping[str, str]) -> tuple[str, ...]:
    """Return the settings of a run that belong to its renderer, as ``NAME=VALUE`` without blanks."""
    known = bound_settings(renderer.render)
    return tuple("".join(f"{name}={text}".split()) for name, text in texts.items() if name in known)


def configure_renderer(renderer: Renderer, settings: Iterable[str]) -> Renderer:
    """Return a renderer with other settings; this inverts :func:`renderer_settings`.

    Raises
    ------
    InputError
        It has no such setting, or the text is not a value of its type.
    """
    known = bound_settings(renderer.render)
    for setting in settings:
        name, _, text = setting.partition("=")
        if name not in known:
            raise InputError(f"renderer {renderer.name} has no {name} to set: it has {', '.join(known) or 'none'}")
        renderer = renderer._replace(render=_bind(renderer.render, name, _parse(name, text, known[name], True)))
    return renderer


def parse_settings(recipe: Recipe, texts: Mapping[str, str]) -> dict[str, Any]:
    """Return settings for :func:`configure`, parsed from text to the types of their present values.

    The text for a function is its name, such as ``metric=outdoor``; see :func:`find_alternatives`. Strings, such as the
    path of a folder, stay as they are. ``none`` is None, except for a weight of a loss term and for shares.

    Raises
    ------
    InputError
        The recipe has no such setting, or the text is not a value of its type.
    """
    known = settings_of(recipe)
    unknown = [name for name in texts if name not in known]
    if unknown:
        meant = suggest(unknown[-1], sorted(known))
        raise InputError(f"recipe {recipe.name} has no {', '.join(unknown)} to set{meant}")
    weights = {term.name for term in recipe.losses}
    if texts.get(EXPOSURE.name, TRACKS) not in EXPOSURE_SOURCES:
        raise InputError(f"--set exposure={texts[EXPOSURE.name]}: choose from {', '.join(EXPOSURE_SOURCES)}")
    numbers = weights | {DSSIM, DROPOUT}
    values = {name: _parse(name, text, known[name], name not in numbers) for name, text in texts.items()}
    for name in sorted(weights & values.keys()):
        if not 0 <= values[name] < math.inf:
            raise InputError(f"--set {name}={texts[name]}: a weight of the loss is at least 0; 0 leaves the term out")
    if DROPOUT in values and not 0 <= values[DROPOUT] < 1:
        raise InputError(f"--set {DROPOUT}={texts[DROPOUT]}: the share that is left out is at least 0 and below 1")
    if DSSIM in values and not 0 <= values[DSSIM] <= 1:
        raise InputError(f"--set {DSSIM}={texts[DSSIM]}: the shares of L1 and D-SSIM are at least 0; give 0 to 1")
    return values


def configure_by_name(find: Callable[[str], Recipe], text: str) -> Recipe:
    """Return a recipe by its name for ``find`` and its settings, if any: ``adaptive+min_slope=0.5``.

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
        choices = find_alternatives(present)
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
    """Return an integer if the text is one, else a float: a present value of None has no type to go by."""
    value = float(text)
    return int(value) if value.is_integer() else value


def find_alternatives(function: Callable[..., Any]) -> dict[str, Callable[..., Any]]:
    """Return the functions that may replace this one, by name: what ``--set`` takes for a setting that is a function.

    They are the public functions of its module with the same parameters, itself included, so that another one becomes a
    choice by being written beside it.
    """
    module, parameters = function.__module__, list(inspect.signature(function).parameters)
    return {
        name: other
        for name, other in inspect.getmembers(sys.modules[module], inspect.isfunction)
        if other.__module__ == module
        and not name.startswith("_")
        and list(inspect.signature(other).parameters) == parameters
    }


def _bind(function: Callable[..., Any], name: str, value: Any) -> Callable[..., Any]:
    """Return a function with another value bound to ``name``, if it has that setting."""
    return partial(function, **{name: value}) if name in bound_settings(function) else function
