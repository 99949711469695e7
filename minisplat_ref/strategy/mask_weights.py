"""Weight that Gaussians have where photographs count, and where their masks leave pixels out.

What a mask leaves out has no loss, so nothing stops a Gaussian from growing there: photographs of an object on its own
get streaks in the colours of its edge, which the masks hide in each photograph and any other camera sees. A Gaussian of
the object, or of a street behind people who are masked, has most of its weight where pixels count, whatever some of
the masks hide. With w the blend weights of a Gaussian's hits and M the pixels that count::

    inside_i = sum over pixels in M of w_i        all_i = sum over all pixels of w_i

A rendering is ``sum w c``, so both are gradients of a channel with respect to ``sh_dc``, as in
:mod:`minisplat_ref.strategy.error_weights`; all colours are gray, so that none is clamped.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.rendering import RenderSettings, as_model
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.types import Floats, View


def collect_mask_weights(model: Any, views: Sequence[View], settings: RenderSettings) -> tuple[Floats, Floats]:
    """Return the weight where pixels count, and everywhere, summed over the views: [N] each, float64.

    An exposure of a photograph multiplies both by its gain.

    Parameters
    ----------
    model : Model or Gaussians
    views : sequence of View
        Training views; of one without a mask, all pixels count.
    settings : RenderSettings
    """
    model = as_model(model)
    gaussians = model.gaussians
    gray = model._replace(gaussians=gaussians._replace(sh_dc=np.zeros_like(gaussians.sh_dc)))
    inside, all_ = np.zeros(n_rows(gaussians)), np.zeros(n_rows(gaussians))
    for view in views:
        shown = view.load()
        output, tape = settings.render_view(gray, shown, sh_degree=0)
        v_image = np.zeros_like(output.image)
        v_image[:, :, 0] = 1
        everywhere = settings.renderer.render_vjp(tape, v_image, None).gaussians.sh_dc[:, 0] / SH_C0
        all_ += everywhere
        if shown.mask is None:
            inside += everywhere
            continue
        v_image[~shown.mask] = 0
        inside += settings.renderer.render_vjp(tape, v_image, None).gaussians.sh_dc[:, 0] / SH_C0
    return inside, all_
