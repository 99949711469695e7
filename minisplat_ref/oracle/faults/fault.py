"""What a planted error with a size is."""

from collections.abc import Callable
from typing import Any, NamedTuple

from minisplat_ref.oracle.golden.format import Arrays
from minisplat_ref.rendering.backends import REFERENCE, Backend


def _right(_: float) -> Backend:
    return REFERENCE


class Fault(NamedTuple):
    """A kind of error."""

    what: str
    """The error, in words that end a sentence: "as with ..."; a pair of braces holds its size, if it has one."""
    where: str
    """What is wrong: ``projection``, ``colours``, ``blending``, ``image``, or the ``gradient of`` one of them."""
    plant: Callable[[Any], Backend] = _right
    """Returns a backend that is wrong by a size."""
    sizes: tuple[float, ...] = (1.0,)
    """The usual ones, which are tried; those in between are fitted where ``null`` says how."""
    null: float | None = None
    """The size at which nothing is wrong, if the error grows from there without a jump."""
    after: Callable[[Arrays, float], Arrays] | None = None
    """Changes the images that the backend returns."""
    has_own_bounds: bool = False
    """Whether the boxes of its projection bound what is blended; otherwise alpha alone does."""

    @property
    def is_forward(self) -> bool:
        """Return whether images are wrong, rather than gradients."""
        return not self.where.startswith("gradient")

    def words(self, size: float) -> str:
        """Return the error with its size."""
        fitted = size if self.null is None else round(size, 4) + 0.0  # 1e-7 is no factor, but 0
        return self.what.format(f"{fitted:.3g}")
