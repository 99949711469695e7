"""The formulas of a Gaussian's rotation, its motion in the image, and both losses; each beside its gradient."""

from typing import NamedTuple

import numpy as np

from minisplat_ref.reference.pinhole import pinhole, pinhole_vjp, pose
from minisplat_ref.types import Bools, Camera, Floats, Ints

SOFT = 0.1  # pixels: accuracy of the flow of photographs


def turned(quats: Floats, turns: Floats) -> Floats:
    """Return quaternions after a rotation about ``r`` by the angle ``2 arctan(|r| / 2)``.

    ::

        q' = (1, r / 2) q = (w - r . u / 2,  u + (w r + r x u) / 2)    with q = (w, u)

    A rotation by a small angle has that angle as |r|; no r turns by pi. At r = 0 the quaternions are as they were.

    Parameters
    ----------
    quats : ndarray of shape (N, 4)
        wxyz, any length.
    turns : ndarray of shape (N, 3)
        r, world frame.
    """
    w, u = quats[:, :1], quats[:, 1:]
    half = turns * turns.dtype.type(0.5)
    return np.concatenate([w - np.sum(half * u, axis=1, keepdims=True), u + w * half + np.cross(half, u)], axis=1)


def turned_vjp(quats: Floats, turns: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`turned` with respect to quaternions and turns.

    With the derivative ``(a, b)`` with respect to q'::

        v_w = a + r . b / 2,   v_u = b - a r / 2 + b x r / 2,   v_r = (w b - a u + u x b) / 2
    """
    w, u, a, b = quats[:, :1], quats[:, 1:], v[:, :1], v[:, 1:]
    half = turns * turns.dtype.type(0.5)
    v_quats = np.concatenate([a + np.sum(half * b, axis=1, keepdims=True), b - a * half + np.cross(b, half)], axis=1)
    return v_quats, v.dtype.type(0.5) * (w * b - a * u + np.cross(u, b))


class Step(NamedTuple):
    """Places before and after a step of time, each in the frame of the camera that sees it."""

    before: Floats
    """[N, 3]."""
    after: Floats
    """[N, 3]."""
    cameras: tuple[Camera, Camera]


def image_steps(before: Floats, after: Floats, cameras: tuple[Camera, Camera]) -> tuple[Floats, Step]:
    """Return the motion of places in the image: ``pi'(R' x' + t') - pi(R x + t)``, [N, 2] in pixels.

    Parameters
    ----------
    before, after : ndarray of shape (N, 3)
        x and x', world frame, in front of their cameras.
    cameras : pair of Camera
        The cameras at both times.
    """
    poses = [pose(camera, before.dtype) for camera in cameras]
    seen = [places @ R.T + t for places, (R, t) in zip((before, after), poses, strict=True)]
    return pinhole(seen[1], cameras[1]) - pinhole(seen[0], cameras[0]), Step(seen[0], seen[1], cameras)


def image_steps_vjp(step: Step, v: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`image_steps`: ``v_x = -R^T J^T v`` and ``v_x' = R'^T J'^T v``, J of the pinhole camera."""
    (R, _), (R_after, _) = (pose(camera, v.dtype) for camera in step.cameras)
    v_before, v_after = pinhole_vjp(step.before, step.cameras[0], v), pinhole_vjp(step.after, step.cameras[1], v)
    return -v_before @ R, v_after @ R_after


def flow_error(flow: Floats, alpha: Floats, target: Floats, is_known: Bools) -> float:
    """Return the distance of a rendered flow from the given one, in image widths.

    ::

        L = sum_p rho(F_p - A_p f_p) / (P W)      over the P pixels at which f is known
        rho(r) = sqrt(r_x^2 + e^2) + sqrt(r_y^2 + e^2) - 2 e

    F is the blend ``sum_i w_i f_i`` of the Gaussians' motions in the image, and A the accumulated opacity, so that each
    Gaussian contributes ``w_i (f_i - f)``: one that is faint is not compared with the whole motion. rho is the L1 norm
    but for the kink at zero, which is round within e = SOFT pixels.

    Parameters
    ----------
    flow : ndarray of shape (H, W, 2)
        F, pixels.
    alpha : ndarray of shape (H, W)
        A.
    target : ndarray of shape (H, W, 2)
        f, pixels.
    is_known : ndarray of shape (H, W) of booleans
    """
    residuals = (flow - alpha[..., None] * target)[is_known]
    total = float(np.sum(np.hypot(residuals, residuals.dtype.type(SOFT)) - residuals.dtype.type(SOFT)))
    return total / (max(len(residuals), 1) * flow.shape[1])


def flow_error_vjp(flow: Floats, alpha: Floats, target: Floats, is_known: Bools) -> tuple[Floats, Floats]:
    """Gradient of :func:`flow_error`: ``v_F = r / sqrt(r^2 + e^2) / (P W)``, r = F - A f, and ``v_A = -f . v_F``."""
    unit = flow.dtype.type(1 / (max(np.count_nonzero(is_known), 1) * flow.shape[1]))
    known = np.where(is_known[..., None], target, 0)
    residuals = flow - alpha[..., None] * known
    slopes = residuals / np.hypot(residuals, residuals.dtype.type(SOFT))
    v_flow = np.where(is_known[..., None], unit * slopes, 0).astype(flow.dtype)
    return v_flow, -np.sum(known * v_flow, axis=2)


class Pairs(NamedTuple):
    """Pairs of pixels, the first of each nearer."""

    near: Ints
    """[Q, 2] row and column."""
    far: Ints
    """[Q, 2]."""


def order_error(sums: Floats, alpha: Floats, pairs: Pairs, margin: float) -> float:
    """Return the violation of the order in depth by pairs of pixels.

    ::

        L = mean max(0, m + ln d_near - ln d_far),   d = D / A

    Only the order of the given depths counts, and only the ratio of the rendered ones: neither scale matters.

    Parameters
    ----------
    sums : ndarray of shape (H, W)
        D, the accumulated depth ``sum w z``.
    alpha : ndarray of shape (H, W)
        A, above 0 at these pixels.
    pairs : Pairs
    margin : float
        m.
    """
    return float(np.sum(np.maximum(_excess(sums, alpha, pairs, margin), 0))) / max(len(pairs.near), 1)


def order_error_vjp(sums: Floats, alpha: Floats, pairs: Pairs, margin: float) -> tuple[Floats, Floats]:
    """Gradient of :func:`order_error`: ``v_D = +-1 / (Q D)`` and ``v_A = -+1 / (Q A)``, + at near pixels."""
    v_sums, v_alpha = np.zeros_like(sums), np.zeros_like(alpha)
    counts = _excess(sums, alpha, pairs, margin) > 0
    for pixels, sign in ((pairs.near, 1), (pairs.far, -1)):
        rows, columns = pixels[counts].T
        weight = sums.dtype.type(sign / max(len(pairs.near), 1))
        np.add.at(v_sums, (rows, columns), weight / sums[rows, columns])
        np.add.at(v_alpha, (rows, columns), -weight / alpha[rows, columns])
    return v_sums, v_alpha


def _excess(sums: Floats, alpha: Floats, pairs: Pairs, margin: float) -> Floats:
    """Return ``m + ln d_near - ln d_far``, [Q]."""
    near, far = (np.log(sums[tuple(p.T)]) - np.log(alpha[tuple(p.T)]) for p in pairs)
    excess: Floats = sums.dtype.type(margin) + near - far
    return excess
