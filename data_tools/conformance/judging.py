"""A picture of a probe against the reference: it agrees, it differs as a rule, or it differs and no rule explains it.

Pixels in 8 bits are compared in levels, 1/255. A picture that is rounded once is half a level off; a viewer that blends
in a buffer of 8 bits rounds once more for each hit, and one that stores colours in bytes has rounded them before. So a
pixel may be ``LEVELS`` off, half a level each for the colour, the opacity and the picture, and half a level more for
each hit; the corners of quads lie on a grid of 1/16 px. All pictures of a renderer are judged by its habits, which its
source states. A rule is one of the oracle's
planted faults on top of them, as ``pixel centres at 0``; where the difference is small, many faults come as near, and
one is named only if it leaves what 8 bits leave.

What agrees has to be able not to: a camera that is moved, and a probe whose Gaussians are others, are planted in the
reference, and the verdict says which of the two would have been seen.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from data_tools.conformance.habits import FORWARD, Habits, Shown, image_of, show
from data_tools.conformance.probes import Probe
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.types import Floats

LEVELS = 1.5
OF_A_HIT = 0.5  # levels, by which a buffer of 8 bits rounds
OF_THE_GRID = 1 / 32  # px, by which a corner of a quad is moved to the grid of 1/16 px (SUBPIXEL_BITS is 4)
GRID_AXES = tuple(f for f in FORWARD if f.where == "projection" and f.what.endswith((", in x", ", in y")))
EMPTY = "nothing is shown"
NEAR_CUT = 0.03  # part of the deviations or of the least alpha within which a pixel is at the cut, and not compared
BY_EIGHT_BITS = 0.5  # levels by which such a pixel differs
N_SIZES = 2
SMALL = 5.0  # levels of difference below which a rule is a guess unless it leaves no more than
EXACT = 1.0


class Verdict(NamedTuple):
    """What a picture of a probe shows."""

    probe: str
    result: str
    """``agrees``, ``rule``, ``unexplained`` or ``no picture``."""
    rule: str
    """The profile with which it agrees, or the rule that explains it."""
    largest: float
    """Largest difference from the renderer's profile, levels."""
    rms: float
    """Root mean square of the same."""
    quantised: float
    """Largest difference that rounding the reference to 8 bits makes, levels."""
    left: float
    """Largest difference that the rule leaves."""
    seen: tuple[str, ...] = ()
    """The planted errors that would turn an agreement red."""

    @property
    def words(self) -> str:
        """Return a cell of the table."""
        if self.result == "agrees":
            return "agrees"
        if self.result == "rule":
            return f"{self.rule} ({self.largest:.0f} levels)"
        return "no picture" if self.result == "no picture" else f"unexplained ({self.largest:.0f} levels)"


def _moved(probe: Probe) -> Probe:
    quat, t = probe.cam_from_world
    return probe._replace(cam_from_world=(quat, np.asarray(t) + np.array([0.2, 0, 0])))  # four pixels at a depth of 4


def _changed(probe: Probe) -> Probe:
    g = probe.gaussians
    larger, fainter = g.log_scales + np.float32(0.2), g.opacity_logits - np.float32(0.5)
    return probe._replace(gaussians=g._replace(log_scales=larger, opacity_logits=fainter))


PLANTED: Mapping[str, Callable[[Probe], Probe]] = {"camera": _moved, "probe": _changed}
"""A camera that is moved, and Gaussians that are a fifth larger and fainter."""


def seen_errors(probe: Probe, habits: Habits, image: Floats, levels: Floats) -> tuple[str, ...]:
    """Return which planted errors change a picture by more than the levels that it may be off."""
    wrong = {name: np.clip(image_of(change(probe), habits), 0, 1) for name, change in PLANTED.items()}
    return tuple(
        name for name, other in wrong.items() if (difference(np.rint(255 * other) / 255, image) > levels).any()
    )


def difference(picture: Floats, image: Floats) -> Floats:
    """Return the differences [H, W] of two pictures in levels, the largest of the channels."""
    return np.asarray(255 * np.abs(picture - np.clip(image, 0, 1)).max(axis=2))


def allowed(probe: Probe, habits: Habits, shown: Shown | None = None) -> Floats:
    """Return the levels [H, W] by which a picture in 8 bits may be off; infinite where a Gaussian is cut off."""
    shown = shown or show(probe, habits)
    levels = np.full(shown.image.shape[:2], LEVELS)
    for tile in tile_hits(shown.projection, shown.bins, habits.conventions):
        levels[tile.ys, tile.xs] += np.minimum(OF_A_HIT, 255 * tile.hit.unclamped).sum(axis=0)
    if habits.deviations is not None:
        for axis in GRID_AXES:
            before, after = (image_of(probe, habits, axis, 0.5 + k * OF_THE_GRID) for k in (-1, 1))
            levels += difference(np.clip(before, 0, 1), after) / 2
    for near, far in _neighbours(habits):
        inner, outer = image_of(probe, near), image_of(probe, far)
        levels[difference(np.clip(inner, 0, 1), outer) > BY_EIGHT_BITS] = np.inf
    return levels


def _neighbours(habits: Habits) -> list[tuple[Habits, Habits]]:
    """Return habits whose cuts are a little nearer and a little farther; lowered to 0, a Gaussian ends without one."""
    pairs, c = [], habits.conventions
    factors = (1 - NEAR_CUT, 1 + NEAR_CUT)
    if habits.deviations is not None and not habits.is_lowered:
        near, far = (habits._replace(deviations=habits.deviations * k) for k in factors)
        pairs.append((near, far))
    if 255 * c.alpha_min > 1.5:
        near, far = (habits._replace(conventions=c._replace(alpha_min=c.alpha_min * k)) for k in factors)
        pairs.append((near, far))
    return pairs


def judge(probe: Probe, picture: Floats, habits: Habits) -> Verdict:
    """Judge a picture by a renderer's habits, and by each planted fault on top of them.

    Parameters
    ----------
    probe : Probe
    picture : ndarray of shape (H, W, 3)
        In 0 to 1.
    habits : Habits
        The renderer's.
    """
    shown = show(probe, habits)
    image, levels = shown.image, allowed(probe, habits, shown)
    is_compared = np.isfinite(levels)
    off = difference(picture, image)
    quantised = float(difference(np.rint(255 * np.clip(image, 0, 1)) / 255, image).max())
    counted = off[is_compared]
    figures = float(counted.max(initial=0)), float(np.sqrt(np.mean(counted**2) if counted.size else 0.0)), quantised
    if (off <= levels).all():
        seen = seen_errors(probe, habits, image, levels)
        return Verdict(probe.name, "agrees", habits.conventions.name, *figures, figures[0], seen)
    if np.ptp(picture, axis=(0, 1)).max() == 0 and difference(picture, np.array(probe.background)).max() <= LEVELS:
        return Verdict(probe.name, "rule", EMPTY, *figures, 0.0)
    best = Verdict(probe.name, "unexplained", "", *figures, figures[0])
    for fault in FORWARD if probe.is_single else ():
        for size in fault.sizes[:N_SIZES]:
            errors = difference(picture, image_of(probe, habits, fault, size))
            left = float(errors[is_compared].max(initial=0))
            explains = (errors <= levels).all() and (figures[0] >= SMALL or left <= EXACT)
            if (explains, -left) > (best.result == "rule", -best.left):
                best = best._replace(result="rule" if explains else "unexplained", rule=fault.words(size), left=left)
                if explains and left <= EXACT:
                    return best
    return best
