"""Stage 2b: the low-pass of a projected covariance, and the opacity factor that undoes its brightening.

The 3DGS code adds ``eps I`` to every projected covariance C, so that no Gaussian is thinner than about a pixel; this is
EWA splatting's prefilter. At unchanged opacity the wider Gaussian would add more light; Mip-Splatting's factor restores
its integral. Left out: Mip-Splatting's 3D smoothing filter.
"""

import numpy as np

from minisplat_ref.constants import COMPENSATION_FLOOR
from minisplat_ref.types import Floats


def compensations(C: Floats, B: Floats) -> Floats:
    """Return the opacity factors that keep a Gaussian's integral when the low-pass widens it.

    With covariances C and ``B = C + eps I``::

        rho = sqrt(max(floor^2, det(C) / det(B)))

    Parameters
    ----------
    C, B : ndarray of shape (N, 2, 2)
        Without and with the low-pass, px^2.

    Returns
    -------
    ndarray of shape (N,)
        rho, at most 1.
    """
    return np.sqrt(np.maximum(COMPENSATION_FLOOR**2, determinants(C) / determinants(B)))


def compensations_vjp(C: Floats, B: Floats, v_compensations: Floats) -> Floats:
    """Gradient of :func:`compensations` with respect to C; both of its arguments move with C.

    With ``r = det(C) / det(B)`` and ``d det(C) = <adj(C), dC>``::

        v_r = v_rho / (2 rho)          where r is above the floor, else 0
        v_C = v_r (adj(C) - r adj(B)) / det(B)

    Parameters
    ----------
    C, B : ndarray of shape (N, 2, 2)
        As for the forward function.
    v_compensations : ndarray of shape (N,)
        Derivative with respect to rho.

    Returns
    -------
    ndarray of shape (N, 2, 2)
        Derivative with respect to the four entries of C; symmetric.
    """
    ratios = determinants(C) / determinants(B)
    v_ratios = np.where(ratios > COMPENSATION_FLOOR**2, v_compensations / (2 * compensations(C, B)), 0)
    v_dets = v_ratios / determinants(B)
    return v_dets[:, None, None] * (adjugates(C) - ratios[:, None, None] * adjugates(B))


def determinants(matrices: Floats) -> Floats:
    """Return the determinants [N] of matrices [N, 2, 2]."""
    return matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]


def adjugates(matrices: Floats) -> Floats:
    """Return [[d, -b], [-c, a]] for ``matrices`` [[a, b], [c, d]]: ``adj(C) C = det(C) I``, even without an inverse."""
    signs = np.array([[1, -1], [-1, 1]], dtype=matrices.dtype)
    return signs * matrices[:, ::-1, ::-1].swapaxes(1, 2)
