"""The part of the images' error that each Gaussian is responsible for: the sum of error times blend weight.

A Gaussian that covers much of the error is a better candidate for a split than one that moves a lot, which the gradient
of its centre measures: that gradient also vanishes where the pulls of the pixels on either side cancel. With the error
e of a pixel, the mean of the channels' absolute residuals, and the weight w of a hit::

    E_i = sum over pixels of w_i e

A rendering is ``sum w c`` and a colour linear in its coefficient of degree 0, so this is the gradient with respect to
``sh_dc`` for the cotangent e in all channels, and needs no further kernel. Left out are channels of a Gaussian that
are clamped to black.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.rendering import RenderSettings, as_model
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.types import Floats, View


def collect_error_weights(model: Any, views: Sequence[View], settings: RenderSettings) -> Floats:
    """Return E [N], float64, summed over the views.

    Parameters
    ----------
    model : Model or Gaussians
    views : sequence of View
        Training views, with their photographs; masked pixels have no error.
    settings : RenderSettings
    """
    model = as_model(model)
    weights = np.zeros(n_rows(model.gaussians))
    for view in views:
        photographed = view.load()
        output, tape = settings.render_view(model, photographed)
        errors = np.abs(output.image - photographed.image / output.image.dtype.type(255)).mean(axis=2)  # [H, W]
        if photographed.mask is not None:
            errors[~photographed.mask] = 0
        v_image = np.repeat(errors[:, :, None], 3, axis=2)
        weights += settings.renderer.render_vjp(tape, v_image, None).gaussians.sh_dc.mean(axis=1) / SH_C0
    return weights
