"""The modes of the network's effect, as functions: ``--set modulation=NAME`` chooses one."""

from typing import NamedTuple


class Mode(NamedTuple):
    """The use of the network's outputs."""

    opacity: bool
    """The first output changes the opacity."""
    colors: bool
    """The others change the coefficients of colour."""
    is_sum: bool
    """``x + y`` instead of ``x (1 + y)``."""


def opacity_times() -> Mode:
    """Multiply the opacity, which is the paper's choice."""
    return Mode(True, False, is_sum=False)


def opacity_plus() -> Mode:
    """Add to the opacity."""
    return Mode(True, False, is_sum=True)


def colors_times() -> Mode:
    """Multiply the coefficients of colour."""
    return Mode(False, True, is_sum=False)


def colors_plus() -> Mode:
    """Add to the coefficients of colour."""
    return Mode(False, True, is_sum=True)


def both_times() -> Mode:
    """Multiply both."""
    return Mode(True, True, is_sum=False)


def both_plus() -> Mode:
    """Add to both."""
    return Mode(True, True, is_sum=True)
