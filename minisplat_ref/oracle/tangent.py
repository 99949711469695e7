"""Gradients of a view on the tangent of SE(3): what two renderers must agree on, however they spell the camera.

A view is a rotation R and a translation t. Off the rotations two right programs may differ: the camera's centre is
``-R^T t`` in one and ``-R^-1 t`` in the other, and the derivatives with respect to the nine entries of R differ as
well. Along the six directions in which a view can move they cannot::

    R' = R (I + [w]x),  t' = t + s:   dL/dw = vee(R^T v_R),  dL/ds = v_t,   vee(M) = (M_21 - M_12, ...)

so the part of ``R^T v_R`` that is symmetric is not compared.
"""

import numpy as np

from minisplat_ref.types import Floats


def turning(v_R: Floats, R: Floats) -> Floats:
    """Return the derivative with respect to a turn of the camera about the axes of the world.

    Parameters
    ----------
    v_R : ndarray of shape (..., 3, 3)
        Derivative with respect to the entries of R.
    R : ndarray of shape (..., 3, 3)
        ``cam_from_world_R``.

    Returns
    -------
    ndarray of shape (..., 3)
        In float64.
    """
    M = np.swapaxes(np.asarray(R, np.float64), -1, -2) @ np.asarray(v_R, np.float64)
    return np.stack([M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]], axis=-1)


def on_tangent(v_view: Floats, view: Floats) -> Floats:
    """Return the six derivatives of a view: three of :func:`turning`, three of the translation.

    Parameters
    ----------
    v_view : ndarray of shape (..., 3 or 4, 4)
        Derivative with respect to the entries of the view matrix; a fourth row is not read.
    view : ndarray of shape (..., 3 or 4, 4)
        The view matrix.

    Returns
    -------
    ndarray of shape (..., 6)
        In float64.
    """
    turns = turning(v_view[..., :3, :3], view[..., :3, :3])
    return np.concatenate([turns, np.asarray(v_view[..., :3, 3], np.float64)], axis=-1)
