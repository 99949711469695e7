"""Gaussians on the faces of a mesh: their parameters, where these place them, and the gradient.

A face has the corners p0, p1, p2, the centroid m and the unit normal n. A Gaussian on it stores three logits a and one
logarithm of a size, and follows from them and from the corners, which are not trained (GaMeS, Eqs. 3 to 7):

    pi = softmax(a),   mu = pi_0 p0 + pi_1 p1 + pi_2 p2
    R = [n, r2, r3],   r2 = (p0 - m) / |p0 - m|,   r3 = n x r2
    s = rho (eps h, |p0 - m|, (p1 - m) . r3),   rho = exp(log_size),   h = sqrt(|p0 - m| (p1 - m) . r3)

r3 is the direction of p1 - m after n and r2 are taken out of it, with its length as the third scale.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.mechanisms.editing.deformation import quaternions
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Floats, Gaussians

THINNESS = 1e-3  # eps: thickness over the mean of the other two standard deviations


class FaceGaussians(NamedTuple):
    """Gaussians with the face that each is on: the six fields of ``Gaussians``, and five more."""

    means: Floats
    """[N, 3] no parameter: computed from the further fields, for culling and for files; so are the next two."""
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    corner_logits: Floats
    """[N, 3] a: their softmax is the weight of each corner."""
    log_sizes: Floats
    """[N] ln rho."""
    p0: Floats
    """[N, 3] corners of the face, counter-clockwise as seen from outside, world frame; not trained."""
    p1: Floats
    p2: Floats


class FaceFrames(NamedTuple):
    """The quantities that follow from the corners alone."""

    quats: Floats
    """[N, 4] of R."""
    log_lengths: Floats
    """[N, 3] ln (s / rho), world units."""


def face_frames(p0: Floats, p1: Floats, p2: Floats) -> FaceFrames:
    """Return rotation and lengths of faces with corners [N, 3] each; every face has an area."""
    m = (p0 + p1 + p2) / 3
    n = np.cross(p1 - p0, p2 - p0)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    first = np.linalg.norm(p0 - m, axis=1)  # [N]
    r2 = (p0 - m) / first[:, None]
    r3 = np.cross(n, r2)
    second = np.sum((p1 - m) * r3, axis=1)  # [N] above zero, as the corners go around m counter-clockwise
    lengths = np.stack([THINNESS * np.sqrt(first * second), first, second], axis=1)
    return FaceFrames(quaternions(np.stack([n, r2, r3], axis=2)), np.log(lengths))


def place(g: FaceGaussians) -> FaceGaussians:
    """Return the Gaussians with means, rotations and scales as their faces have them, in the dtype of the fields."""
    frames = face_frames(g.p0, g.p1, g.p2)
    pi = corner_weights(g.corner_logits)
    means = pi[:, :1] * g.p0 + pi[:, 1:2] * g.p1 + pi[:, 2:] * g.p2
    return g._replace(means=means, quats=frames.quats, log_scales=frames.log_lengths + g.log_sizes[:, None])


def place_vjp(g: FaceGaussians, v: FaceGaussians) -> FaceGaussians:
    """Gradient of :func:`place`.

    ::

        v_pi_i = p_i . v_mu,   v_a_i = pi_i (v_pi_i - sum_j pi_j v_pi_j)
        v_log_size = sum of v_log_scales

    Parameters
    ----------
    g : FaceGaussians
        As for :func:`place`.
    v : FaceGaussians
        Derivatives with respect to its result; those of the five further fields are zero.

    Returns
    -------
    FaceGaussians
        Zero for means, rotations, scales and corners, which are no parameters.
    """
    pi = corner_weights(g.corner_logits)
    v_pi = np.stack([np.sum(p * v.means, axis=1) for p in (g.p0, g.p1, g.p2)], axis=1)  # [N, 3]
    return v._replace(
        means=np.zeros_like(g.means),
        quats=np.zeros_like(g.quats),
        log_scales=np.zeros_like(g.log_scales),
        corner_logits=pi * (v_pi - np.sum(pi * v_pi, axis=1, keepdims=True)),
        log_sizes=v.log_scales.sum(axis=1),
    )


def corner_weights(corner_logits: Floats) -> Floats:
    """Return pi [N, 3], which sums to 1, of logits a [N, 3]."""
    powers = np.exp(corner_logits - corner_logits.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def on_own_faces(gaussians: Gaussians, rng: np.random.Generator) -> FaceGaussians:
    """Return one Gaussian in the middle of each face, with the face's rotation, and its scales for rho = 1.

    :func:`place` then returns its mean, its rotation, and its second and third scale; along its first axis it is flat.
    With the mean m, and s2 and s3 along r2 and r3, the corners are

        p0 = m + s2 r2,   p1 = m - s2/2 r2 + s3 r3,   p2 = m - s2/2 r2 - s3 r3
    """
    means, scales = gaussians.means, np.exp(gaussians.log_scales)
    R = rotation_matrices(gaussians.quats)  # [N, 3, 3]
    a, b = scales[:, 1:2] * R[:, :, 1], scales[:, 2:] * R[:, :, 2]  # [N, 3] each
    g = FaceGaussians(
        *gaussians,
        corner_logits=np.zeros_like(means),
        log_sizes=np.zeros_like(gaussians.opacity_logits),
        p0=means + a,
        p1=means - a / 2 + b,
        p2=means - a / 2 - b,
    )
    return place(g)
