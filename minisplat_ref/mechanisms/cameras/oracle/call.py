"""``rasterization`` with ``camera_model``, ``with_ut`` and ``with_eval3d`` as a call that is compared.

gsplat's own function is given its own keywords, so it can be compared where its kernels run. Culling is compared by
which Gaussians have radii, not by the radii's size, which does not change the image.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from minisplat_ref.mechanisms.cameras.gsplat_call import GRADIENTS, STEPS, rasterization, rasterization_vjp
from minisplat_ref.mechanisms.cameras.oracle.planted import PLANTED, PROFILES
from minisplat_ref.mechanisms.cameras.oracle.scenes import LEAVES, scenes
from minisplat_ref.oracle.call_comparison import Arrays, Call, StageArray
from minisplat_ref.oracle.tolerances import EXACT, GRADIENT, IMAGE, POSITION, UNSCENTED
from minisplat_ref.types import Floats

NAMES = ("render_colors", "render_alphas")
_SHAPE = "in the shape of the argument"
STAGES: Mapping[str, StageArray] = {
    "means2d": StageArray(
        "projection",
        UNSCENTED,
        "[1, N, 2] px: means of the unscented transform, 0 where a sigma point is not seen; of ortho A mu + b",
        is_of_rows=True,
    ),
    "depths": StageArray("projection", POSITION, "[1, N] camera z; of a fisheye the distance", is_of_rows=True),
    "radii": StageArray("culling", EXACT, "[1, N, 2] half-extents, px; compared is which are above 0", lambda r: r > 0),
    "render_alphas": StageArray("alpha", IMAGE, "[1, H, W, 1]"),
    "render_colors": StageArray("colours", IMAGE, "[1, H, W, 3]"),
    **{name: StageArray("gradients", GRADIENT, _SHAPE) for name in GRADIENTS if name != "v_viewmats"},
    "v_viewmats": StageArray("gradients", GRADIENT, _SHAPE, lambda v: v[:, :3]),  # the last row is no variable
}
"""The arrays in the order in which they are compared."""


def _ours(arguments: Mapping[str, Any], cotangents: Mapping[str, Any], options: Mapping[str, Any]) -> Arrays:
    *images, meta = rasterization(**arguments, **options)
    gradients = rasterization_vjp(**arguments, **cotangents, **options)
    named: dict[str, np.ndarray] = dict(zip(NAMES, images, strict=True))
    return {**{name: np.asarray(meta[name]) for name in STAGES if name in meta}, **named, **gradients}


def _differentiate(vjp: Any, arguments: Mapping[str, Any], cotangents: Mapping[str, Any]) -> Mapping[str, Floats]:
    found: Mapping[str, Floats] = vjp(**arguments, **cotangents)
    return found


CALL = Call(
    name="rasterization_cameras",
    subject="other cameras",
    images=NAMES,
    stages=STAGES,
    leaves=LEAVES,
    scenes=scenes,
    ours=_ours,
    differentiate=_differentiate,
    planted=PLANTED,
    steps=STEPS,
    profiles=PROFILES,
)
