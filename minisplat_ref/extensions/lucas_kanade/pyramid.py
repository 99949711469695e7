"""Optical flow between two photographs: the method of Lucas and Kanade, 1981, on a pyramid, in NumPy.

In a window around each pixel the motion d is that for which the second image, moved back, is most like the first. With
the gradient g of the images, their difference e and the sums over window and colours, one step solves

    (sum g g^T + eps I) d = -sum g e

A step is right only while the motion is smaller than the blur of the image, so the flow of a coarse level is the start
of the next finer one (Bouguet 2000), where its median over 3 x 3 pixels moves the second image. There is no smoothness
term: where a window has no texture in two directions, or the flow there and back does not return, nothing is known.
Forward only; a loss takes the flow as it is.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from minisplat_ref.types import Bools, Floats

WINDOW = 2.0  # standard deviation of the window, pixels
N_STEPS = 6  # per level
SIDE_MIN = 16  # pixels of the coarsest level's shorter side
DAMPING = 1e-6  # eps, of intensities from 0 to 1
TEXTURE_MIN = 3e-5  # smaller eigenvalue of the window's mean of g g^T, per squared pixel
RETURN_MAX = 0.5  # pixels by which the flow there and back may miss


class Flow(NamedTuple):
    """The places of one photograph's pixels in another."""

    motion: Floats
    """[H, W, 2] along x and y, pixels."""
    is_known: Bools
    """[H, W]."""


def optical_flow(first: NDArray[Any], second: NDArray[Any]) -> Flow:
    """Return the flow from one photograph to another.

    Parameters
    ----------
    first, second : ndarray of shape (H, W, 3)
        Equally large; from 0 to 1, or uint8.
    """
    a, b = (_intensities(image) for image in (first, second))
    there, back = _flow(a, b), _flow(b, a)
    misses = np.linalg.norm(there + _moved(back, there), axis=2)
    rows, columns = np.mgrid[: a.shape[0], : a.shape[1]]
    x, y = columns + there[..., 0], rows + there[..., 1]
    is_inside = (x >= 0) & (x <= a.shape[1] - 1) & (y >= 0) & (y <= a.shape[0] - 1)
    return Flow(there, is_inside & (misses <= RETURN_MAX) & (_texture(a) >= TEXTURE_MIN))


def _intensities(image: NDArray[Any]) -> Floats:
    return image.astype(np.float64) * (1 / 255 if image.dtype == np.uint8 else 1.0)


def _flow(first: Floats, second: Floats) -> Floats:
    """Return the flow [H, W, 2] from coarse to fine."""
    levels = [(first, second)]
    while min(levels[-1][0].shape[:2]) >= 2 * SIDE_MIN:
        a, b = (ndimage.gaussian_filter(image, (1.0, 1.0, 0.0))[::2, ::2] for image in levels[-1])
        levels.append((a, b))
    flow = np.zeros((*levels[-1][0].shape[:2], 2))
    for a, b in reversed(levels):
        flow = _enlarged(flow, a.shape)
        for _ in range(N_STEPS):
            flow = ndimage.median_filter(flow + _step(a, _moved(b, flow)), size=(3, 3, 1))
    return flow


def _step(first: Floats, moved: Floats) -> Floats:
    """Return the solution d of the windows' equations, [H, W, 2]."""
    gy, gx = (np.gradient((first + moved) / 2, axis=axis) for axis in (0, 1))  # [H, W, C]
    e = moved - first
    xx, xy, yy, xe, ye = (_in_window(a, b) for a, b in ((gx, gx), (gx, gy), (gy, gy), (gx, e), (gy, e)))
    xx, yy = xx + DAMPING, yy + DAMPING
    determinant = xx * yy - xy * xy
    step = np.stack([xy * ye - yy * xe, xy * xe - xx * ye], axis=2) / determinant[..., None]
    return np.clip(step, -1.0, 1.0)  # beyond a pixel the linear model is invalid


def _in_window(a: Floats, b: Floats) -> Floats:
    """Return the mean of a b over channels and window, [H, W]."""
    return np.asarray(ndimage.gaussian_filter(np.mean(a * b, axis=2), WINDOW))


def _texture(image: Floats) -> Floats:
    """Return the smaller eigenvalue of the mean of g g^T, [H, W]."""
    gy, gx = (np.gradient(image, axis=axis) for axis in (0, 1))
    xx, xy, yy = (_in_window(a, b) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    smaller: Floats = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    return smaller


def _moved(image: Floats, flow: Floats) -> Floats:
    """Return the image [H, W, C] at where the flow leads, linearly interpolated; beyond the edge the edge."""
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    places = [rows + flow[..., 1], columns + flow[..., 0]]
    channels = np.moveaxis(image, 2, 0)
    return np.stack([ndimage.map_coordinates(each, places, order=1, mode="nearest") for each in channels], axis=2)


def _enlarged(flow: Floats, shape: tuple[int, ...]) -> Floats:
    """Return a flow for a level of twice the size, of which every second pixel was kept."""
    if flow.shape[:2] == shape[:2]:
        return flow
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    places = [rows / 2, columns / 2]
    doubled = [2 * ndimage.map_coordinates(flow[..., i], places, order=1, mode="nearest") for i in range(2)]
    return np.stack(doubled, axis=2)
