"""The response of a textured Gaussian, in NumPy: opacity and colour at the point n that the pixel's ray hits.

With the real spherical harmonics Y_k, the opacity o = sigmoid(l) of 3DGS and its colour c, which may depend on the
view::

    x(n)     = sum_k h_k Y_k(n),              opacity(n) = sigmoid(l + x)
    color(n) = max(0, c + sum_k k_k Y_k(n))   for each channel; k from 1 on, since o and c are of degree 0
    alpha    = opacity(n) exp(-d^T Q d / 2)

The squares of the harmonics of degree 1 to L add up to ``sum_k Y_k^2 = ((L + 1)^2 - 1) / (4 pi)`` for every n, so ``|x|
<= B`` with ``B = |h| sqrt(((L + 1)^2 - 1) / (4 pi))``. A footprint is as large as that of the opacity ``o_B = sigmoid(l
+ B)``, and alpha is the alpha of that one times m: with ``w = exp(-(l + B))`` and ``e = exp(x - B)``::

    alpha = o_B exp(-d^T Q d / 2) m,  m = e (1 + w) / (e + w),  1 - opacity(n) = w / (e + w)

B needs no derivative, because a change of o_B and of m by B cancel.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.textured.reference import Meeting, meet, meet_vjp
from minisplat_ref.mechanisms.payload.footprints import Footprints, boxes_of
from minisplat_ref.reference.hits import CONIC, ConicPlace, Hit, Response, Shading
from minisplat_ref.reference.spherical_harmonics import sh_basis, sh_basis_jacobian
from minisplat_ref.types import Floats, Ints


def degree_of(n_coefficients: int) -> int:
    """Return the degree L of ``(L + 1)^2 - 1`` coefficients."""
    return math.isqrt(n_coefficients + 1) - 1


def bounds(opacity_textures: Floats) -> Floats:
    """Return B [N], the largest value that textures [N, K-1] can add to the logit."""
    bound: Floats = np.linalg.norm(opacity_textures, axis=1)
    return bound * bound.dtype.type(math.sqrt(opacity_textures.shape[1] / (4 * math.pi)))


@dataclass(frozen=True)
class TexturedFootprints(Footprints):
    """The footprints of textured Gaussians.

    The projection is that of the opacity o_B, compensated where the conventions require it.
    """

    logits: Floats
    """[N] l."""
    opacity_textures: Floats
    """[N, K-1] h."""
    frames: Floats
    """[N, 3, 3] A."""

    @property
    def odds(self) -> Floats:
        """[N] w, which may be infinite for Gaussians that are too faint to be seen."""
        with np.errstate(over="ignore"):
            return np.exp(-(self.logits + bounds(self.opacity_textures)))


FIELDS = (*CONIC.fields, "logits", "opacity_textures", "frames")


class Place(NamedTuple):
    """The hits of P pixels on G Gaussians."""

    conic: ConicPlace
    meeting: Meeting
    basis: Floats  # [G, P, K-1] Y_k(n) from degree 1 on
    shares: Floats  # [G, P] m
    transparencies: Floats  # [G, P] 1 - opacity(n)


def hit(footprints: TexturedFootprints, ids: Ints, centers: Floats) -> Hit:
    """Return the hits of footprints at pixels; see :func:`minisplat_ref.reference.hits.conic_hit`."""
    flat = CONIC.hit(footprints.projection, ids, centers)
    h = footprints.opacity_textures[ids]  # [G, K-1]
    meeting = meet(footprints.frames[ids], footprints.means2d[ids], centers)
    n, degree = meeting.directions, degree_of(h.shape[1])
    basis = sh_basis(n.reshape(-1, 3), degree)[:, 1:].reshape(*n.shape[:2], h.shape[1])
    e = np.exp(np.einsum("gk,gpk->gp", h, basis) - bounds(h)[:, None])
    w = footprints.odds[ids, None]
    shares, transparencies = e * (1 + w) / (e + w), w / (e + w)
    return Hit(flat.unclamped * shares, flat.depths, Place(flat.place, meeting, basis, shares, transparencies))


def hit_vjp(
    footprints: TexturedFootprints, ids: Ints, hit: Hit, v_mean: Floats, v_shape: Floats, v_basis: Floats
) -> tuple[Floats, ...]:
    """Gradient of :func:`hit` with respect to ``FIELDS``; ``v_basis`` is the colours' derivative with respect to Y_k.

    ::

        v_E, v_o_B = those of the conic for m v_alpha
        v_x   = alpha (1 - opacity(n)) v_alpha,  v_l = sum v_x,  v_h_k = sum Y_k v_x
        v_Y_k = h_k v_x + the colours',  v_n = sum_k v_Y_k dY_k/dn, and from there to frames and centres
    """
    place: Place = hit.place
    flat = Hit(hit.unclamped, hit.depths, place.conic)
    v_means2d, v_conics, v_opacities = CONIC.hit_vjp(
        footprints.projection, ids, flat, v_mean * place.shares, v_shape * place.shares, None
    )
    v_x = v_shape * hit.unclamped * place.transparencies  # [G, P]
    h, n = footprints.opacity_textures[ids], place.meeting.directions
    v_Y = v_x[:, :, None] * h[:, None] + v_basis
    slopes = sh_basis_jacobian(n.reshape(-1, 3), degree_of(h.shape[1]))[:, 1:].reshape(*v_Y.shape, 3)
    v_n = np.einsum("gpk,gpki->gpi", v_Y, slopes)
    v_frames, v_centers = meet_vjp(footprints.frames[ids], footprints.means2d[ids], place.meeting, v_n)
    v_h = np.einsum("gp,gpk->gk", v_x, place.basis)
    return v_means2d + v_centers, v_conics, v_opacities, v_x.sum(axis=1), v_h, v_frames


def shade(coefficients: Floats, place: Place) -> Floats:
    """Return the channels [G, P, D] of ``coefficients`` [G, D K], which hold c and the k_k of each channel."""
    return np.maximum(0, _unclamped(coefficients, place))


def shade_vjp(coefficients: Floats, place: Place, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`shade` with respect to coefficients [G, D K] and Y_k [G, P, K-1].

    It is zero where the channel was clamped, but not at zero itself, so that a colour of 3DGS that was clamped to zero
    can still get a texture.
    """
    n_coefficients = place.basis.shape[2] + 1
    v = np.where(_unclamped(coefficients, place) >= 0, v, 0)  # [G, P, D]
    k = _by_channel(coefficients, n_coefficients)[:, :, 1:]  # [G, D, K-1]
    v_base = v.sum(axis=1)[:, :, None]  # [G, D, 1]
    v_k = np.einsum("gpd,gpk->gdk", v, place.basis)
    v_coefficients = np.concatenate([v_base, v_k], axis=2).reshape(coefficients.shape)
    return v_coefficients, np.einsum("gpd,gdk->gpk", v, k)


def _unclamped(coefficients: Floats, place: Place) -> Floats:
    by_channel = _by_channel(coefficients, place.basis.shape[2] + 1)
    return by_channel[:, None, :, 0] + np.einsum("gdk,gpk->gpd", by_channel[:, :, 1:], place.basis)


def _by_channel(coefficients: Floats, n_coefficients: int) -> Floats:
    """Return ``coefficients`` [G, D K] as [G, D, K]."""
    return coefficients.reshape(len(coefficients), coefficients.shape[1] // n_coefficients, n_coefficients)


RESPONSE = Response(boxes_of, hit, hit_vjp, FIELDS, Shading(shade, shade_vjp))
