"""The stage ``representation``: the kind of primitives. All have the six fields of 3DGS."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.mechanisms.surfels.discs import as_surfels
from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.rendering import SPLATTING, Renderer
from minisplat_ref.training.representation import as_it_is
from minisplat_ref.types import Gaussians


class Primitive(NamedTuple):
    """An alternative of the stage."""

    renderer: Renderer
    extend: Callable[[Gaussians, np.random.Generator], Gaussians]
    """Makes them of Gaussians."""


def gaussians() -> Primitive:
    """3D Gaussians."""
    return Primitive(SPLATTING, as_it_is)


def surfels() -> Primitive:
    """Gaussians on discs, those of 2DGS."""
    return Primitive(SURFELS, _as_discs)


def _as_discs(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return surfels; Gaussians that an initialiser has turned, which are not round, keep their axes."""
    discs, is_round = as_surfels(gaussians, rng), np.ptp(gaussians.log_scales, axis=1) == 0  # [N]
    return discs._replace(quats=np.where(is_round[:, None], discs.quats, gaussians.quats))
