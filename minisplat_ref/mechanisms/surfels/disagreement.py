"""The deviation of surfels' normals from the surface through a depth map: 2D Gaussian Splatting, equation (14).

With the weights w_i and normals n_i of a pixel's hits, the opacity A, and the normal N of the surface through the
neighbouring pixels' depths::

    L = mean over pixels of sum_i w_i (1 - <n_i, N>) = mean of A - <sum_i w_i n_i, N>

The loss chooses the depths: expected, median or filtered.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.mechanisms.depth_maps import normal_kernels, normals
from minisplat_ref.reference.depth import expected_depth, expected_depth_vjp
from minisplat_ref.training.losses import Cotangents, Rendered
from minisplat_ref.types import Floats


class Disagreement(NamedTuple):
    """L, and its derivatives as far as they do not depend on the choice of the depths."""

    value: float
    v_normal: Floats
    """[H, W, 3] with respect to the channel ``normal``: -N / pixels."""
    v_depth: Floats
    """[H, W] with respect to the depths, through N."""
    v_alpha: Floats
    """[H, W] with respect to A alone: 1 / pixels."""


def disagree(rendered: Rendered, depth: Floats) -> Disagreement:
    """Return L of a rendered view and depths [H, W], camera z.

    There is no N beside a pixel without hits, which has no depth.
    """
    A, camera = rendered.output.alpha, rendered.view.camera
    is_hit, has_normal = A > rendered.request.conventions.alpha_min / 2, np.zeros(A.shape, bool)
    has_normal[1:-1, 1:-1] = is_hit[2:, 1:-1] & is_hit[:-2, 1:-1] & is_hit[1:-1, 2:] & is_hit[1:-1, :-2]
    n = np.where(has_normal[..., None], rendered.channel("normal"), 0)
    surface: Any = normal_kernels if rendered.request.backend.is_compiled else normals
    N, share = surface.central_normals(depth, camera), A.dtype.type(1 / A.size)
    value = float(share * np.sum(A - np.sum(n * N, axis=2), dtype=np.float64))
    v_normal = -share * np.where(has_normal[..., None], N, 0)
    v_depth = surface.central_normals_vjp(depth, camera, -share * n)
    return Disagreement(value, v_normal, v_depth, np.full_like(A, share))


def normal_consistency(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return L with the surface through the expected depths.

    ``v_A = 1 / pixels``, ``v_n = -N / pixels``, and ``v_N = -n / pixels`` on through the normals to the depths.
    """
    sums, alpha = rendered.channel("depth")[..., 0], rendered.output.alpha
    found = disagree(rendered, expected_depth(sums, alpha))
    v_sums, v_alpha = expected_depth_vjp(sums, alpha, found.v_depth)
    return found.value, Cotangents({"normal": found.v_normal, "depth": v_sums[..., None]}, v_alpha + found.v_alpha)
