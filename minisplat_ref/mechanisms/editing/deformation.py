"""Gaussians under a deformation gradient: Sigma' = F Sigma F^T, refactored, and colours that rotate along.

Near its centre a deformation is the affine map x -> mu' + F (x - mu), which takes a Gaussian to a Gaussian, exactly:

    Sigma' = F Sigma F^T = M' M'^T,   M' = F R diag(s)
    M' = U diag(s') V^T   =>   R' = U, s' the new scales            (singular values; V does not matter)
    s'_2 = |det F| s_0 s_1 s_2 / (s'_0 s'_1)

The factorisation is of M', not of Sigma', since the condition number of Sigma' is the square of that of M': the
thickness of a disc a thousand times as wide as thick would lose six digits more. The smallest scale comes from the
volume, and so loses none. Where F is a rotation times a number c, the axes remain the same, R' = Q R and s' = c s.

Colours have no shape to be sheared. They are rotated by the orthogonal factor Q of the polar decomposition
F = Q P, P = (F^T F)^(1/2), which is the rotation nearest to F. For rigid motions this is exact; for others it is a
choice, since a model has no record of the light that made its colours. Opacities stay.

All this is computed in float64 and rounded to the dtype of the Gaussians. Rows with the identity as F keep their bytes.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.mechanisms.editing.sh_rotation import rotate_sh
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Floats, Gaussians, Ints

SIMILARITY = 1e-14  # rounding: by this much F^T F / c^2 may differ from the identity if F counts as a rotation times c
LOG_RATIO_MIN = -30.0  # of a scale to the largest; thinner ones, below 1e-13 of the length, count as that thin


class Deformation(NamedTuple):
    """Linear maps, and the index of the one that applies to each Gaussian."""

    F: Floats
    """[M, 3, 3] invertible, float64: world after from world before."""
    rows: Ints
    """[N] which F is that of Gaussian n."""


def polar_rotations(F: Floats) -> Floats:
    """Return the orthogonal factors Q of the polar decompositions ``F = Q P``.

    ::

        F = U diag(s) V^T   =>   Q = U V^T

    Parameters
    ----------
    F : ndarray of shape (M, 3, 3)
        Invertible matrices.

    Returns
    -------
    ndarray of shape (M, 3, 3)
        Orthogonal matrices, whose determinant has the sign of det F: rotations, or rotated reflections.
    """
    U, _, Vt = np.linalg.svd(F)
    return U @ Vt


def deform(gaussians: Gaussians, means: Floats, deformation: Deformation) -> Gaussians:
    """Return the Gaussians after a deformation.

    Parameters
    ----------
    gaussians : Gaussians
        N Gaussians before the deformation.
    means : ndarray of shape (N, 3)
        Their centres after it, world frame.
    deformation : Deformation
        The gradient of the deformation at each centre.

    Returns
    -------
    Gaussians
        In the dtype of ``gaussians``.
    """
    F, rows = deformation
    is_moved = ~(F == np.eye(3)).all(axis=(1, 2))[rows]  # [N]
    moved = np.flatnonzero(is_moved)
    quats, log_scales, sh_rest = gaussians.quats.copy(), gaussians.log_scales.copy(), gaussians.sh_rest.copy()
    if len(moved):
        R = rotation_matrices(gaussians.quats[moved].astype(np.float64))  # [N', 3, 3]
        quats[moved], log_scales[moved] = _refactor(F, rows[moved], R, gaussians.log_scales[moved].astype(np.float64))
        sh_rest[moved] = rotate_sh(gaussians.sh_rest[moved], polar_rotations(F), rows[moved])
    return gaussians._replace(
        means=means.astype(gaussians.means.dtype), quats=quats, log_scales=log_scales, sh_rest=sh_rest
    )


def _refactor(F: Floats, rows: Ints, R: Floats, log_scales: Floats) -> tuple[Floats, Floats]:
    """Return the quaternions [N, 4] and logarithms of scales [N, 3] of ``F R diag(s)``.

    The largest scale of each is divided out first, so that no exponential overflows.
    """
    largest = log_scales.max(axis=1, keepdims=True)  # [N, 1]
    ratios = np.maximum(log_scales - largest, LOG_RATIO_MIN)  # [N, 3]
    U, s, _ = np.linalg.svd(F[rows] @ (R * np.exp(ratios)[:, None, :]))
    log_s = np.log(s)  # [N, 3], descending
    log_s[:, 2] = np.log(np.abs(np.linalg.det(F)))[rows] + ratios.sum(axis=1) - log_s[:, 0] - log_s[:, 1]
    new_log_scales = log_s + largest
    squared = np.einsum("mki,mkj->mij", F, F)  # F^T F, [M, 3, 3]
    c2 = np.trace(squared, axis1=1, axis2=2) / 3  # [M]
    is_similar = np.abs(squared - c2[:, None, None] * np.eye(3)).max(axis=(1, 2)) <= SIMILARITY * c2  # [M]
    similar = is_similar[rows]
    U[similar] = (polar_rotations(F)[rows] @ R)[similar]
    new_log_scales[similar] = log_scales[similar] + 0.5 * np.log(c2)[rows[similar], None]
    U[:, :, 2] *= np.sign(np.linalg.det(U))[:, None]  # an axis of the opposite sign is the same axis
    return quaternions(U), new_log_scales


def quaternions(R: Floats) -> Floats:
    """Return the unit quaternions wxyz of rotation matrices.

    The squares of the four entries are on the diagonal of

        4 q q^T = [[1 + tr R, ...], ...]

    whose row with the largest diagonal entry is q but for its length: no small number is ever divided by.

    Parameters
    ----------
    R : ndarray of shape (N, 3, 3)
        Rotations.

    Returns
    -------
    ndarray of shape (N, 4)
    """
    xx, yy, zz = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    wx, wy, wz = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    xy, xz, yz = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    products = np.array(
        [
            [1 + xx + yy + zz, wx, wy, wz],
            [wx, 1 + xx - yy - zz, xy, xz],
            [wy, xy, 1 - xx + yy - zz, yz],
            [wz, xz, yz, 1 - xx - yy + zz],
        ]
    )  # 4 q q^T, [4, 4, N]
    largest = np.argmax(np.einsum("iin->ni", products), axis=1)  # [N]
    q = products[largest, :, np.arange(len(R))]  # [N, 4]
    return q / np.linalg.norm(q, axis=1, keepdims=True)
