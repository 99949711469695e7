"""The light that a surfel receives from the scene around it, by the direction of reflection.

A camera with the pose R, t sees the surfel at ``x = R mu + t`` along ``d = x / |x|``. Its normal n, in the camera's
frame, reflects that to ``r = d - 2 (d.n) n``, and in the world the light from there is::

    max(0, sum_k c_k Y_k(R^T r))

with coefficients that are 0 at the start. There the maximum has the gradient of the sum, as in the released code;
otherwise no light would ever come from around.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.reference.spherical_harmonics import sh_basis, sh_basis_jacobian
from minisplat_ref.types import Floats, Ints


class Sight(NamedTuple):
    """The view of a camera on M surfels."""

    x: Floats
    """[M, 3] centres, camera frame."""
    d: Floats
    """[M, 3] unit, towards them, camera frame."""
    normals: Floats
    """[M, 3] unit, camera frame, towards the camera."""
    R: Floats
    """[3, 3] cam_from_world."""


class Coefficients(NamedTuple):
    """The coefficients of a population's N surfels, of which M are seen."""

    dc: Floats
    """[N, 3] c_0."""
    rest: Floats
    """[N, 3 (K - 1)] the others, the three channels of each side by side."""
    rows: Ints
    """[M] those that are seen."""

    @property
    def degree(self) -> int:
        """Of the harmonics."""
        return math.isqrt(1 + self.rest.shape[1] // 3) - 1

    def join(self) -> Floats:
        """Return c_k of the surfels that are seen, [M, K, 3]."""
        rest = self.rest[self.rows].reshape(len(self.rows), self.rest.shape[1] // 3, 3)
        return np.concatenate([self.dc[self.rows, None], rest], axis=1)


class AroundGradient(NamedTuple):
    """Gradient of the loss with respect to the inputs of :func:`light_around`."""

    dc: Floats  # [N, 3]
    rest: Floats  # [N, 3 (K - 1)]
    x: Floats  # [M, 3]
    normals: Floats  # [M, 3]
    R: Floats  # [3, 3]


def sight_of(means: Floats, normals: Floats, pose: tuple[Floats, Floats]) -> Sight:
    """Return the view of a camera of the pose (R, t) on surfels at ``means`` [M, 3], world frame."""
    R, t = pose
    x = means @ R.T + t
    return Sight(x, x / np.linalg.norm(x, axis=1, keepdims=True), normals, R)


def light_around(sight: Sight, coefficients: Coefficients) -> Floats:
    """Return the light [M, 3] that surfels receive from around, linear RGB."""
    basis = sh_basis(_reflected(sight) @ sight.R, coefficients.degree)
    return np.maximum(0, np.einsum("mk,mkc->mc", basis, coefficients.join()))


def light_around_vjp(sight: Sight, coefficients: Coefficients, v_light: Floats) -> AroundGradient:
    """Gradient of :func:`light_around`; that with respect to the coefficients of surfels that are not seen is 0.

    ::

        v_c_k = Y_k v,   v_w = sum_k (c_k . v) dY_k/dw      w = R^T r; v is 0 where the sum is negative, else v_light
        v_r   = R v_w,   v_R = sum r v_w^T
        v_n   = -2 ((d.n) v_r + (n.v_r) d),   v_d = v_r - 2 (n.v_r) n,   v_x = (v_d - d (d.v_d)) / |x|
    """
    r, (x, d, n, R), c = _reflected(sight), sight, coefficients.join()
    w = r @ R
    basis = sh_basis(w, coefficients.degree)
    v = np.where(np.einsum("mk,mkc->mc", basis, c) >= 0, v_light, 0)
    v_w = np.einsum("mk,mki->mi", np.einsum("mkc,mc->mk", c, v), sh_basis_jacobian(w, coefficients.degree))
    v_r = v_w @ R.T
    d_n, n_v = np.sum(d * n, axis=1, keepdims=True), np.sum(n * v_r, axis=1, keepdims=True)
    v_c, v_dc, v_rest = (
        basis[:, :, None] * v[:, None, :],
        np.zeros_like(coefficients.dc),
        np.zeros_like(coefficients.rest),
    )
    rows = coefficients.rows
    v_dc[rows], v_rest[rows] = v_c[:, 0], v_c[:, 1:].reshape(len(rows), v_rest.shape[1])
    return AroundGradient(v_dc, v_rest, towards_vjp(x, d, v_r - 2 * n_v * n), -2 * (d_n * v_r + n_v * d), r.T @ v_w)


def towards_vjp(x: Floats, d: Floats, v_d: Floats) -> Floats:
    """Gradient of ``d = x / |x|``: ``v_x = (v_d - d (d.v_d)) / |x|``."""
    return (v_d - d * np.sum(d * v_d, axis=1, keepdims=True)) / np.linalg.norm(x, axis=1, keepdims=True)


def _reflected(sight: Sight) -> Floats:
    return sight.d - 2 * np.sum(sight.d * sight.normals, axis=1, keepdims=True) * sight.normals
