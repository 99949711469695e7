"""What a hard case is: a scene that breaks renderers, why, what is right, and how near a precision has to come."""

from collections.abc import Callable
from typing import NamedTuple

from minisplat_ref.oracle.hard_cases.subjects import Subject
from minisplat_ref.oracle.tolerances import ORDINARY, HardCaseTolerance


class HardCase(NamedTuple):
    """One entry of the catalogue."""

    name: str
    """Unique; words with hyphens."""
    why: str
    """Why it is hard, one line."""
    correct: str
    """What a correct renderer does, one line."""
    build: Callable[[], Subject]
    """Makes the scene; its numbers are the same in every precision."""
    tolerance: HardCaseTolerance = ORDINARY
    """How far each precision may be from the float64 reference."""
    is_background: bool = False
    """Whether the image is the background and nothing but the background has a gradient."""
    refusal: str | None = None
    """Part of the message with which the input is refused; None where it is drawn."""
