"""Surfels as a recipe's population: their start, their renderer, and the density control of 2D Gaussian Splatting."""

from functools import partial

import numpy as np

from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL, prune_faint
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import Event, Every, does
from minisplat_ref.types import Gaussians

LOG_THICKNESS = -16.0  # 1e-7 world units: what other programs draw, and where children of a split are placed
OPACITY_MIN = 0.05  # released; 3DGS has 0.005


def as_surfels(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return flat Gaussians that face at random, as the released code starts: those of 3DGS all face world z."""
    quats = rng.uniform(size=gaussians.quats.shape).astype(gaussians.quats.dtype)
    log_scales = gaussians.log_scales.copy()
    log_scales[:, 2] = LOG_THICKNESS
    return gaussians._replace(quats=quats, log_scales=log_scales)


def _set_opacity_min(event: Event) -> Event:
    """Return an event of 3DGS, with the released bound of opacity if it prunes faint Gaussians."""
    if isinstance(event, Every) and does(event, prune_faint):
        return event._replace(action=partial(prune_faint, min_opacity=OPACITY_MIN))
    return event


DISCS = Representation("surfels", extend=as_surfels, renderer=SURFELS)
DISC_EVENTS = tuple(_set_opacity_min(event) for event in GS_ACCEL.events)
"""The density control of 3DGS, which removes surfels of an opacity below 0.05."""
