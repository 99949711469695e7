"""Fans: flat Gaussians as regular polygons around their centres, and Gaussians again from polygons that were edited.

REdiSplats, Byrski et al. 2025, arXiv 2503.12284, section 3. A flat Gaussian lies in the plane of its two larger axes
e_a and e_b, with the standard deviations s_a and s_b. Its *spans* are the columns of ``S = [s_a e_a, s_b e_b]``, and
its polygon of n sides has the corners

    x_j = mu + r S (cos phi_j, sin phi_j)^T,   phi_j = 2 pi j / n

which make n triangles (mu, x_j, x_j+1) with the centre: a fan. The radius depends on the opacity o, so that alpha at
every corner is the same, ``exp(-q / 2)`` = 1/291, and a fainter Gaussian has a smaller polygon:

    r^2 = max(0, q + 2 ln o),   q = 11.3449

Back: the corners of an edited polygon give spans again, and these an ellipse. Two ways:

- :func:`fit_flat_gaussians`, the least squares over all corners, ``S = 2 / (n r) sum_j (x_j - mu) (cos phi_j, sin
  phi_j)`` with ``mu`` the mean of the corners. It is exact for every affine edit: spans that it leaves at an oblique
  angle, as a shear does, are rotated by the angle ``tan 2 theta = 2 S_a . S_b / (S_a . S_a - S_b . S_b)`` to the axes
  of the same ellipse.
- :func:`by_gram_schmidt`, the paper's: the first corner gives the first span, the corner a quarter further on the
  second, less its component along the first. It is exact where the spans stay perpendicular, and loses any shear.

Everything is float64. Left out: rendering between the corners; files.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Floats, Gaussians, Ints

N_SIDES = 8
REACH = 11.3449  # q: 99 % of a normal distribution in three dimensions lies within sqrt(q) standard deviations
ROUNDINGS = 32  # of the largest coordinate, which spans may be off a right angle by and still count as perpendicular


class Flat(NamedTuple):
    """The geometry of flat Gaussians."""

    means: Floats
    """[N, 3] world frame."""
    axes: Floats
    """[N, 3, 3] rotations: the columns are e_a, e_b and the normal ``e_a x e_b``."""
    scales: Floats
    """[N, 2] standard deviations s_a, s_b, world units."""

    @property
    def spans(self) -> Floats:
        """[N, 3, 2] the columns ``s_a e_a`` and ``s_b e_b``."""
        return self.axes[:, :, :2] * self.scales[:, None, :]


def plane_axes(log_scales: Floats) -> Ints:
    """Return which columns of R are e_a, e_b and the normal of flat Gaussians.

    The normal is the axis of the least scale, of equal ones the first; e_a and e_b follow it in turn, so that they and
    the normal are right-handed.

    Parameters
    ----------
    log_scales : ndarray of shape (N, 3)
        Logarithms of the standard deviations.

    Returns
    -------
    ndarray of shape (N, 3)
        A cyclic permutation of 0, 1, 2.
    """
    normal = np.argmin(log_scales, axis=1)
    return (normal[:, None] + np.array([1, 2, 3])) % 3


def turn_balls(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return the Gaussians with a random rotation for each ball.

    Training starts from balls, whose axes are arbitrary. All would become flat along the first of them, face the same
    way, and be invisible to a camera in their planes.

    Parameters
    ----------
    gaussians : Gaussians
        Of any shape; those that are no balls stay as they are.
    rng : Generator
        For the rotations.
    """
    quats = gaussians.quats.copy()
    is_ball = np.ptp(gaussians.log_scales, axis=1) == 0
    quats[is_ball] = rng.normal(size=(np.count_nonzero(is_ball), 4))
    return gaussians._replace(quats=quats)


def flatten(means: Floats, quats: Floats, log_scales: Floats) -> Flat:
    """Return the flat Gaussians in the planes of the two larger axes.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame.
    quats : ndarray of shape (N, 4)
        Of any length.
    log_scales : ndarray of shape (N, 3)
        Logarithms of the standard deviations; the least of each does not matter.
    """
    columns = plane_axes(log_scales)
    R = rotation_matrices(quats.astype(np.float64))
    with np.errstate(over="ignore"):
        scales = np.exp(np.take_along_axis(log_scales, columns[:, :2], axis=1).astype(np.float64))
    return Flat(means.astype(np.float64), np.take_along_axis(R, columns[:, None, :], axis=2), scales)


def opacity_radii(opacity_logits: Floats) -> Floats:
    """Return ``r = sqrt(max(0, q + 2 ln sigmoid(l)))`` in standard deviations.

    Parameters
    ----------
    opacity_logits : ndarray of shape (N,)
        Opacities before the sigmoid.

    Returns
    -------
    ndarray of shape (N,)
        0 where the opacity is at most ``exp(-q / 2)`` = 1/291: an empty polygon.
    """
    log_opacities = -np.logaddexp(0.0, -opacity_logits.astype(np.float64))
    radii: Floats = np.sqrt(np.maximum(0.0, REACH + 2 * log_opacities))
    return radii


def rims(means: Floats, spans: Floats, radii: Floats, n_sides: int = N_SIDES) -> Floats:
    """Return the corners of polygons.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        Centres, world frame.
    spans : ndarray of shape (N, 3, 2)
        Two columns each; any two, perpendicular or not.
    radii : ndarray of shape (N,)
        r in standard deviations.
    n_sides : int
        n, 3 or more.

    Returns
    -------
    ndarray of shape (N, n, 3)
        World frame, counterclockwise as seen from where the normal points.
    """
    return means[:, None] + radii[:, None, None] * (_directions(n_sides) @ np.swapaxes(spans, 1, 2))


def fan_vertices(means: Floats, corners: Floats) -> Floats:
    """Return the vertices [N (n + 1), 3] of fans: each centre [N, 3], then its corners [N, n, 3]."""
    return np.concatenate([means[:, None], corners], axis=1).reshape(-1, 3)


def fan_faces(n_fans: int, n_sides: int = N_SIDES) -> Ints:
    """Return the triangles [N n, 3] of fans, as rows of :func:`fan_vertices`: centre, corner j, corner j + 1."""
    j = np.arange(n_sides)
    one = np.column_stack([np.zeros_like(j), 1 + j, 1 + (j + 1) % n_sides])  # [n, 3]
    return ((n_sides + 1) * np.arange(n_fans)[:, None, None] + one).reshape(-1, 3)


def fit_spans(corners: Floats, radii: Floats) -> tuple[Floats, Floats]:
    """Return the centres [N, 3] and spans [N, 3, 2] that fit polygons best, by least squares over all corners.

    Parameters
    ----------
    corners : ndarray of shape (N, n, 3)
        World frame, in the order of :func:`rims`.
    radii : ndarray of shape (N,)
        r that the polygons were made with, above 0.
    """
    n = corners.shape[1]
    means = corners.mean(axis=1)
    sums = np.swapaxes(corners - means[:, None], 1, 2) @ _directions(n)  # [N, 3, 2]
    return means, sums * (2 / n / radii[:, None, None])


def fit_flat_gaussians(corners: Floats, radii: Floats) -> Flat:
    """Return the flat Gaussians whose polygons fit edited ones best; after an affine edit, exactly.

    Parameters
    ----------
    corners, radii
        As for :func:`fit_spans`; no polygon may be degenerate (:func:`min_widths`).

    Returns
    -------
    Flat
        Their axes are rotated as little as possible from the polygons' first corner and the quarter after it.
    """
    means, spans = fit_spans(corners, radii)
    a, b = spans[:, :, 0], spans[:, :, 1]
    aa, bb, ab = np.sum(a * a, axis=1), np.sum(b * b, axis=1), np.sum(a * b, axis=1)
    # Of a disc any angle is right, and rounding would choose it: what rounding can have done is no shear.
    rounded = ROUNDINGS * np.finfo(np.float64).eps * np.abs(corners).max(axis=(1, 2), initial=0) / radii
    is_sheared = np.abs(ab) > rounded * (np.sqrt(aa) + np.sqrt(bb))
    with np.errstate(divide="ignore", invalid="ignore"):
        theta = np.where(is_sheared, 0.5 * np.arctan(2 * ab / (aa - bb)), 0.0)[:, None]
    return _orthogonal(means, np.cos(theta) * a + np.sin(theta) * b, np.cos(theta) * b - np.sin(theta) * a)


def by_gram_schmidt(corners: Floats, radii: Floats) -> Flat:
    """Return the flat Gaussians of edited polygons as the paper does, from the centre and two corners of each.

    Parameters
    ----------
    corners, radii
        As for :func:`fit_flat_gaussians`. Of a polygon whose number of sides four does not divide, the second corner is
        the one nearest to a quarter, and its component along the first span is known.
    """
    n = corners.shape[1]
    means = corners.mean(axis=1)
    quarter = max(1, n // 4)
    (_, _), (cos, sin) = _directions(n)[[0, quarter]]
    a = (corners[:, 0] - means) / radii[:, None]
    b = ((corners[:, quarter] - means) / radii[:, None] - cos * a) / sin
    return _orthogonal(means, a, b)


def min_widths(corners: Floats) -> Floats:
    """Return the aspect of polygons, across over along: 0 where all corners coincide or lie on one line.

    Parameters
    ----------
    corners : ndarray of shape (N, n, 3)
        World frame.

    Returns
    -------
    ndarray of shape (N,)
        The smaller over the larger half-axis of the ellipse of :func:`fit_spans`, in [0, 1].
    """
    _, spans = fit_spans(corners, np.ones(len(corners)))
    s = np.linalg.svd(spans, compute_uv=False)  # [N, 2]
    return np.divide(s[:, 1], s[:, 0], out=np.zeros(len(s)), where=s[:, 0] > 0)


def _orthogonal(means: Floats, a: Floats, b: Floats) -> Flat:
    """Return flat Gaussians of spans a and b [N, 3], of which b loses its component along a."""
    s_a = np.linalg.norm(a, axis=1, keepdims=True)
    e_a = a / s_a
    b = b - np.sum(b * e_a, axis=1, keepdims=True) * e_a
    s_b = np.linalg.norm(b, axis=1, keepdims=True)
    e_b = b / s_b
    return Flat(means, np.stack([e_a, e_b, np.cross(e_a, e_b)], axis=2), np.column_stack([s_a, s_b]))


def _directions(n_sides: int) -> Floats:
    """Return (cos phi_j, sin phi_j) [n, 2]."""
    phi = 2 * np.pi * np.arange(n_sides) / n_sides
    return np.column_stack([np.cos(phi), np.sin(phi)])
