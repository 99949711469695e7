"""Learning rates and the spherical-harmonic degree as functions of the iteration (3DGS, Sec. 7.1).

Left out: the delayed start of the position rate, which the published settings never switch on.
"""

from collections.abc import Sequence
from typing import NamedTuple


class Rewind(NamedTuple):
    """A schedule that goes back once: from iteration ``at`` on it runs again from where it stood at ``to``."""

    at: int
    to: int


class LogLinear(NamedTuple):
    """A rate whose logarithm moves linearly with the iteration: ``first (last / first)^(step / steps)``."""

    first: float
    """Value at step 0."""
    last: float
    """Value at ``steps`` and after."""
    steps: int
    """Iterations from ``first`` to ``last``."""
    rewind: Rewind | None = None
    """Mini-Splatting: Gaussians that were made anew in mid-run may move as far as young ones do."""

    def at(self, step: int) -> float:
        """Return the rate at ``step``."""
        if self.rewind is not None and step >= self.rewind.at:
            step = step - self.rewind.at + self.rewind.to
        progress = min(step / self.steps, 1.0)
        return float(self.first * (self.last / self.first) ** progress)


class LearningRates(NamedTuple):
    """Adam's learning rate of each field of :class:`minisplat_ref.types.Gaussians`."""

    means: LogLinear
    """Per unit of the scene's extent: a scene twice as large moves its Gaussians twice as far."""
    quats: float
    log_scales: float
    opacity_logits: float
    sh_dc: float
    sh_rest: float

    def at(self, step: int, extent: float) -> tuple[float, ...]:
        """Return one rate per field, in field order.

        Parameters
        ----------
        step : int
            Iteration, from 1.
        extent : float
            ``Scene.extent``, world units.
        """
        return (self.means.at(step) * extent, *self[1:])


def active_sh_degree(step: int, milestones: Sequence[int], stored: int) -> int:
    """Return the spherical-harmonic degree rendered at ``step``: one more at each milestone, up to the stored one."""
    return min(stored, sum(step >= milestone for milestone in milestones))
