"""A picture of a probe against the reference: it agrees, it differs as a rule, or it differs and no rule explains it.

Pixels in 8 bits are compared in levels, 1/255. A picture that is rounded once is half a level off; a viewer that blends
in a buffer of 8 bits rounds once more for each hit, and one that stores colours in bytes has rounded them before. So a
pixel may be ``LEVELS`` off, half a level each for the colour, the opacity and the picture, and half a level more for
each hit. Viewers have habits that no profile has: they cut Gaussians off at the square root of 8 deviations, the border
of the quad that they draw, or lower them to 0 there, and some have no low-pass. These are tried with each profile, and
all pictures of a renderer are judged by the same ones. A rule is one of the oracle's planted faults on top of them, as
``pixel centres at 0``.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from data_tools.conformance.probes import Probe, golden_of
from minisplat_ref.constants import GSPLAT_MAIN, PROFILES, Conventions
from minisplat_ref.oracle.comparison.trials import run_fault
from minisplat_ref.oracle.faults import FAULTS, Fault
from minisplat_ref.oracle.faults.blending import with_weights
from minisplat_ref.oracle.golden.format import Golden
from minisplat_ref.oracle.golden.running import projection_of, reference_bins
from minisplat_ref.reference.hits import TileHits, tile_hits, transmit
from minisplat_ref.types import Floats

LEVELS = 1.5
OF_A_HIT = 0.5  # levels, by which a buffer of 8 bits rounds
VIEWER = GSPLAT_MAIN._replace(name="VIEWER", alpha_max=1.0, transmittance_min=0.0)
"""The rules of a blending unit: no clamp of alpha, no stop."""
SQRT_8 = 8**0.5
EMPTY = "nothing is shown"


class Habits(NamedTuple):
    """The rules by which all pictures of a renderer are judged."""

    conventions: Conventions
    deviations: float | None = None
    """Beyond which a Gaussian is cut off."""
    is_lowered: bool = False
    """Whether the falloff is lowered and stretched, so that it is 0 where it is cut off and 1 in the middle."""

    @property
    def name(self) -> str:
        """Return the profile and what differs from it."""
        low_pass = "" if self.conventions.eps2d else ", no low-pass"
        compensated = ", compensated" if self.conventions.is_antialiased else ""
        cut = "" if self.deviations is None else f", cut at {self.deviations:.2f} deviations"
        return f"{self.conventions.name}{cut}{', lowered to 0 there' if self.is_lowered else ''}{low_pass}{compensated}"

    def weigh(self, tile: TileHits, _: Any) -> tuple[Floats, Floats]:
        """Return the weights of hits that are cut off, and the share of the background."""
        assert self.deviations is not None
        least = np.exp(-(self.deviations**2) / 2)
        falloffs = tile.hit.place.falloffs
        alphas = np.where(falloffs >= least, tile.alphas, 0)
        if self.is_lowered:
            lowered = np.maximum(falloffs - least, 0) / (1 - least)
            alphas = tile.hit.unclamped * lowered / np.maximum(falloffs, least / 2)
            alphas = np.where(alphas >= self.conventions.alpha_min, np.minimum(alphas, self.conventions.alpha_max), 0)
        T = transmit(alphas)
        return alphas * T[:-1], T[-1]


def _habits() -> Iterator[Habits]:
    for conventions in (VIEWER, *PROFILES.values()):
        yield Habits(conventions)
        if conventions.has_full_support:
            for changed in (
                conventions,
                conventions._replace(eps2d=0.0),
                conventions._replace(is_antialiased=True),
            ):
                yield Habits(changed, SQRT_8)
    yield Habits(VIEWER, SQRT_8, True)
    yield Habits(VIEWER._replace(is_antialiased=True), SQRT_8, True)


HABITS = tuple(_habits())
NONE = Fault("", "projection")
NEAR_CUT = 0.03  # part of the deviations within which a pixel is at the cut, and not compared
BY_EIGHT_BITS = 0.5  # levels by which such a pixel differs
N_SIZES = 2
SIMPLE = ("centre", "tiny", "needle", "tail", "border", "turned")
"""Probes by which habits are chosen."""
FEW = 0.01  # of the pixels, which may be at a cut
MANY = 4  # Gaussians from which on a probe shows more than one rule


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

    @property
    def words(self) -> str:
        """Return a cell of the table."""
        if self.result == "agrees":
            return "agrees"
        if self.result == "rule":
            return f"{self.rule} ({self.largest:.0f} levels)"
        return "no picture" if self.result == "no picture" else f"unexplained ({self.largest:.0f} levels)"


def difference(picture: Floats, image: Floats) -> Floats:
    """Return the differences [H, W] of two pictures in levels, the largest of the channels."""
    return np.asarray(255 * np.abs(picture - np.clip(image, 0, 1)).max(axis=2))


def image_of(scene: Golden, habits: Habits, fault: Fault = NONE, size: float = 1.0) -> Floats:
    """Return the reference's image [H, W, 3] of a scene by a renderer's habits, with a fault.

    An error of the blending is planted without the cut.
    """
    if habits.deviations is not None and fault.where in ("projection", "colours", "image"):
        weigh = with_weights(habits.weigh).composite
        plant = fault.plant
        fault = fault._replace(plant=lambda by: replace(plant(by), composite=weigh))
    return np.nan_to_num(run_fault(fault, size, scene, is_fed=False)["image"])


def allowed(scene: Golden, habits: Habits) -> Floats:
    """Return the levels [H, W] by which a picture in 8 bits may be off; infinite where a Gaussian is cut off."""
    bins = reference_bins(scene.arrays, scene.conventions, (16, 16))
    levels = np.full(scene.arrays["alpha"].shape, LEVELS)
    for tile in tile_hits(projection_of(scene.arrays), bins, scene.conventions):
        levels[tile.ys, tile.xs] += OF_A_HIT * (tile.hit.unclamped > 0.1 / 255).sum(axis=0)
    if habits.deviations is not None and not habits.is_lowered:  # lowered, it ends without a step
        ends = [habits._replace(deviations=habits.deviations * (1 + k * NEAR_CUT)) for k in (-1, 1)]
        inner, outer = (image_of(scene, end) for end in ends)
        levels[255 * np.abs(inner - outer).max(axis=2) > BY_EIGHT_BITS] = np.inf
    return levels


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
    scene = golden_of(probe, habits.conventions)
    image, levels = image_of(scene, habits), allowed(scene, habits)
    off = difference(picture, image)
    quantised = float(difference(np.rint(255 * np.clip(image, 0, 1)) / 255, image).max())
    counted = off[np.isfinite(levels)]
    figures = float(counted.max(initial=0)), float(np.sqrt(np.mean(counted**2) if counted.size else 0.0)), quantised
    if (off <= levels).all():
        return Verdict(probe.name, "agrees", habits.name, *figures, figures[0])
    if np.ptp(picture, axis=(0, 1)).max() == 0 and difference(picture, np.array(probe.background)).max() <= LEVELS:
        return Verdict(probe.name, "rule", EMPTY, *figures, 0.0)
    best = Verdict(probe.name, "unexplained", "", *figures, figures[0])
    if len(probe.gaussians.means) > MANY:
        return best
    for fault in FAULTS:
        for size in fault.sizes[:N_SIZES] if fault.is_forward else ():
            left = difference(picture, image_of(scene, habits, fault, size))
            if (left <= levels).all():
                return best._replace(
                    result="rule", rule=fault.words(size), left=float(left[np.isfinite(levels)].max(initial=0))
                )
            largest = float(left[np.isfinite(levels)].max(initial=0))
            if largest < best.left:
                best = best._replace(rule=fault.words(size), left=largest)
    return best


def nearest_habits(pictures: Mapping[str, Floats], probes: Mapping[str, Probe]) -> Habits:
    """Return the habits with which most pictures of single Gaussians agree; of equals, those that are off least."""
    simple = [name for name in SIMPLE if name in pictures] or list(pictures)

    def merit(habits: Habits) -> tuple[int, float]:
        n, total = 0, 0.0
        for name in simple:
            off = difference(pictures[name], image_of(golden_of(probes[name], habits.conventions), habits))
            n, total = n + int(np.mean(off > LEVELS + OF_A_HIT) < FEW), total + float(np.mean(off))
        return n, -total

    return max(HABITS, key=merit)
