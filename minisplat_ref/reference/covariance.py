"""Stage 1: a Gaussian's covariance from its quaternion and scales.

This is 3DGS equation (6), ``Sigma = R S S^T R^T``. The factors keep Sigma positive semi-definite whatever an optimiser
does to them. Left out: activations (``scales`` are standard deviations, not logarithms).
"""

import numpy as np

from minisplat_ref.types import Floats, Ints

LEVI_CIVITA = np.zeros((3, 3, 3), dtype=np.int8)  # e_ijk = +1 for even, -1 for odd permutations of (0, 1, 2)
LEVI_CIVITA[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1
LEVI_CIVITA[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = -1


def rotation_matrices(quats: Floats) -> Floats:
    """Return the rotation matrices of quaternions.

    With the unit quaternion ``(w, v) = q / |q|`` and the matrix ``K`` of the cross product, ``K x = v x x``::

        R = I + 2 w K + 2 K K

    Parameters
    ----------
    quats : ndarray of shape (N, 4)
        Quaternions wxyz of any length. A zero quaternion gives the identity and no gradient.

    Returns
    -------
    ndarray of shape (N, 3, 3)
        world_from_gaussian.
    """
    u, *_ = _normalize(quats)
    w, K = _cross_product_matrices(u)
    return np.eye(3, dtype=quats.dtype) + 2 * w * K + 2 * K @ K


def rotation_matrices_vjp(quats: Floats, v_rotations: Floats) -> Floats:
    """Gradient of :func:`rotation_matrices`.

    With ``V = v_R``, ``<A, B> = sum_ij A_ij B_ij``, ``u = q / |q|`` and ``K_ij = -e_ijk v_k``::

        v_w = 2 <K, V>
        v_K = 2 w V + 2 (V K^T + K^T V)
        v_v = -e_ijk (v_K)_ij
        v_q = (v_u - u (u . v_u)) / |q|

    Parameters
    ----------
    quats : ndarray of shape (N, 4)
        As for the forward function.
    v_rotations : ndarray of shape (N, 3, 3)
        Derivative with respect to the nine entries.

    Returns
    -------
    ndarray of shape (N, 4)
        Derivative with respect to ``quats``; orthogonal to each, because their length does not matter.
    """
    u, length, exponent = _normalize(quats)
    w, K = _cross_product_matrices(u)
    K_transposed = np.swapaxes(K, 1, 2)
    v_w = 2 * np.einsum("nij,nij->n", K, v_rotations)
    v_K = 2 * w * v_rotations + 2 * (v_rotations @ K_transposed + K_transposed @ v_rotations)
    v_v = -np.einsum("ijk,nij->nk", LEVI_CIVITA.astype(quats.dtype), v_K)
    v_u = np.column_stack([v_w, v_v])  # [N, 4]
    return np.ldexp((v_u - u * np.sum(u * v_u, axis=1, keepdims=True)) / length, -exponent)


def covariances(quats: Floats, scales: Floats) -> Floats:
    """Return the covariances ``Sigma = M M^T`` with ``M = R diag(s)``: 3DGS equation (6).

    Parameters
    ----------
    quats : ndarray of shape (N, 4)
        Quaternions wxyz of any length.
    scales : ndarray of shape (N, 3)
        Standard deviations along the Gaussian's axes, world units.

    Returns
    -------
    ndarray of shape (N, 3, 3)
        Symmetric, world frame, world units squared.
    """
    M = rotation_matrices(quats) * scales[:, None, :]
    return M @ np.swapaxes(M, 1, 2)


def covariances_vjp(quats: Floats, scales: Floats, v_covariances: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`covariances`.

    ::

        v_M = (v_Sigma + v_Sigma^T) M
        v_R = v_M diag(s)
        v_s_k = sum_i R_ik (v_M)_ik

    Parameters
    ----------
    quats : ndarray of shape (N, 4)
        As for the forward function.
    scales : ndarray of shape (N, 3)
        As for the forward function.
    v_covariances : ndarray of shape (N, 3, 3)
        Derivative with respect to the nine entries; need not be symmetric.

    Returns
    -------
    v_quats : ndarray of shape (N, 4)
        Derivative with respect to ``quats``.
    v_scales : ndarray of shape (N, 3)
        Derivative with respect to ``scales``.
    """
    R = rotation_matrices(quats)
    M = R * scales[:, None, :]
    v_M = (v_covariances + np.swapaxes(v_covariances, 1, 2)) @ M
    v_R = v_M * scales[:, None, :]
    v_scales = np.einsum("nik,nik->nk", R, v_M)
    return rotation_matrices_vjp(quats, v_R), v_scales


def _normalize(quats: Floats) -> tuple[Floats, Floats, Ints]:
    """Return ``u = q / |q|`` [N, 4], and l and k [N, 1] with ``|q| = l 2^k``; for the zero quaternion 0, 1 and 0.

    Squares of entries above 1e19 or below 1e-23 leave the range of float32. Therefore q is first divided by a power of
    two, which is exact and brings its largest entry between 1/2 and 1.
    """
    _, exponent = np.frexp(np.abs(quats).max(axis=1, keepdims=True))
    scaled = np.ldexp(quats, -exponent)
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    length = np.where(length == 0, np.ones_like(length), length)
    return scaled / length, length, exponent


def _cross_product_matrices(unit_quats: Floats) -> tuple[Floats, Floats]:
    """Return w [N, 1, 1] and K [N, 3, 3] with ``K x = v x x``."""
    K = -np.einsum("ijk,nk->nij", LEVI_CIVITA.astype(unit_quats.dtype), unit_quats[:, 1:])
    return unit_quats[:, :1, None], K
