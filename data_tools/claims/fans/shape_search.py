"""The search for the reach and the rim of all fans at once, and images of fans or of Gaussians."""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import minimize

from minisplat_ref.extensions.fans.commands import find_representation
from minisplat_ref.extensions.fans.model import FanShape, convert_gaussians
from minisplat_ref.rendering import Request
from minisplat_ref.types import Floats, Gaussians, Model, View

REACHES = 1.0, 4.0  # between which k is sought
FIRST_REACHES, FIRST_RIMS = (1.5, 2.0, 2.5, 3.0, 3.5), (0.0, 0.2)  # the best of which a search begins with
EVALUATIONS = 60  # at most, of one search


def best_shape(
    gaussians: Gaussians, shape: FanShape, views: Sequence[View], targets: Sequence[Floats], background: Floats
) -> FanShape:
    """Return the shape with the reach and the rim whose images are nearest to targets.

    The simplex method starts from the best of a coarse grid: where a rim is not transparent, the error jumps as it
    moves over a pixel, and has many small minima.

    Parameters
    ----------
    gaussians : Gaussians
    shape : FanShape
        Its sides, and whether fans are flat.
    views : sequence of View
        From where.
    targets : sequence of ndarray of shape (H, W, 3)
        Photographs or images in [0, 1]; the sum of squared differences counts.
    background : ndarray of shape (3,)
        RGB behind everything.
    """

    def clipped(x: Floats) -> FanShape:
        return shape._replace(reach=float(np.clip(x[0], *REACHES)), rim=float(np.clip(x[1], 0, 1)))

    def cost(x: Floats) -> float:
        fans = convert_gaussians(gaussians, clipped(x))
        images = [render_clipped(fans, view, background=background) for view in views]
        return sum(float(np.mean((p - target) ** 2)) for p, target in zip(images, targets, strict=True))

    first = min((np.array(place) for place in product(FIRST_REACHES, FIRST_RIMS)), key=cost)
    simplex = first + np.array([[0.0, 0.0], [-0.2, 0.0], [0.0, 0.05]])
    options = {"maxfev": EVALUATIONS, "xatol": 0.005, "fatol": 1e-9, "initial_simplex": simplex}
    return clipped(minimize(cost, first, method="Nelder-Mead", options=options).x)


def render_clipped(population: Any, view: View, **request: Any) -> Floats:
    """Return the image [H, W, 3] of fans or Gaussians, clipped to [0, 1]; ``request`` as for :class:`Request`."""
    image = find_representation(population).renderer.render(Model(population), view, Request(**request))[0].image
    clipped: Floats = np.clip(image, 0, 1)
    return clipped


def alpha_of(population: Any, view: View, **request: Any) -> Floats:
    """Return the accumulated opacity [H, W] of fans or Gaussians."""
    output, _ = find_representation(population).renderer.render(Model(population), view, Request(**request))
    alpha: Floats = output.alpha
    return alpha
