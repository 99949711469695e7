"""A renderer that is compared with the reference: ours in :mod:`.comparison`, other people's in :mod:`.peers`."""

from collections.abc import Callable
from typing import NamedTuple

from minisplat_ref.constants import Conventions
from minisplat_ref.oracle.golden.format import Arrays, Golden


def _keep(conventions: Conventions) -> Conventions:
    return conventions


class ComparedRenderer(NamedTuple):
    """A renderer that is compared."""

    name: str
    """For messages and reports."""
    dtype: str | None
    """``"float32"`` or ``"float64"``, in which it computes and which sets tolerances; None: the dtype of each array."""
    is_staged: bool
    """Whether the truth is the input of every stage, so that a difference arises in its own stage."""
    arrays: Callable[[Golden], Arrays]
    """Returns all arrays that it can for a scene with known truth; shapes as in the golden format."""
    rules: Callable[[Conventions], Conventions | None] = _keep
    """The conventions that it follows for a scene with these; None where it cannot render the scene at all."""
    ignores: tuple[str, ...] = ()
    """Cotangents that it cannot take; they are set to zero for the truth as well."""
    scenes: tuple[str, ...] | None = None
    """Names of the scenes that it has; None for any."""
