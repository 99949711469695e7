"""Images for inspection: renders beside photographs, errors and depths in colour."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from minisplat_ref.app.reports.colormaps import N_LEVELS, table
from minisplat_ref.types import Floats

Image8 = NDArray[np.uint8]  # [H, W, 3] sRGB

ERROR_RANGE = 0.25  # of [0, 1]: larger differences are all shown as the brightest colour
GAP = 4  # white pixels between images side by side


def to_8_bits(image: Floats) -> Image8:
    """Round a render [H, W, 3] in [0, 1] to 8 bits; values outside are clipped."""
    return np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def error_image(truth: Image8, render: Image8) -> Image8:
    """Colour the mean absolute difference of the three channels: dark is none, bright is ERROR_RANGE or more."""
    levels = truth.astype(np.int16)  # [H, W, 3]
    levels -= render
    difference = np.abs(levels, out=levels).mean(axis=2, dtype=np.float32) / 255.0  # [H, W]
    return colorize(difference, 0.0, ERROR_RANGE, "magma")


def depth_image(depth: Floats, near: float, far: float) -> Image8:
    """Colour a depth map [H, W]: near is bright, far is dark, pixels that see nothing (0) are black."""
    return colorize(depth, far, near, "viridis") * (depth > 0)[..., None].astype(np.uint8)


def depth_range(depth: Floats) -> tuple[float, float]:
    """Near and far end for :func:`depth_image`: the 1st and 99th percentile of the visible depths."""
    seen = depth[depth > 0]
    if seen.size == 0:
        return 0.0, 1.0
    near, far = np.quantile(seen, (0.01, 0.99))
    return float(near), float(far)


def colorize(values: Floats, low: float, high: float, colormap: str) -> Image8:
    """Colour values [H, W] with a map from ``low`` to ``high``, in either order."""
    fractions = np.clip((values - low) / ((high - low) or 1.0), 0.0, 1.0)  # [H, W]
    colors = np.rint(table(colormap)).astype(np.uint8)  # [256, 3]
    levels = np.minimum((fractions * N_LEVELS).astype(np.int64), N_LEVELS - 1)  # [H, W]
    return colors[levels]


def side_by_side(images: list[Image8]) -> Image8:
    """Join images of one height from left to right with a white gap."""
    gap = np.full((images[0].shape[0], GAP, 3), 255, dtype=np.uint8)
    with_gaps = [part for image in images for part in (gap, image)]
    return np.concatenate(with_gaps[1:], axis=1)


def split_images(joined: Image8, n: int) -> list[Image8]:
    """Take images apart that :func:`side_by_side` has joined; all are of one width."""
    width = (joined.shape[1] - (n - 1) * GAP) // n
    return [joined[:, k * (width + GAP) : k * (width + GAP) + width] for k in range(n)]


def fit_image(image: Image8, longest: int) -> Image8:
    """Return an image [H, W, 3] whose longer side has at most this many pixels, averaged down where it has more."""
    height, width = image.shape[:2]
    scale = longest / max(height, width)
    if scale >= 1:
        return image
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))
