"""A training that decides when to end and what it needs: its measurements, its decisions, and the reasons.

A recipe with a :class:`Cooling` has no schedule. It trains at constant rates, and holds some *training* views back to
measure the gain of more iterations; test views are never used. Of few views none is held back: they are worth more in
the training than as two votes on its length. When an action of the recipe decides that the gain is small, or when the
given number of iterations leaves no more time, a cool-down with falling rates ends the training
(:func:`minisplat_ref.training.state.begin_cooling`); from some point of it, all training views are trained on. So a
plateau is due to the scene and not to falling rates. Large photographs are halved at first; there, the decision is to
train on views of twice the width and height.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.types import Floats

COOLED, FINER = "cool down", "resolution"  # decisions: to let the rates fall, to train on larger views
MEASUREMENTS_MIN = 4  # to fit a line through


class Measurement(NamedTuple):
    """One evaluation of the held-out training views, at the size of those that are trained on."""

    step: int
    psnrs: tuple[float, ...]
    """dB, of each view."""
    n_gaussians: int
    n_pairs: int
    """Pairs (tile, Gaussian) of all iterations so far: the work."""
    ssims: tuple[float, ...] = ()
    """Of each view; empty where only the PSNR was computed."""

    @property
    def psnr(self) -> float:
        """Return the mean of the views, dB."""
        return sum(self.psnrs) / len(self.psnrs)

    @property
    def ssim(self) -> float:
        """Return the mean of the views."""
        return sum(self.ssims) / len(self.ssims)


class Decision(NamedTuple):
    """One decision, and its evidence."""

    step: int
    what: str
    why: str
    gain: float | None
    """The gain in dB of the held-out views on which the decision rests; None where it rests on something else."""
    standard_error: float | None
    """Of the gain, over the views, dB."""


class Pace(NamedTuple):
    """Progress of a training that decides its own length."""

    measurements: tuple[Measurement, ...] = ()
    decisions: tuple[Decision, ...] = ()
    n_pairs: int = 0
    """Pairs (tile, Gaussian) of all iterations so far."""
    cooling_from: int | None = None
    """Iteration after which the rates fall; None while they are constant."""
    last_step: int | None = None
    """Iteration at which the training ends; None while that is open."""
    switched_on: tuple[str, ...] = ()
    """Names of the calibrations that the photographs turned out to need."""
    is_pruning: bool = False
    """Whether views are still held back while the rates fall, to measure what the prune costs."""
    while_cooling: tuple[Measurement, ...] = ()
    """Evaluations while the rates fall, before and between the slices of the prune."""

    @property
    def holds_out(self) -> bool:
        """Return whether some training views are held back now."""
        return self.cooling_from is None or self.is_pruning

    @property
    def n_finer(self) -> int:
        """Return the number of decisions to train on views of twice the width and height."""
        return sum(decision.what == FINER for decision in self.decisions)

    def with_decision(self, decision: Decision) -> "Pace":
        """Return the pace with one more decision."""
        return self._replace(decisions=(*self.decisions, decision))

    def before(self, decision: Decision) -> "Pace":
        """Return the measurements and decisions that there were when one was made."""
        measurements = tuple(m for m in self.measurements if m.step <= decision.step)
        n_pairs = measurements[-1].n_pairs if measurements else 0
        return Pace(measurements, self.decisions[: self.decisions.index(decision)], n_pairs)

    def recent(self) -> list[Measurement]:
        """Return the measurements since half of the work and since the last decision.

        What was measured before a decision is of another model, or of views of another size.
        """
        changed = max((decision.step for decision in self.decisions), default=0)
        return [m for m in self.measurements if 2 * m.n_pairs >= self.n_pairs and m.step > changed]


class Cooling(NamedTuple):
    """The end of a training without a schedule."""

    part: float
    """Length of the cool-down, as a fraction of the iterations before it."""
    last: float
    """Factor of the rates at its end."""
    last_per_extent: float
    """The same for rates per unit of the scene's extent; until the end, the factors' logarithms fall linearly."""
    hold_out_every: int
    """Until the cool-down, and until the end of a prune, one in this many training views is held back for decisions."""
    hold_out_from: int = 0
    """Training views from which on some are held back; of fewer, all are trained on from the first iteration on."""
    prune_passes: int = 0
    """Passes over all training views that a prune takes while the rates fall; 0 if the recipe has none. The prune ends
    the holding back, too."""

    def holds_out(self, n_views: int) -> bool:
        """Return whether some of this many training views are held back."""
        return n_views >= self.hold_out_from

    def factors(self, step: int, pace: Pace) -> tuple[float, float]:
        """Return the factors of the rates, and of those per unit of the extent, at an iteration.

        The latter are halved whenever the width and height of the views double, so that a step stays as many pixels.
        """
        finer = 0.5**pace.n_finer
        if pace.cooling_from is None or pace.last_step is None:
            return 1.0, finer
        progress = (step - pace.cooling_from) / max(pace.last_step - pace.cooling_from, 1)
        progress = min(max(progress, 0.0), 1.0)
        return self.last**progress, finer * self.last_per_extent**progress

    def latest_start(self, iterations: int) -> int:
        """Return the iteration after which the cool-down has to begin to end at ``iterations``."""
        return max(1, int(iterations / (1.0 + self.part)))


def gains_per_doubling(measurements: Sequence[Measurement]) -> Floats | None:
    """Return the gain [V] of each view in dB for each doubling of the work, by lines through its measurements.

    None if they are fewer than MEASUREMENTS_MIN.
    """
    if len(measurements) < MEASUREMENTS_MIN:
        return None
    doublings = np.log2([m.n_pairs for m in measurements])
    slopes: Floats = np.polyfit(doublings, np.array([m.psnrs for m in measurements]), 1)[0]
    return slopes


def measured_ids(n_views: int, every: int) -> list[int]:
    """Return the training views that are measured: every ``every``-th, at least two, spread over the list.

    They are held back, unless there are too few views for that (:meth:`Cooling.holds_out`).

    Parameters
    ----------
    n_views : int
        Training views.
    every : int
        At least 2.
    """
    n = min(max(2, n_views // every), n_views)
    return [(2 * k + 1) * n_views // (2 * n) for k in range(n)]


def trained_ids(n_views: int, cooling: Cooling | None, pace: Pace) -> list[int]:
    """Return the training views that gradient steps may use now."""
    if cooling is None or not pace.holds_out or not cooling.holds_out(n_views):
        return list(range(n_views))
    held = set(measured_ids(n_views, cooling.hold_out_every))
    return [k for k in range(n_views) if k not in held]


def pace_to_json(pace: Pace) -> dict[str, Any]:
    """Return the pace as it is stored in a checkpoint."""
    return {
        **pace._asdict(),
        "measurements": [m._asdict() for m in pace.measurements],
        "decisions": [d._asdict() for d in pace.decisions],
        "while_cooling": [m._asdict() for m in pace.while_cooling],
    }


def pace_from_json(value: Mapping[str, Any]) -> Pace:
    """Read what :func:`pace_to_json` wrote.

    Raises
    ------
    ValueError, TypeError, KeyError
        It is something else.
    """
    measurements = tuple(map(_measurement, value["measurements"]))
    while_cooling = tuple(map(_measurement, value.get("while_cooling", ())))  # not in older checkpoints
    decisions = tuple(
        Decision(int(d["step"]), str(d["what"]), str(d["why"]), _optional(d["gain"]), _optional(d["standard_error"]))
        for d in value["decisions"]
    )
    cooling_from, last_step = (None if value[n] is None else int(value[n]) for n in ("cooling_from", "last_step"))
    switched_on = tuple(str(name) for name in value["switched_on"])
    is_pruning = bool(value.get("is_pruning", False))
    return Pace(
        measurements, decisions, int(value["n_pairs"]), cooling_from, last_step, switched_on, is_pruning, while_cooling
    )


def _measurement(value: Mapping[str, Any]) -> Measurement:
    psnrs, ssims = tuple(map(float, value["psnrs"])), tuple(map(float, value.get("ssims", ())))
    return Measurement(int(value["step"]), psnrs, int(value["n_gaussians"]), int(value["n_pairs"]), ssims)


def _optional(number: Any) -> float | None:
    return None if number is None else float(number)
