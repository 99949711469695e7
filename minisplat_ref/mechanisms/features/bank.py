"""Feature banks: functions from an image to maps of features, and their gradients."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from minisplat_ref.errors import InputError
from minisplat_ref.types import Floats


class FeatureBank(NamedTuple):
    """Features of an image and their gradient."""

    name: str
    features: Callable[[Floats], tuple[list[Floats], Any]]
    """``features(image [H, W, 3])`` of colours from 0 to 1: maps [h, w, C] in the image's dtype, and a tape."""
    features_vjp: Callable[[Any, Sequence[Floats]], Floats]
    """``features_vjp(tape, v_maps)``: the gradient [H, W, 3] with respect to the image."""
    min_side: int
    """Pixels that an image has at least in width and height."""


def check_size(bank: FeatureBank, width: int, height: int, what: str) -> None:
    """Refuse an image that is too small for a bank.

    Raises
    ------
    InputError
        Names the image, and the size that it has to have.
    """
    if min(width, height) < bank.min_side:
        raise InputError(
            f"{what} is {width} x {height} pixels, and the features ({bank.name}) need at least {bank.min_side} in"
            " width and height: give a larger one"
        )
