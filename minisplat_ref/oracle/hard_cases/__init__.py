"""Scenes that break renderers, as data: each with why, with what is right, and with how near a precision has to come.

Reading order: ``case`` (what an entry is), ``shapes``, ``layers``, ``cameras``, ``images``, ``world``, ``colors``,
``losses``, ``bad_input`` (the entries), ``run`` (every precision, forward and backward), ``thresholds`` (pixels at
which rounding decides), ``summary`` (the worst of each kind).
"""

from minisplat_ref.oracle.hard_cases.bad_input import BAD_INPUT
from minisplat_ref.oracle.hard_cases.cameras import CAMERAS
from minisplat_ref.oracle.hard_cases.case import HardCase
from minisplat_ref.oracle.hard_cases.colors import COLORS
from minisplat_ref.oracle.hard_cases.images import IMAGES
from minisplat_ref.oracle.hard_cases.layers import LAYERS
from minisplat_ref.oracle.hard_cases.losses import LOSSES
from minisplat_ref.oracle.hard_cases.shapes import SHAPES
from minisplat_ref.oracle.hard_cases.world import WORLD_CASES

GROUPS: dict[str, tuple[HardCase, ...]] = {
    "shapes": SHAPES,
    "opacities and layers": LAYERS,
    "cameras": CAMERAS,
    "images": IMAGES,
    "world coordinates": WORLD_CASES,
    "colours": COLORS,
    "losses": LOSSES,
    "bad input": BAD_INPUT,
}
"""The catalogue by kind."""

HARD_CASES = tuple(case for cases in GROUPS.values() for case in cases)
"""The catalogue."""
