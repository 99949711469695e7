"""Scenes that break renderers, as data: each with the reason, the correct behaviour, and the tolerance per precision.

Reading order: ``subjects`` (the definition of an entry, and its rendering), ``scenes`` (building blocks); the entries:
``shapes``, ``layers`` (opacities, thresholds, depths), ``cameras`` (with world coordinates), ``images`` (with colours
and losses), ``random_scenes`` (all of that at random, at three sizes), ``bad_input``; ``run`` (every precision, forward
and backward, and the worst of each kind).
"""

from minisplat_ref.oracle.hard_cases.bad_input import BAD_INPUT
from minisplat_ref.oracle.hard_cases.cameras import CAMERAS, WORLD_CASES
from minisplat_ref.oracle.hard_cases.images import COLORS, IMAGES, LOSSES
from minisplat_ref.oracle.hard_cases.layers import LAYERS
from minisplat_ref.oracle.hard_cases.random_scenes import RANDOM_SCENES
from minisplat_ref.oracle.hard_cases.shapes import SHAPES
from minisplat_ref.oracle.hard_cases.subjects import HardCase

GROUPS: dict[str, tuple[HardCase, ...]] = {
    "shapes": SHAPES,
    "opacities and layers": LAYERS,
    "cameras": CAMERAS,
    "images": IMAGES,
    "world coordinates": WORLD_CASES,
    "colours": COLORS,
    "losses": LOSSES,
    "random scenes": RANDOM_SCENES,
    "bad input": BAD_INPUT,
}
"""The catalogue by kind."""

HARD_CASES = tuple(case for cases in GROUPS.values() for case in cases)
"""The catalogue."""
