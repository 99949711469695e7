"""The geometric terms as loss terms, with their inputs and the channels that receive their gradients."""

from functools import partial
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.geometry import kernels, reference
from minisplat_ref.extensions.geometry.weights import GeometricWeights
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered


def geometric(rendered: Rendered, weights: GeometricWeights) -> tuple[float, Cotangents]:
    """Return the geometric loss, and its derivatives with respect to the depth channel and alpha.

    Parameters
    ----------
    rendered : Rendered
        The view, with a depth channel.
    weights : GeometricWeights
        Factors of the terms.
    """
    view = rendered.view
    points = rendered.scene.points[view.point_ids] if view.point_ids is not None else rendered.scene.points[:0]
    photograph = view.image * np.float32(1 / 255)  # [H, W, 3]
    sums = np.ascontiguousarray(rendered.channel("depth")[..., 0])  # [H, W] sum w z
    module: Any = kernels if rendered.request.backend.is_compiled else reference
    loss, tape = module.geometric_loss(sums, rendered.output.alpha, photograph, view.camera, points, weights, view.mask)
    v_sums, v_alpha = module.geometric_loss_vjp(tape)
    return loss, Cotangents({"depth": v_sums[..., None]}, v_alpha)


def sfm_depth(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the Huber loss of the depth at the sparse points of the view.

    Raises
    ------
    InputError
        The scene does not record which view sees which point.
    """
    if rendered.view.point_ids is None:
        raise InputError(
            f"scene {rendered.scene.name} does not say which view sees which point, as COLMAP scenes do: leave"
            " sfm_depth out of the loss"
        )
    return geometric(rendered, GeometricWeights(sfm_depth=1.0))


_WANTS = frozenset({"depth"})
LOSSES = (
    LossTerm("sfm_depth", sfm_depth, weight=0.0, wants=_WANTS),
    LossTerm(
        "depth_smoothness",
        partial(geometric, weights=GeometricWeights(depth_smoothness=1.0)),
        weight=0.0,
        wants=_WANTS,
    ),
    LossTerm(
        "normal_smoothness",
        partial(geometric, weights=GeometricWeights(normal_smoothness=1.0)),
        weight=0.0,
        wants=_WANTS,
    ),
)
