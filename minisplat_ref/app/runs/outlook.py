"""The rest of a training that has not decided its length: a range, by the recipe's plan and the speed so far.

Three things are open. *When the views become larger, or the rates begin to fall*: not before the iteration that the
recipe names (``min_step``), and at once if the next measurement says so. It depends on the gain of the held-out views
for each doubling of the work. If a doubling brings half of what the one before has brought, a gain g falls to
``min_gain`` after ``g / min_gain`` times the iterations so far; until a gain is known, nothing says how long it may
take. Where views are too few to hold some out, it is as soon as it may be. *How long an iteration takes at the next
size*: longer, but not by as much as there are more pixels. *How long the sizes to come are trained on*: about as long
as is needed to measure a gain again. After the decision the end is known, and the progress bar tells it.
"""

from collections import deque
from typing import NamedTuple

from minisplat_ref.interface.remaining import describe_rest
from minisplat_ref.training.pace import FINER, Cooling, Pace, gains_per_doubling
from minisplat_ref.training.recipe_settings import settings_of
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.training.state import StepReport, TrainState

RECENT = 300  # iterations by which the speed is measured
NEXT_SIZE = (0.5, 0.75)  # iterations at each further size, in multiples of the earliest decision; ours
SLOWER = (2.0, 3.0)  # an iteration at twice the width and height takes so many times as long; pixels are 4 times; ours


class Plan(NamedTuple):
    """The plan of a recipe that decides its own length."""

    cooling: Cooling
    earliest: int
    """Iteration before which nothing is decided."""
    min_gain: float
    """dB for each doubling of the work, below which the decision is made; 0 if the recipe has no such rule."""
    latest: int
    """Iteration at which the rates begin to fall at the latest."""
    n_views: int
    """Training views, over which the prune passes."""


class Range(NamedTuple):
    """The two ends of an estimate."""

    least: float
    most: float | None
    """None while nothing tells."""


def make_plan(recipe: Recipe, iterations: int, n_views: int) -> Plan | None:
    """Return the plan of a recipe, or None if it has a schedule.

    Parameters
    ----------
    recipe : Recipe
    iterations : int
        At which it ends at the latest.
    n_views : int
        Training views.
    """
    if recipe.cooling is None:
        return None
    settings, latest = settings_of(recipe), recipe.cooling.latest_start(iterations)
    return Plan(
        recipe.cooling, min(settings.get("min_step", 0), latest), settings.get("min_gain", 0.0), latest, n_views
    )


def foresee_decision(plan: Plan, pace: Pace, step: int) -> Range:
    """Return the iterations between which the next decision is to be expected: on larger views or on the end.

    Parameters
    ----------
    plan : Plan
    pace : Pace
        Of the training so far.
    step : int
        Iterations done.
    """
    begun = max((decision.step for decision in pace.decisions if decision.what == FINER), default=0)
    first = begun + NEXT_SIZE[0] * plan.earliest if begun else plan.earliest
    least = min(max(step, first), plan.latest)
    if not plan.cooling.holds_out(plan.n_views):
        return Range(least, least)
    gains = gains_per_doubling(pace.recent())
    if step < plan.earliest or gains is None or plan.min_gain <= 0:
        return Range(least, None)
    return Range(least, min(max(least, step * float(gains.mean()) / plan.min_gain), plan.latest))


def foresee_rest(plan: Plan, pace: Pace, step: int, n_halvings: int, seconds_each: float) -> Range:
    """Return the seconds that a training will take that has not decided its length.

    Parameters
    ----------
    plan, pace, step
        As for :func:`foresee_decision`.
    n_halvings : int
        Times that width and height of the views are halved now.
    seconds_each : float
        Of an iteration at this size.
    """
    ends: list[float | None] = []
    for last, further, slower in zip(foresee_decision(plan, pace, step), NEXT_SIZE, SLOWER, strict=True):
        if last is None:
            ends.append(None)
            continue
        seconds, n = (last - step) * seconds_each, last
        for k in range(1, n_halvings + 1):
            n_here = min(further * plan.earliest, plan.latest - n)
            seconds, n = seconds + n_here * seconds_each * slower**k, n + n_here
        n_end = plan.cooling.part * n + plan.cooling.prune_passes * plan.n_views
        ends.append(seconds + n_end * seconds_each * slower**n_halvings)
    assert ends[0] is not None
    return Range(ends[0], ends[1])


class Outlook:
    """The rest of a running training, in words.

    Parameters
    ----------
    plan : Plan
    state : TrainState
        Of the training; its pace is read.
    limit : float or None
        Seconds of training at most.
    """

    def __init__(self, plan: Plan, state: TrainState, limit: float | None = None) -> None:
        self._plan, self._state, self._limit = plan, state, limit
        self._times: deque[float] = deque(maxlen=RECENT + 1)
        self._n_halvings: int | None = None

    def observe(self, report: StepReport, seconds: float) -> None:
        """Take note of the time of an iteration; ``seconds`` is that of the training so far."""
        if report.n_halvings != self._n_halvings:  # the next iterations take longer
            self._n_halvings = report.n_halvings
            self._times.clear()
        self._times.append(seconds)

    def describe(self, report: StepReport) -> str:
        """Return how long the rest takes; "" where the end is known, or the speed is not."""
        n = len(self._times) - 1
        if report.last_step is not None or n < 1:
            return ""
        seconds_each = (self._times[-1] - self._times[0]) / n
        rest = foresee_rest(self._plan, self._state.pace, report.step, report.n_halvings, seconds_each)
        if self._limit is not None:
            left = max(0.0, self._limit - self._times[-1])
            rest = Range(min(rest.least, left), left if rest.most is None else min(rest.most, left))
        return describe_rest(*rest)
