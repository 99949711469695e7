"""Learning rates and the spherical-harmonic degree as functions of the iteration (3DGS, Sec. 7.1).

Left out: the delayed start of the position rate, which the published settings never use.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.types import Floats, Ints


class Rewind(NamedTuple):
    """A jump back in a schedule: from iteration ``at`` on, it runs again from its value at ``to``."""

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
    """Mini-Splatting: Gaussians that were reinitialised in mid-run may move as far as new ones do."""

    def at(self, step: int) -> float:
        """Return the rate at ``step``."""
        if self.rewind is not None and step >= self.rewind.at:
            step = step - self.rewind.at + self.rewind.to
        progress = min(step / self.steps, 1.0)
        return float(self.first * (self.last / self.first) ** progress)

    def scale(self, factor: Fraction, times: float) -> "LogLinear":
        """Return the rate with the iterations multiplied by ``factor``, and itself by ``times``."""
        rewind = self.rewind and Rewind(round(self.rewind.at * factor), round(self.rewind.to * factor))
        return LogLinear(self.first * times, self.last * times, max(1, round(self.steps * factor)), rewind)

    def describe(self) -> dict[str, Any]:
        """Return the schedule in numbers and dicts."""
        return {**self._asdict(), "rewind": self.rewind and self.rewind._asdict()}


class Rates(NamedTuple):
    """Adam's learning rates by the name of the parameter: a field of the population, or a shared one."""

    of: Mapping[str, float | LogLinear]
    per_extent: frozenset[str] = frozenset({"means"})
    """Names of rates per unit of the scene's extent: in a scene twice as large, Gaussians move twice as far."""

    def at(self, step: int, extent: float) -> dict[str, float]:
        """Return every rate.

        Parameters
        ----------
        step : int
            Iteration, from 1.
        extent : float
            ``Scene.extent``, world units.
        """
        rates = {name: rate.at(step) if isinstance(rate, LogLinear) else rate for name, rate in self.of.items()}
        return {name: rate * extent if name in self.per_extent else rate for name, rate in rates.items()}

    def change(self, **rates: float | LogLinear) -> "Rates":
        """Return the rates with some of them replaced or added."""
        return self._replace(of={**self.of, **rates})

    def join(self, other: "Rates") -> "Rates":
        """Return these rates and the other's; for a name in both, these decide rate and extent."""
        return Rates({**other.of, **self.of}, self.per_extent | (other.per_extent - self.of.keys()))

    def scale(self, factor: Fraction, raised: float, raised_per_extent: float) -> "Rates":
        """Return the rates for a run of another length.

        Parameters
        ----------
        factor : Fraction
            Multiplies the lengths of the schedules.
        raised : float
            Multiplies the rates themselves,
        raised_per_extent : float
            except those per unit of the extent, which this multiplies.
        """

        def scaled_one(name: str, rate: float | LogLinear) -> float | LogLinear:
            times = raised_per_extent if name in self.per_extent else raised
            return rate.scale(factor, times) if isinstance(rate, LogLinear) else rate * times

        return self._replace(of={name: scaled_one(name, rate) for name, rate in self.of.items()})

    def describe(self) -> dict[str, Any]:
        """Return the rates in numbers, strings, lists and dicts."""
        of = {name: rate.describe() if isinstance(rate, LogLinear) else rate for name, rate in self.of.items()}
        return {"of": of, "per_extent": sorted(self.per_extent)}


def n_coefficients(degrees: Ints) -> Ints:
    """Return the number of coefficients above degree 0 that colours of these degrees have in each channel."""
    return (degrees.astype(np.int64) + 1) ** 2 - 1


def present_degrees(sh_rest: Floats) -> Ints:
    """Return the highest degree [N] of which a Gaussian has a coefficient that is not zero; ``sh_rest`` [N, K-1, 3]."""
    of_coefficients = np.sqrt(np.arange(1, sh_rest.shape[1] + 1)).astype(np.uint8)  # [K-1]
    return (sh_rest.any(axis=2) * of_coefficients).max(axis=1, initial=0)


def active_sh_degree(step: int, milestones: Sequence[int]) -> int:
    """Return the degree of the spherical harmonics to render at ``step``, if stored: one more after each milestone."""
    return sum(step >= milestone for milestone in milestones)
