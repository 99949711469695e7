"""The one sort of a view: pairs (tile, Gaussian) by tile, and within a tile by depth.

Not yet on the device: NumPy sorts on the host.
"""

import numpy as np

from minisplat_ref.types import Ints


def sort_pairs(tiles: Ints, depth_bits: Ints) -> Ints:
    """Return the order of the pairs by (tile, depth); equal ones keep their order.

    Parameters
    ----------
    tiles : ndarray of shape (M,)
        Tile of each pair.
    depth_bits : ndarray of shape (M,)
        Bits of the Gaussian's depth as an integer: positive floats are ordered as their bits are.

    Returns
    -------
    ndarray of shape (M,)
        Index of the pair that comes first, of the second, and so on.
    """
    return np.lexsort((depth_bits, tiles))
