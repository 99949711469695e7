"""Fair comparisons: a relative beside what it is built on, from which it differs in the mechanism alone.

What two recipes may have besides their mechanism are *conditions*: length, optimiser, learning rates of what both
train, dates of the harmonics, density control, photometric loss, background, sky and other calibrations, exposures,
size of the views, dense start, dropout. :func:`adopt` gives a relative those of its base, :func:`unlike_conditions`
names what still differs, and :func:`refuse_unlike` refuses arms that do. A release often changes some of them together
with the mechanism; then a table has two rows, the mechanism alone and the relative as released, with what differs
besides.

A learning rate of zero is no condition: the relative moves that parameter by others.
"""

from collections.abc import Callable, Collection
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.methods.gaussian_splatting import (
    clone_and_split,
    collect_gradients,
    prune_faint,
    prune_large,
    reset_opacity,
    reset_opacity_on_white,
)
from minisplat_ref.training.losses import photometric
from minisplat_ref.training.schedule import Event, Recipe, SmallerViews, bound_settings, does

DENSITY = (collect_gradients, clone_and_split, prune_faint, prune_large, reset_opacity, reset_opacity_on_white)
RATES, DENSITY_CONTROL, HARMONICS = "learning rates", "density control", "dates of the harmonics"
_CONDITIONS: dict[str, Callable[[Recipe], Any]] = {
    "length": lambda recipe: (recipe.iterations, recipe.cooling),
    "optimiser": lambda recipe: recipe.adam,
    HARMONICS: lambda recipe: (recipe.sh_degree, recipe.sh_milestones),
    DENSITY_CONTROL: lambda recipe: [_described(event) for event in recipe.events if does(event, *DENSITY)],
    "photometric loss": lambda recipe: [
        (term.weight, term.start, term.stop, bound_settings(term.function)) for term in _photometric(recipe)
    ],
    "background": lambda recipe: recipe.has_random_background,
    "calibrations": lambda recipe: sorted(calibration.name for calibration in recipe.active_calibrations),
    "exposures": lambda recipe: recipe.exposure,
    "size of the views": lambda recipe: [e for e in recipe.events if isinstance(e, SmallerViews)],
    "dense start": lambda recipe: recipe.starts_densely,
    "dropout": lambda recipe: recipe.dropout,
}


def unlike_conditions(base: Recipe, relative: Recipe) -> list[str]:
    """Return the conditions in which two recipes differ, in the order of this module's list."""
    found = [name for name, of in _CONDITIONS.items() if of(base) != of(relative)]
    ours, theirs = base.learning_rates, relative.learning_rates
    shared = [name for name, rate in theirs.of.items() if rate != 0 and name in ours.of]
    is_alike = all(
        (ours.of[name], name in ours.per_extent) == (theirs.of[name], name in theirs.per_extent) for name in shared
    )
    return found if is_alike else [*found, RATES]


def adopt(base: Recipe, relative: Recipe, own: Collection[str] = ()) -> Recipe:
    """Return the relative under the conditions of its base, all but its own.

    Density control is adopted action by action: an event of the base replaces the relative's of the same action. Where
    one of the two has no such action, density control stays unlike, which :func:`refuse_unlike` reports.

    Parameters
    ----------
    base, relative : Recipe
        Of the same length.
    own : collection of str
        Conditions that are part of the mechanism.
    """
    adopted = relative._replace(
        iterations=base.iterations,
        cooling=base.cooling,
        adam=base.adam,
        has_random_background=base.has_random_background,
        calibrations=base.calibrations,
        exposure=base.exposure,
        starts_densely=base.starts_densely,
        dropout=base.dropout,
        losses=(*_photometric(base), *(term for term in relative.losses if term not in _photometric(relative))),
    )
    if HARMONICS not in own:
        adopted = adopted._replace(sh_degree=base.sh_degree, sh_milestones=base.sh_milestones)
    if DENSITY_CONTROL not in own:
        adopted = adopted._replace(events=tuple(_replacement(base, event) for event in relative.events))
    if RATES not in own:
        theirs = relative.learning_rates
        common = {name for name, rate in theirs.of.items() if rate != 0 and name in base.learning_rates.of}
        per_extent = (theirs.per_extent - common) | (base.learning_rates.per_extent & common)
        rates = {name: base.learning_rates.of[name] if name in common else rate for name, rate in theirs.of.items()}
        adopted = adopted._replace(learning_rates=theirs._replace(of=rates, per_extent=per_extent))
    return adopted


def refuse_unlike(base: Recipe, relative: Recipe, own: Collection[str] = ()) -> None:
    """Refuse to compare two recipes that differ in more than the mechanism.

    Raises
    ------
    InputError
        They differ in a condition that is not among the relative's own.
    """
    unlike = [name for name in unlike_conditions(base, relative) if name not in own]
    if unlike:
        raise InputError(
            f"{relative.name} and {base.name} differ in {', '.join(unlike)}, besides the mechanism: give them the same,"
            " or another --base"
        )


def _photometric(recipe: Recipe) -> list[Any]:
    return [term for term in recipe.losses if _function(term.function) is photometric]


def _described(event: Event) -> tuple[Any, ...]:
    """Return what an event does, and when, so that two are equal if they do the same."""
    action: Any = event.action
    when = tuple(
        value for name, value in event._asdict().items() if name not in ("action", "wants", "reads_parameters")
    )
    return type(event), _function(action), bound_settings(action), when


def _function(action: Any) -> Any:
    return getattr(action, "func", action)


def _replacement(base: Recipe, event: Event) -> Event:
    """Return the base's event of the same action of density control, if both have one."""
    if not does(event, *DENSITY):
        return event
    own = [other for other in base.events if does(other, _function(event.action))]
    return own[0] if len(own) == 1 else event
