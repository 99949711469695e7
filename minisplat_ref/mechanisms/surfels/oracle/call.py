"""``rasterization_2dgs`` as a call that is compared: its stages, and our answers."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from minisplat_ref.mechanisms.surfels.gsplat_call import (
    GRADIENTS,
    NAMES,
    Steps,
    rasterization_2dgs,
    rasterization_2dgs_vjp,
)
from minisplat_ref.mechanisms.surfels.oracle.planted import PLANTED
from minisplat_ref.mechanisms.surfels.oracle.scenes import LEAVES, scenes
from minisplat_ref.oracle.call_comparison import Arrays, Call, StageArray
from minisplat_ref.oracle.tolerances import (
    EXACT,
    GRADIENT,
    IMAGE,
    POSITION,
    SURFEL_DEPTH,
    SURFEL_DISTORTION,
    SURFEL_NORMAL,
)
from minisplat_ref.types import Floats

# Third scales have no gradient; the last row of a view matrix, and its gradient, is not compared.
PARTS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = defaultdict(
    lambda: np.asarray, v_scales=lambda v: v[:, :2], v_viewmats=lambda v: v[:, :3]
)
STAGES: Mapping[str, StageArray] = {
    "radii": StageArray("projection", EXACT, "[1, N, 2] ceil of 3.33 half-extents of the unit disc, px; 0: culled"),
    "means2d": StageArray("projection", POSITION, "[1, N, 2] middle of that box, px", is_of_rows=True),
    "depths": StageArray("projection", POSITION, "[1, N] camera z of the centre", is_of_rows=True),
    "ray_transforms": StageArray(
        "projection", POSITION, "[1, N, 3, 3] K [s_0 R r_0, s_1 R r_1, R mu + t]", is_of_rows=True
    ),
    "normals": StageArray("projection", POSITION, "[1, N, 3] camera frame, towards the camera", is_of_rows=True),
    "render_alphas": StageArray("alpha", IMAGE, "[1, H, W, 1]"),
    "render_colors": StageArray("colours and expected depth", SURFEL_DEPTH, "[1, H, W, 4]"),
    "render_normals": StageArray("normals", IMAGE, "[1, H, W, 3] sum w n, world frame"),
    "render_median": StageArray("median depth", POSITION, "[1, H, W, 1] of the last hit with T > 1/2"),
    "render_distort": StageArray("distortion", SURFEL_DISTORTION, "[1, H, W, 1] sum_ij w_i w_j |z_i - z_j|"),
    "surf_normals": StageArray("surface normals", SURFEL_NORMAL, "[1, H, W, 3] central differences, world frame"),
    **{name: StageArray("gradients", GRADIENT, "in the shape of the argument", PARTS[name]) for name in GRADIENTS},
}
"""The arrays in the order in which they are compared."""


def _ours(arguments: Mapping[str, Any], cotangents: Mapping[str, Floats], options: Mapping[str, Any]) -> Arrays:
    images = rasterization_2dgs(**arguments, **options)
    named = dict(zip(NAMES, images[:6], strict=True))
    gradients = rasterization_2dgs_vjp(**arguments, cotangents=dict(cotangents), **options)
    meta = {name: images[6][name] for name in STAGES if name in images[6]}
    return {**meta, **named, **gradients}


def _differentiate(vjp: Any, arguments: Mapping[str, Any], cotangents: Mapping[str, Floats]) -> Mapping[str, Floats]:
    found: Mapping[str, Floats] = vjp(**arguments, cotangents=cotangents)
    return found


def _peer() -> Callable[..., Any]:
    """Return gsplat's own torch functions, which are imported now."""
    from minisplat_ref.mechanisms.surfels.oracle import gsplat_torch

    gsplat_torch.load_2dgs()
    return gsplat_torch.rasterization_2dgs


CALL = Call(
    name="rasterization_2dgs",
    subject="surfels",
    images=NAMES,
    stages=STAGES,
    leaves=LEAVES,
    scenes=scenes,
    ours=_ours,
    differentiate=_differentiate,
    planted=PLANTED,
    steps=Steps(),
    peer=_peer,
)
