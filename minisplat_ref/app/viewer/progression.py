"""The size of a viewer's next frame: small while the camera moves, then as large as requested."""

from typing import NamedTuple

from minisplat_ref.app.viewer.poses import Pose

COARSE_SECONDS = 0.1  # that a frame may take while the camera moves
SETTLED_SECONDS = 0.2  # without a new camera; a large frame is not interrupted by the next movement
DIVISORS = (1, 2, 4, 8, 16)  # of width and height
FINER = 4  # times, from a frame to the next: 1/16 of the pixels, so that small frames delay the full one by little
FIRST_DIVISOR = 8  # before any frame has been timed
SHORTEST = 16  # pixels of a side


class Wanted(NamedTuple):
    """The content that a browser should show."""

    pose: Pose
    layer: str
    width: int
    """Of the full frame, pixels."""
    height: int
    """Likewise."""


class Shown(NamedTuple):
    """The content that a browser shows."""

    wanted: Wanted | None = None
    divisor: int = 0
    """By which its frame is smaller than the full one."""
    version: int = 0
    """Of the model, which a training changes."""


def fit(width: int, height: int, longest: int) -> tuple[int, int]:
    """Return the size of the full frame of a window: the window's own, or smaller with the same aspect."""
    scale = min(1.0, longest / max(width, height, 1))
    return max(SHORTEST, round(scale * width)), max(SHORTEST, round(scale * height))


def reduced(width: int, height: int, divisor: int) -> tuple[int, int]:
    """Return the size of a frame that is smaller by a divisor."""
    return max(SHORTEST, round(width / divisor)), max(SHORTEST, round(height / divisor))


def coarse_divisor(wanted: Wanted, pixel_seconds: float | None) -> int:
    """Return the smallest divisor with which a frame is rendered in time; the largest where none is.

    Parameters
    ----------
    wanted : Wanted
    pixel_seconds : float or None
        Time of a pixel, as the last frame measured it; None before the first.
    """
    if pixel_seconds is None:
        return FIRST_DIVISOR
    full = wanted.width * wanted.height * pixel_seconds
    return next((d for d in DIVISORS if full / d**2 <= COARSE_SECONDS), DIVISORS[-1])


def next_divisor(
    wanted: Wanted, version: int, shown: Shown, still_seconds: float, pixel_seconds: float | None
) -> int | None:
    """Return the divisor of the next frame; None where there is nothing to render, or not yet.

    Parameters
    ----------
    wanted : Wanted
        What is to be shown.
    version : int
        Of the model.
    shown : Shown
        The last frame.
    still_seconds : float
        How long ago ``wanted`` last changed.
    pixel_seconds : float or None
        Time of a pixel; None before the first frame.
    """
    if wanted != shown.wanted:
        return coarse_divisor(wanted, pixel_seconds)
    if version != shown.version:
        return shown.divisor  # a training does not blur a view at rest
    if shown.divisor == 1 or still_seconds < SETTLED_SECONDS:
        return None
    return max(1, shown.divisor // FINER)
