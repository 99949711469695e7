"""The stage ``representation``: what the primitives are. All have the six fields of 3DGS."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.mechanisms.surfels.start import as_surfels
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
    return Primitive(SURFELS, as_surfels)
