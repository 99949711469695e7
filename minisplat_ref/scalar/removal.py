"""The change of one channel of one pixel without one Gaussian; see ``reference.removal``."""

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import minimum, select
from minisplat_ref.jit.literals import ONE, ZERO


@scalar
def odds(weight, unclamped, frame):
    """Return alpha / (1 - alpha) of a hit, 0 where it was none."""
    alpha = minimum(unclamped, frame.alpha_max)
    return select(weight > ZERO, alpha / (ONE - alpha), ZERO)


@scalar
def removal_change(light, hit_odds, behind):
    """Return the change of a channel, given a hit's light w c and the light from behind it: w c - odds * behind."""
    return light - hit_odds * behind
