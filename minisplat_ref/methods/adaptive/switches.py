"""The calibrations that ``adaptive`` switches on, and the rule for it: one function, and a table.

Each calibration (:mod:`minisplat_ref.training.calibration`) is examined once, in one iteration. It is switched on if
the photographs' gain by it is above a minimum gain and above a number of standard errors
(:mod:`minisplat_ref.methods.adaptive.evidence`). Exposures are not among them: the tracks of the sparse points show
those before the first iteration (:mod:`minisplat_ref.strategy.track_gains`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from minisplat_ref.methods.adaptive.antialiasing import examine_antialiasing
from minisplat_ref.methods.adaptive.evidence import Answer
from minisplat_ref.methods.adaptive.numbers import N_ERRORS, SKY_N_ERRORS
from minisplat_ref.methods.adaptive.pose import examine_poses
from minisplat_ref.methods.adaptive.sky import examine_sky
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.calibration import ANTIALIASING, BACKDROP, POSE, Calibration
from minisplat_ref.training.pace import Decision
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats


@dataclass(frozen=True)
class Switch:
    """An action that switches a calibration on if the photographs need it, ``switch_NAME_on``."""

    calibration: Calibration
    decision: str
    """Its name in the record of decisions."""
    already: str
    """The message where it is on."""
    examine: Callable[[TrainState, Iteration], Answer | str]
    """Examines the photographs; returns the reason where there is nothing to examine."""
    n_errors: float = N_ERRORS
    """Standard errors that the gain must exceed."""

    @property
    def __name__(self) -> str:
        """Name of the action in records and descriptions."""
        return f"switch_{self.calibration.name}_on"

    def __call__(self, state: TrainState, iteration: Iteration, **min_gain: float) -> str:
        """Switch the calibration on, or report the reason against it.

        Parameters
        ----------
        state, iteration
            As for every action.
        **min_gain
            ``min_NAME_gain`` of this calibration: dB of the squared error that the photographs must gain on average.
        """
        answer = self._supported(state, iteration, min_gain[f"min_{self.calibration.name}_gain"])
        if isinstance(answer, str):
            return f"nothing done: {answer}"
        evidence = answer.evidence
        decision = Decision(iteration.step, self.decision, answer.why, evidence.gain, evidence.standard_error)
        add_calibration(state, self.calibration, answer.begin(), decision)
        return answer.why

    def _supported(self, state: TrainState, iteration: Iteration, min_gain: float) -> Answer | str:
        """Return the photographs' evidence if it supports the calibration, and otherwise the reason against it."""
        if self.calibration.initial(1).keys() <= state.shared.keys():
            return self.already
        answer = self.examine(state, iteration)
        if isinstance(answer, str):
            return answer
        if answer.evidence.is_above(min_gain, self.n_errors):
            return answer
        return f"{answer.why}; it takes {min_gain:g} dB and {self.n_errors:g} standard error{'s'[: self.n_errors > 1]}"


def add_calibration(
    state: TrainState, calibration: Calibration, parameters: Mapping[str, Floats], decision: Decision
) -> None:
    """Continue the training with a calibration.

    Parameters
    ----------
    state : TrainState
    calibration : Calibration
    parameters : mapping
        Its initial shared parameters.
    decision : Decision
        Its evidence.
    """
    zeros = zero_moments(parameters)
    state.shared = {**state.shared, **parameters}
    adam = state.shared_adam
    state.shared_adam = adam._replace(
        first={**adam.first, **zeros.first},
        second={**adam.second, **zeros.second},
        joined={**adam.joined, **dict.fromkeys(parameters, adam.step)},
    )
    pace = state.pace.with_decision(decision)
    state.pace = pace._replace(switched_on=(*pace.switched_on, calibration.name))


switch_sky_on = Switch(BACKDROP, "sky", "there is a sky", examine_sky, SKY_N_ERRORS)
switch_antialiasing_on = Switch(ANTIALIASING, "anti-aliasing", "opacities are compensated", examine_antialiasing)
switch_pose_on = Switch(POSE, "poses", "poses are refined", examine_poses)

SWITCHES = {switch.calibration.name: switch for switch in (switch_sky_on, switch_antialiasing_on, switch_pose_on)}
"""By the name of the calibration, in the order in which they are examined."""
