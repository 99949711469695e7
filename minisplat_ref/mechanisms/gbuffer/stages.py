"""On which side of its steps a shaded point is, for checks of the gradient: what is read linearly has kinks."""

import numpy as np

from minisplat_ref.mechanisms.gbuffer.brdf import SIZE
from minisplat_ref.mechanisms.gbuffer.environment import locate
from minisplat_ref.mechanisms.gbuffer.prefilter import KNOTS
from minisplat_ref.mechanisms.gbuffer.shading import ShadingTape
from minisplat_ref.mechanisms.gbuffer.tone import KNEE
from minisplat_ref.types import Floats


def sides_of(tape: ShadingTape, linear: Floats) -> list[np.ndarray]:
    """Return the texels that are read of every map, the cells of both tables, and the sides of all clamps.

    Parameters
    ----------
    tape : ShadingTape
        From :func:`minisplat_ref.mechanisms.gbuffer.shading.shade`.
    linear : ndarray of shape (P, 3)
        The colours that it returned, before the tone curve.
    """
    sides = [locate(tape.r, *image.shape[:2]).texels for image in tape.light.maps]
    rows = [tape.r @ (0, 0, 1.0) > np.cos(np.pi * (0.5 / len(image))) for image in tape.light.maps]  # beyond the first
    rows += [tape.r @ (0, 0, -1.0) > np.cos(np.pi * (0.5 / len(image))) for image in tape.light.maps]
    roughness = tape.surface.roughness
    cells = [np.floor(x * (SIZE - 1)) for x in (tape.cosines, roughness)]
    return [*sides, *rows, np.searchsorted(KNOTS, roughness), *cells, tape.cosines > 0, linear > KNEE]
