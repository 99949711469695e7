"""The position of a Gaussian at a time, ``mu(t) = mu + t nu``, and its gradient."""

from minisplat_ref.types import Floats


def means_at(means: Floats, velocities: Floats, time: float) -> Floats:
    """Return the centres at a time: ``mu(t) = mu + t nu``.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        Centres mu at time 0, world frame.
    velocities : ndarray of shape (N, 3)
        nu, world units per unit of time.
    time : float
        t.

    Returns
    -------
    ndarray of shape (N, 3)
        In the dtype of the means.
    """
    return means + means.dtype.type(time) * velocities


def means_at_vjp(time: float, v_means_at: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`means_at` with respect to means and velocities.

    ::

        v_mu = v_mu(t),   v_nu = t v_mu(t)

    Parameters
    ----------
    time : float
        t.
    v_means_at : ndarray of shape (N, 3)
        Derivative with respect to the centres at that time.

    Returns
    -------
    v_means, v_velocities : ndarray of shape (N, 3)
    """
    return v_means_at, v_means_at.dtype.type(time) * v_means_at
