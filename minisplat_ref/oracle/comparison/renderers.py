"""What a renderer must be able to do in order to be compared: give arrays of the golden format for a scene."""

from collections.abc import Callable
from typing import NamedTuple

from minisplat_ref.constants import Conventions
from minisplat_ref.oracle.golden.arrays import Arrays
from minisplat_ref.oracle.golden.scenes import Golden


def _as_they_are(conventions: Conventions) -> Conventions:
    return conventions


class Renderer(NamedTuple):
    """Whoever is compared."""

    name: str
    """For messages and reports."""
    dtype: str | None
    """``"float32"`` or ``"float64"``: what it computes in, which sets the tolerances; None: the dtype of each array."""
    is_staged: bool
    """Whether every stage was fed with the truth, so that a difference arose in its own stage."""
    arrays: Callable[[Golden], Arrays]
    """All arrays that it can give for a scene of which the truth is known; shapes as in the golden format."""
    rules: Callable[[Conventions], Conventions | None] = _as_they_are
    """The conventions that it follows when a scene asks for these; None where it cannot draw the scene at all."""
    ignores: tuple[str, ...] = ()
    """Cotangents that it cannot take; they are made zero for the truth as well."""
    scenes: tuple[str, ...] | None = None
    """Names of the scenes that it has; None for any."""
