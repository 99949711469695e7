"""The representation of a scene by surfels, and the recipe that trains it."""

from functools import partial

from minisplat_ref.extensions.surfels.losses import LOSSES
from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.mechanisms.surfels.start import as_surfels
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL, prune_faint
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import Event, Every, does

OPACITY_MIN = 0.05  # released; 3DGS has 0.005


DISCS = Representation("surfels", extend=as_surfels, renderer=SURFELS)


def _with_opacity_min(event: Event) -> Event:
    """Return an event of 3DGS, with the released bound of opacity if it prunes faint Gaussians."""
    if isinstance(event, Every) and does(event, prune_faint):
        return event._replace(action=partial(prune_faint, min_opacity=OPACITY_MIN))
    return event


RECIPE = GS_ACCEL._replace(
    name="surfels",
    losses=(*GS_ACCEL.losses, *LOSSES),
    events=tuple(_with_opacity_min(event) for event in GS_ACCEL.events),
)
"""``surfels``: the schedule and the density control of 3DGS with the paper's two losses."""
