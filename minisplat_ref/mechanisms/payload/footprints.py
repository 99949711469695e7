"""Footprints of Gaussians with a payload: the ellipses of 3DGS, with the payload's data."""

from dataclasses import dataclass

from minisplat_ref.types import Floats, Ints, Projection


@dataclass(frozen=True)
class Footprints:
    """Ellipses in an image; a relative derives its own class, whose further fields are the payload's."""

    projection: Projection

    @property
    def means2d(self) -> Floats:
        """[N, 2] centres, px."""
        return self.projection.means2d

    @property
    def conics(self) -> Floats:
        """[N, 3] Q, px^-2."""
        return self.projection.conics

    @property
    def opacities(self) -> Floats:
        """[N] of the projection."""
        return self.projection.opacities


def boxes_of(footprints: Footprints) -> Ints:
    """Return the boxes [N, 4] of the projection, outside of which a payload renders nothing."""
    return footprints.projection.boxes
