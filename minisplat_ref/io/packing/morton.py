"""Morton order, in which points that are near each other in space are mostly near each other in a list.

The code of a cell ``(x, y, z)`` interleaves the bits of its coordinates, ``... z1 y1 x1 z0 y0 x0``. Sorting by the code
visits the leaves of an octree in order, so consecutive points are similar and pack well.
"""

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.types import Floats, Ints

BITS = 21  # of a coordinate: three of them fill 63 bits
# These steps spread 21 bits to every third place; each moves the upper half of every group by its distance.
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_cells(points: Floats | Ints, *, is_cubic: bool = True) -> NDArray[np.uint64]:
    """Return the cell of each point in the smallest cube, or box, that holds them all, with 2^21 cells per side.

    Parameters
    ----------
    points : ndarray of shape (N, 3)
        Finite coordinates in any frame.
    is_cubic : bool
        Whether cells are cubes. In a box, they have its proportions: of a flat scene, all bits of all axes count.

    Returns
    -------
    ndarray of shape (N, 3) of uint64
        Coordinates of the cells, below 2^21.
    """
    if len(points) == 0:
        return np.zeros((0, 3), np.uint64)
    points = points.astype(np.float64)
    low = points.min(axis=0)  # [3]
    sides = points.max(axis=0) - low  # [3]
    if is_cubic:
        sides[:] = sides.max()
    parts = np.divide(points - low, sides, out=np.zeros(points.shape), where=sides > 0)  # [N, 3] of the side
    return np.minimum(parts * 2.0**BITS, 2.0**BITS - 1).astype(np.uint64)


def morton_codes(cells: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the codes [N] of cells [N, 3], each below 2^21: bit b of axis a becomes bit 3 b + a."""
    spread = cells.astype(np.uint64)  # [N, 3], a copy
    for distance, mask in _SPREAD:
        spread = (spread | (spread << np.uint64(distance))) & np.uint64(mask)
    return spread[:, 0] | (spread[:, 1] << np.uint64(1)) | (spread[:, 2] << np.uint64(2))


def morton_order(points: Floats | Ints, *, is_cubic: bool = True) -> Ints:
    """Return the rows [N] of points [N, 3] in Morton order; points of one cell keep their order."""
    return np.argsort(morton_codes(morton_cells(points, is_cubic=is_cubic)), kind="stable")
