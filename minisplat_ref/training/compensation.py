"""Compensated opacities, for photographs of the same scene at different resolutions.

A rasteriser adds a low-pass of 0.3 px^2 to every footprint, so that none falls between two pixels. A Gaussian that is
thin in a photograph is then rendered larger, and therefore too strongly: the more so, the fewer pixels it covers. The
compensation of gsplat and Mip-Splatting (Yu et al. 2024, its 2D filter) multiplies the opacity by the ratio of the
footprint's areas without and with the low-pass::

    o' = o sqrt(det S / det(S + 0.3 I))        S: covariance of the footprint, px^2

so that a photograph of half the size shows the same scene at half the size. The core's conventions have it
(``is_antialiased``). Here it is a property of the model: what was trained with it must be rendered with it. The shared
parameter ``compensation`` [1] marks such a model; it is not trained, and its value does not matter. A PLY file has
no place for it: other viewers render thin Gaussians a little too strongly, unless they have such an option.
"""

from typing import Any

import numpy as np

from minisplat_ref.rendering import Renderer, Request
from minisplat_ref.types import Floats, Model, RenderOutput, View

COMPENSATION = "compensation"  # name of the shared parameter


def compensation(n_views: int) -> dict[str, Floats]:
    """Return the parameter that marks opacities as compensated; ``n_views`` does not matter."""
    return {COMPENSATION: np.ones(1, np.float32)}


def with_compensation(inner: Renderer) -> Renderer:
    """Return a renderer that compensates opacities if the model has the parameter."""

    def render_compensated(model: Model, view: View, request: Request) -> tuple[RenderOutput, Any]:
        return inner.render(model, view, compensate(request) if COMPENSATION in model.shared else request)

    return Renderer(f"{inner.name} with compensation", render_compensated, inner.render_vjp, inner.channels)


def compensate(request: Request) -> Request:
    """Return the request with compensated opacities."""
    return request._replace(conventions=request.conventions._replace(is_antialiased=True))
