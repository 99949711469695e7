"""Stage 3: a Gaussian's colour as seen from the camera.

In 3DGS section 3 each channel is a sum of real spherical harmonics of the viewing direction, up to degree 3. Left out:
the conversion from sRGB (3DGS blends sRGB values as they are).
"""

import numpy as np

from minisplat_ref.constants import SH_C0, SH_C1, SH_C2, SH_C3
from minisplat_ref.reference.pinhole import pose
from minisplat_ref.types import Camera, Floats, Ints, SHGradient


def sh_basis(directions: Floats, degree: int) -> Floats:
    """Return real spherical harmonics as polynomials of unit directions.

    Parameters
    ----------
    directions : ndarray of shape (N, 3)
        Unit vectors, world frame.
    degree : int
        0 to 3.

    Returns
    -------
    ndarray of shape (N, (degree + 1)^2)
        Degree by degree, order -l to l: Y_00, Y_1-1, Y_10, Y_11, Y_2-2, ...
    """
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    columns = [np.full_like(x, SH_C0)]
    if degree >= 1:
        columns += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        columns += [
            SH_C2[0] * x * y,
            -SH_C2[0] * y * z,
            SH_C2[1] * (2 * zz - xx - yy),
            -SH_C2[0] * x * z,
            SH_C2[2] * (xx - yy),
        ]
    if degree >= 3:
        columns += [
            -SH_C3[0] * y * (3 * xx - yy),
            SH_C3[1] * x * y * z,
            -SH_C3[2] * y * (4 * zz - xx - yy),
            SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -SH_C3[2] * x * (4 * zz - xx - yy),
            SH_C3[4] * z * (xx - yy),
            -SH_C3[0] * x * (xx - 3 * yy),
        ]
    return np.column_stack(columns)


def sh_basis_jacobian(directions: Floats, degree: int) -> Floats:
    """Return the derivative [N, (degree + 1)^2, 3] of :func:`sh_basis` with respect to x, y, z of ``directions``."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    o, one = np.zeros_like(x), np.ones_like(x)
    rows = [(o, o, o)]
    if degree >= 1:
        rows += [(o, -SH_C1 * one, o), (o, o, SH_C1 * one), (-SH_C1 * one, o, o)]
    if degree >= 2:
        rows += [
            (SH_C2[0] * y, SH_C2[0] * x, o),
            (o, -SH_C2[0] * z, -SH_C2[0] * y),
            (-2 * SH_C2[1] * x, -2 * SH_C2[1] * y, 4 * SH_C2[1] * z),
            (-SH_C2[0] * z, o, -SH_C2[0] * x),
            (2 * SH_C2[2] * x, -2 * SH_C2[2] * y, o),
        ]
    if degree >= 3:
        rows += [
            (-6 * SH_C3[0] * x * y, -3 * SH_C3[0] * (xx - yy), o),
            (SH_C3[1] * y * z, SH_C3[1] * x * z, SH_C3[1] * x * y),
            (2 * SH_C3[2] * x * y, -SH_C3[2] * (4 * zz - xx - 3 * yy), -8 * SH_C3[2] * y * z),
            (-6 * SH_C3[3] * x * z, -6 * SH_C3[3] * y * z, 3 * SH_C3[3] * (2 * zz - xx - yy)),
            (-SH_C3[2] * (4 * zz - 3 * xx - yy), 2 * SH_C3[2] * x * y, -8 * SH_C3[2] * x * z),
            (2 * SH_C3[4] * x * z, -2 * SH_C3[4] * y * z, SH_C3[4] * (xx - yy)),
            (-3 * SH_C3[0] * (xx - yy), 6 * SH_C3[0] * x * y, o),
        ]
    return np.moveaxis(np.array(rows), 2, 0)  # [K, 3, N] -> [N, K, 3]


def sh_colors(means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints) -> Floats:
    """Return colours as the camera sees them: ``max(0, 0.5 + sum_k c_k Y_k(d))`` with ``d = (mu - o) / |mu - o|``.

    The camera's centre is ``o = -R^T t``.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame.
    sh_dc : ndarray of shape (N, 3)
        Coefficient of degree 0, RGB.
    sh_rest : ndarray of shape (N, K-1, 3)
        Coefficients of degree 1 and above.
    camera : Camera
        The view.
    degree : int, or ndarray of shape (N,) of int
        Active degree, at most the stored one, of all Gaussians or of each; higher coefficients are ignored.
    radii : ndarray of shape (N, 2)
        From the projection; rows with 0 were culled.

    Returns
    -------
    ndarray of shape (N, 3)
        RGB, not clamped above; zeros for culled rows.
    """
    rows = np.flatnonzero(radii[:, 0] > 0)
    d, _ = _directions(means[rows], camera)
    colors = np.zeros_like(sh_dc)
    colors[rows] = np.maximum(0, _unclamped(*_active(d, sh_dc, sh_rest, degree, rows)))
    return colors


def sh_colors_vjp(
    means: Floats, sh_dc: Floats, sh_rest: Floats, camera: Camera, degree: int | Ints, radii: Ints, v_colors: Floats
) -> SHGradient:
    """Gradient of :func:`sh_colors`; culled rows and unused degrees get zeros.

    With ``r = mu - o`` and ``d = r / |r|``::

        v     = v_colors where the unclamped colour is positive, else 0
        v_c_k = Y_k v
        v_Y_k = c_k . v
        v_d   = sum_k v_Y_k dY_k/dd
        v_r   = (v_d - d (d . v_d)) / |r|
        v_mu  = v_r,  v_o = -sum_n v_r
        v_R   = -t v_o^T,  v_t = -R v_o                      (o = -R^T t)

    Parameters
    ----------
    means, sh_dc, sh_rest, camera, degree, radii
        As for :func:`sh_colors`.
    v_colors : ndarray of shape (N, 3)
        Derivative with respect to the colours.

    Returns
    -------
    SHGradient
        Derivatives with respect to means, coefficients and the camera's pose.
    """
    rows = np.flatnonzero(radii[:, 0] > 0)
    d, distances = _directions(means[rows], camera)
    basis, coefficients = _active(d, sh_dc, sh_rest, degree, rows)  # [V, K], [V, K, 3]

    v = np.where(_unclamped(basis, coefficients) > 0, v_colors[rows], 0)
    v_coefficients = basis[:, :, None] * v[:, None, :]
    v_basis = np.einsum("nkc,nc->nk", coefficients, v)
    v_d = np.einsum("nk,nki->ni", v_basis, sh_basis_jacobian(d, int(np.max(degree, initial=0))))
    v_r = (v_d - d * np.sum(d * v_d, axis=1, keepdims=True)) / distances
    v_o = -v_r.sum(axis=0)

    v_means, v_sh_dc, v_sh_rest = np.zeros_like(means), np.zeros_like(sh_dc), np.zeros_like(sh_rest)
    v_means[rows] = v_r
    v_sh_dc[rows] = v_coefficients[:, 0]
    v_sh_rest[rows, : basis.shape[1] - 1] = v_coefficients[:, 1:]
    R, t = pose(camera, means.dtype)
    return SHGradient(v_means, v_sh_dc, v_sh_rest, -np.outer(t, v_o), -R @ v_o)


def _unclamped(basis: Floats, coefficients: Floats) -> Floats:
    """Return ``0.5 + sum_k c_k Y_k`` [N, 3]; the half makes zero coefficients mid-grey."""
    return 0.5 + np.einsum("nk,nkc->nc", basis, coefficients)


def _active(d: Floats, sh_dc: Floats, sh_rest: Floats, degree: int | Ints, rows: Ints) -> tuple[Floats, Floats]:
    """Return the basis functions [V, K] and coefficients [V, K, 3] of rows; zeros above a row's own degree."""
    highest = int(np.max(degree, initial=0))
    coefficients = np.concatenate([sh_dc[:, None], sh_rest[:, : (highest + 1) ** 2 - 1]], axis=1)[rows]  # [V, K, 3]
    own = np.broadcast_to(degree, len(sh_dc))[rows].astype(int)  # [V]
    is_active = np.arange((highest + 1) ** 2) < ((own + 1) ** 2)[:, None]  # [V, K]
    return np.where(is_active, sh_basis(d, highest), 0), np.where(is_active[:, :, None], coefficients, 0)


def _directions(means: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Return unit directions [N, 3] from the camera's centre to the means, and the distances [N, 1]."""
    R, t = pose(camera, means.dtype)
    r = means + t @ R  # mu - o = mu + R^T t
    distances = np.linalg.norm(r, axis=1, keepdims=True)
    return r / distances, distances
