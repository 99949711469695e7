"""The two losses of 2D Gaussian Splatting, equations (13) and (14): depth distortion and normal consistency.

With the hits of a pixel of weights w_i, the mapped depths m_i, the normals n_i and the surface normal N from the
neighbouring pixels' depths::

    L_d = mean over pixels of sum_{i<j} w_i w_j (m_i - m_j)^2,   m = far / (far - near) (1 - near / z)
    L_n = mean over pixels of sum_i w_i (1 - <n_i, N>) = mean of A - <sum_i w_i n_i, N>

The paper writes |m_i - m_j|; its code has the square. For L_n the code has ``1 - <sum_i w_i n_i, A N>`` with A
held constant, which no finite difference can check; this is the paper's. With S_1 = sum w q and S_2 = sum w q^2, the
renderer's channel ``spread``, the sum in L_d is ``b^2 (A S_2 - S_1^2)``, ``b = far near / (far - near)``, because m is
``const - b q``.
"""

import numpy as np

from minisplat_ref.mechanisms.surfels.disagreement import disagree, normal_consistency
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered

NEAR, FAR = 0.2, 100.0  # world units: between which depths are mapped to [0, 1], as released


def distortion(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return L_d and its derivatives: ``v_A = S_2``, ``v_S_1 = -2 S_1``, ``v_S_2 = A``, times b^2 / pixels."""
    spread, A = rendered.channel("spread"), rendered.output.alpha
    S_1, S_2 = spread[..., 0], spread[..., 1]
    scale = A.dtype.type((FAR * NEAR / (FAR - NEAR)) ** 2 / A.size)
    value = float(scale * np.sum(A * S_2 - S_1 * S_1, dtype=np.float64))
    return value, Cotangents({"spread": scale * np.stack([-2 * S_1, A], axis=2)}, scale * S_2)


def median_normal_consistency(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return L_n with the surface through the median depths, which the paper prefers for bounded scenes."""
    found = disagree(rendered, rendered.channel("median")[..., 0])
    return found.value, Cotangents({"normal": found.v_normal, "median": found.v_depth[..., None]}, found.v_alpha)


# Weights and dates of the released code: of 30,000 iterations. The distortion's weight is 0 there by default, 10 to 100
# for most scenes and 1,000 for DTU, whose unit is a millimetre.
NORMAL_CONSISTENCY = LossTerm(
    "normal_consistency", normal_consistency, 0.05, frozenset({"normal", "depth"}), start=7_000
)
DISTORTION = LossTerm("distortion", distortion, 0.0, frozenset({"spread"}), start=3_000)
LOSSES = (
    NORMAL_CONSISTENCY,
    LossTerm("median_normal_consistency", median_normal_consistency, 0.0, frozenset({"normal", "median"}), start=7_000),
    DISTORTION,
)
