"""Blur split of Mini-Splatting (Sec. 4.1, Eq. 2): a Gaussian that fills a patch of some view is split.

In a smooth, blurred region the positional gradient is small, so density control by gradients leaves one large Gaussian
where the photograph has detail. Such a Gaussian is recognised by its area, the number of pixels at which it has the
largest blending weight, and joins the split set of :func:`minisplat_ref.strategy.clone_split.clone_and_split`, whatever
its gradient and size.

The released code draws the children at random, as 3DGS does
(:func:`minisplat_ref.strategy.clone_split.random_children`). The other form, here, cuts the longest axis. Left out: the
collection of the areas from one event to the next, which is an action of the recipe.
"""

import math

import numpy as np

from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.strategy.ops import concat, take
from minisplat_ref.types import Bools, Gaussians, Ints

HALF_MEAN = math.sqrt(2 / math.pi)  # mean of |x| for x ~ N(0, 1): the centre of mass of the right half
HALF_SCALE = math.sqrt(1 - 2 / math.pi)  # its standard deviation; 1 / 1.66


def is_blurred(dominant_count: Ints, width: int, height: int, *, area_fraction: float, min_area: int = 0) -> Bools:
    """Return which Gaussians dominate too large a part of one view.

    Parameters
    ----------
    dominant_count : ndarray of shape (N,)
        Pixels at which the Gaussian has the largest blending weight.
    width, height : int
        Image size, pixels.
    area_fraction : float
        A Gaussian that dominates a larger fraction of the image is blurred; 2e-4 in the paper.
    min_area : int
        So many pixels are not blurred, however small the image.

    Returns
    -------
    mask : ndarray of shape (N,) of booleans
    """
    return dominant_count > max(area_fraction * width * height, min_area)


def principal_axis_children(gaussians: Gaussians, parent_ids: Ints, rng: np.random.Generator) -> Gaussians:
    """Return two children of each parent, one on either side of its centre on the longest axis.

    The plane through the centre, perpendicular to the longest axis k, cuts the Gaussian into two halves. Along k a
    child has the mean and the variance of its half; along the other axes it is like its parent::

        mu' = mu +- sqrt(2 / pi) s_k R_k        s_k' = sqrt(1 - 2 / pi) s_k

    The equal mixture of the two has the parent's mean and covariance, as 2 / pi + (1 - 2 / pi) = 1.

    Parameters
    ----------
    gaussians : Gaussians
    parent_ids : ndarray of shape (P,)
        Rows to split.
    rng : numpy.random.Generator
        Not used, but makes the signature that of :func:`minisplat_ref.strategy.clone_split.random_children`.

    Returns
    -------
    children : Gaussians
        2 P rows: the first child of every parent, then the second.
    """
    parents = take(gaussians, parent_ids)
    dtype = parents.means.dtype
    rows, longest = np.arange(len(parent_ids)), parents.log_scales.argmax(axis=1)  # [P], the first of equals
    axes = rotation_matrices(parents.quats)[rows, :, longest]  # [P, 3] world frame, unit length
    offsets = dtype.type(HALF_MEAN) * np.exp(parents.log_scales[rows, longest])[:, None] * axes  # [P, 3]
    parents.log_scales[rows, longest] += dtype.type(math.log(HALF_SCALE))  # take() copied
    return concat(
        parents._replace(means=parents.means + offsets),
        parents._replace(means=parents.means - offsets),
    )
