"""The bundles of ray tracing, all in float64, because float32 has no digits left for a thin Gaussian far away.

P rays, N Gaussians, H hits.
"""

from typing import NamedTuple

from minisplat_ref.types import Bools, Floats, Ints


class Whitened(NamedTuple):
    """Gaussians with the maps that take them to the unit ball."""

    means: Floats
    """[N, 3] world frame."""
    maps: Floats
    """[N, 3, 3] ``M = diag(1/s) R^T``; not finite where a Gaussian cannot be drawn."""
    opacities: Floats
    """[N] in [0, 1]."""


class Rays(NamedTuple):
    """Half-lines, or parts of them: ``O + t d`` for near < t < far."""

    origins: Floats
    """[P, 3] world frame."""
    directions: Floats
    """[P, 3] of any length but zero; depths are in units of it."""
    near: Floats
    """[P]."""
    far: Floats
    """[P]."""


class Hits(NamedTuple):
    """The blended hits of rays, ray after ray, nearest first."""

    offsets: Ints
    """[P + 1] ray r has the hits offsets[r]:offsets[r + 1]."""
    ray_ids: Ints
    """[H]."""
    gaussian_ids: Ints
    """[H]."""
    unclamped: Floats
    """[H] alpha before the clamp."""
    depths: Floats
    """[H] t."""
    weights: Floats
    """[H] ``w = alpha T``."""
    transmittances: Floats
    """[P] behind the last hit."""


class BlendedRays(NamedTuple):
    """The colours that rays see, and what their gradient needs."""

    image: Floats
    """[P, 3] background included."""
    depths: Floats
    """[P] accumulated, ``sum w t``."""
    transmittances: Floats
    """[P] behind the last hit."""
    n_hits: Ints
    """[P] number of blended hits."""
    is_seen: Bools
    """[N] whether any ray has blended the Gaussian."""


class RayGradient(NamedTuple):
    """Gradient of the loss with respect to everything that :class:`BlendedRays` depends on."""

    means: Floats
    """[N, 3]."""
    maps: Floats
    """[N, 3, 3]."""
    opacities: Floats
    """[N]."""
    colors: Floats
    """[N, 3]."""
    background: Floats
    """[3]."""
    origins: Floats
    """[P, 3]."""
    directions: Floats
    """[P, 3]."""
