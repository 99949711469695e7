"""Tile lists of primitives that have boxes in the image but no ellipses: discs, and Gaussians along rays."""

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Camera, Floats, Ints, Projection, TileBins, TileGrid

BOUNDLESS = (1e-12, 0.0, 1e-12)
"""Conic of an ellipse that fills every box: a million pixels, px^-2."""


def list_boxes(
    depths: Floats, radii: Ints, boxes: Ints, camera: Camera, conventions: Conventions, backend: Backend
) -> TileBins:
    """Return for each of the backend's tiles the primitives whose boxes overlap it, those of least depth first.

    Parameters
    ----------
    depths : ndarray of shape (N,)
        Of any unit; equal ones are listed in the order of the rows.
    radii : ndarray of shape (N, 2)
        0 where culled.
    boxes : ndarray of shape (N, 4)
        Pixels x0, y0, x1, y1 (half-open, in the image); empty where culled.
    camera : Camera
        Its size is used.
    conventions : Conventions
        For the backend.
    backend : Backend
        Its tiles, and its function for the lists.
    """
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    middles, conics = (boxes[:, :2] + boxes[:, 2:]) / 2, np.tile(BOUNDLESS, (len(depths), 1))
    filled = Projection(middles, depths, conics, np.ones(len(depths)), radii, boxes)
    return backend.bin_gaussians(filled, grid, conventions)
