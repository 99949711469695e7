"""Maps of a view as images: normals, and the parts of a material."""

import numpy as np

from minisplat_ref.io.srgb import encode_srgb
from minisplat_ref.types import Floats


def map_image(name: str, sums: Floats, alpha: Floats) -> np.ndarray:
    """Return the image [H, W, 3] uint8 of a map [H, W, 1 or 3] of sums over the hits: their means, black without hits.

    Normals, which are of unit length again, are shown as (n + 1) / 2, albedo as sRGB, and the others as they are.
    """
    is_hit = alpha[..., None] > 0
    means: Floats = sums / np.where(is_hit, alpha[..., None], 1)
    if name == "normal":
        length = np.linalg.norm(means, axis=2, keepdims=True)
        means = (means / np.where(length > 0, length, 1) + 1) / 2
    elif name == "albedo":
        means = encode_srgb(means)
    shown = np.broadcast_to(np.where(is_hit, means, 0), (*alpha.shape, 3))
    return np.round(255 * np.clip(shown, 0, 1)).astype(np.uint8)
