"""The representation of a scene: the population that is trained, how it is initialised, how it is rendered.

The first is :data:`GAUSSIANS`, that of 3DGS. An extension's has further fields or another renderer.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.io.frames import Unit, Units
from minisplat_ref.rendering import SPLATTING, Renderer
from minisplat_ref.strategy.initialization import IsInside, may_be_inside
from minisplat_ref.training.rates import Rates
from minisplat_ref.types import NOTHING, Floats, Gaussians, Scene


def as_it_is(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return the Gaussians themselves as the population."""
    return gaussians


def nothing_shared(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return no shared parameters."""
    return NOTHING


WORLD_UNITS: Units = {"means": Unit.PLACE, "log_scales": Unit.LOG_LENGTH}
"""The fields of 3DGS that are in world units."""


class Representation(NamedTuple):
    """The population that represents a scene, its initialisation and its renderer."""

    name: str
    population: Any = Gaussians
    """The NamedTuple of arrays [N, ...] that is trained; its first field is ``means``."""
    extend: Callable[[Gaussians, np.random.Generator], Any] = as_it_is
    """Turns Gaussians into the population, at the start and after every reinitialisation."""
    shared: Callable[[Scene, np.random.Generator], Mapping[str, Floats]] = nothing_shared
    """Returns the initial shared parameters."""
    renderer: Renderer = SPLATTING
    rates: Rates = Rates({}, frozenset())
    """Learning rates of fields and shared parameters for which the recipe has none."""
    takes_optics: bool = False
    """Whether the renderer supports lenses; then scenes are read as photographed."""
    is_inside: IsInside = may_be_inside
    """Whether points are inside a camera's image, as the renderer defines it; random points that no camera sees are
    left out."""
    units: Units = WORLD_UNITS
    """The fields and shared parameters in world units, and their kinds of unit: see :mod:`minisplat_ref.io.frames`."""
    extends: frozenset[str] = frozenset()
    """Names of further representations whose populations ``extend`` takes: a training can start from their models."""
    from_file: Callable[[Path, Scene, int, np.random.Generator], Any] | None = None
    """``from_file(path, scene, sh_degree, rng)``: the population of a file that ``--init`` names, where such a file is
    more than points. A training by its recipes needs one, or a run."""

    @property
    def is_plain(self) -> bool:
        """Whether Gaussians of 3DGS are trained and rendered as 3DGS does it, however they begin."""
        return (self.population, self.renderer) == (Gaussians, SPLATTING)


GAUSSIANS = Representation("gaussians")
"""3DGS: static Gaussians with spherical harmonics."""


def convert_population(
    population: Any, theirs: Representation, wanted: Representation, rng: np.random.Generator
) -> Any:
    """Return a trained population as that of another representation, with which a training continues.

    It stays as it is where both are of one kind, and where both are of 3DGS and differ only in how they begin.

    Parameters
    ----------
    population : NamedTuple
        Of ``theirs``.
    theirs, wanted : Representation
    rng : numpy.random.Generator
        For what ``wanted.extend`` draws.

    Returns
    -------
    NamedTuple or None
        None where it is of another kind, with fields that ``wanted`` has not.
    """
    is_same = wanted.name == theirs.name or (wanted.is_plain and theirs.is_plain)
    if is_same and theirs.name not in wanted.extends:
        return population
    if type(population) is Gaussians or theirs.name in wanted.extends:
        return wanted.extend(population, rng)
    return None


def count_floats(population: Any) -> int:
    """Return the number of floats of a primitive of the population."""
    return sum(int(np.prod(field.shape[1:])) for field in population)
