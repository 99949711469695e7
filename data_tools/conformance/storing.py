"""How viewers store Gaussians before they draw them: what is rounded to bytes, or clamped.

Each function returns the Gaussians that a viewer's shader reads, from those of the file; the reference then renders
these. What half precision rounds (five parts in ten thousand) stays below what 8 bits show, but for means far away.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from minisplat_ref.constants import SH_C0
from minisplat_ref.oracle.faults.forward import unnormalised_rotations
from minisplat_ref.types import Floats, Gaussians

LOG_SCALES = (-12.0, 9.0)  # that Spark's 254 steps cover
N_STEPS = 254
N_STEPS_COMPACT = 255  # of PlayCanvas, over the same range
TINY = 1e-9


class Storage(NamedTuple):
    """A way to store Gaussians."""

    words: str
    change: Callable[[Gaussians], Gaussians]


def _bytes(values: Floats) -> Floats:
    return np.asarray(np.rint(np.clip(255 * values, 0, 255)) / 255)


def _logits(opacities: Floats) -> Floats:
    clipped = np.clip(opacities, TINY, 1 - TINY)
    return np.asarray(np.log(clipped / (1 - clipped)))


def _opacities(g: Gaussians) -> Floats:
    return np.asarray(1 / (1 + np.exp(-g.opacity_logits.astype(np.float64))))


def _base_in_bytes(g: Gaussians) -> Floats:
    return np.asarray((_bytes(g.sh_dc * SH_C0 + 0.5) - 0.5) / SH_C0)


def _unit(quats: Floats) -> Floats:
    return np.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True))


def _as_they_are(g: Gaussians) -> Gaussians:
    return g


def _clamped_bytes(g: Gaussians) -> Gaussians:
    return g._replace(sh_dc=_base_in_bytes(g), opacity_logits=_logits(_bytes(_opacities(g))))


def _floored_bytes(g: Gaussians) -> Gaussians:
    return _clamped_bytes(g)._replace(opacity_logits=_logits(np.floor(255 * _opacities(g)) / 255))


def _splat(g: Gaussians) -> Gaussians:
    """Return what 32 bytes hold: colours, opacities and quaternions in bytes, no harmonics."""
    stored = _clamped_bytes(g)._replace(sh_rest=g.sh_rest[:, :0])
    return _turned(stored, np.clip(np.rint(_unit(g.quats) * 128 + 128), 0, 255) / 128 - 1)


def _splat_and_harmonics(g: Gaussians) -> Gaussians:
    """Return the same with harmonics, which are clamped to one and rounded to 1/127.5."""
    rest = np.rint(np.clip(g.sh_rest * 127.5 + 127.5, 0, 255)) / 127.5 - 1
    quats = np.clip(np.rint(_unit(g.quats) * 127.5 + 127.5), 0, 255) / 127.5 - 1
    return _clamped_bytes(g)._replace(sh_rest=rest, quats=quats)


def _turned(g: Gaussians, quats: Floats) -> Gaussians:
    """Return Gaussians whose rotations are made of quaternions that are not normalised: their shape is another."""
    M = unnormalised_rotations(quats) * np.exp(g.log_scales.astype(np.float64))[:, None]
    axes, lengths, _ = np.linalg.svd(M)
    axes[:, :, 2] *= np.linalg.det(axes)[:, None]
    turned = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    return g._replace(log_scales=np.log(lengths), quats=turned)


def _packed(g: Gaussians) -> Gaussians:
    """Return what Spark's 16 bytes hold: means of half precision, scales in 254 steps, quaternions in three bytes."""
    low, high = LOG_SCALES
    step = (high - low) / N_STEPS
    halved = np.rint(np.clip(127.5 * _opacities(g), 0, 255)) / 127.5  # twice the byte of half the opacity
    return g._replace(
        means=g.means.astype(np.float16).astype(np.float64),
        log_scales=low + step * np.rint((np.clip(g.log_scales, low, high) - low) / step),
        quats=np.array([_octahedral(q) for q in _unit(g.quats)]),
        sh_dc=_base_in_bytes(g),
        opacity_logits=_logits(halved),
    )


def _octahedral(quat: Floats) -> Floats:
    """Return a quaternion whose axis is stored as two bytes on an octahedron, and whose angle as one."""
    q = quat if quat[0] >= 0 else -quat
    theta, length = 2 * np.arccos(min(q[0], 1.0)), np.linalg.norm(q[1:])
    axis = q[1:] / length if length > 1e-6 else np.array([1.0, 0, 0])
    p = axis / np.abs(axis).sum()
    if p[2] < 0:
        p[:2] = (1 - np.abs(p[[1, 0]])) * np.where(p[:2] >= 0, 1, -1)
    u = 2 * np.rint((p[:2] / 2 + 0.5) * 255) / 255 - 1
    z = 1 - np.abs(u).sum()
    u = u - np.where(u >= 0, 1, -1) * max(-z, 0.0)
    stored = np.array([*u, z])
    half = np.rint(theta * 255 / np.pi) / 255 * np.pi / 2
    return np.concatenate([[np.cos(half)], np.sin(half) * stored / np.linalg.norm(stored)])


def _compact(g: Gaussians) -> Gaussians:
    """Return what PlayCanvas' 20 bytes hold: scales in 255 steps, quaternions in 11, 11 and 10 bits."""
    low, high = LOG_SCALES
    step, steps = (high - low) / N_STEPS_COMPACT, np.array([2047, 2047, 1023])
    q = _unit(g.quats)
    q = np.where(q[:, :1] < 0, -q, q)
    p = q[:, 1:] / np.sqrt(1 + q[:, :1])
    p = np.floor(np.clip((p / 2 + 0.5) * steps + 0.5, 0, steps)) / steps * 2 - 1
    d = np.sum(p**2, axis=1, keepdims=True)
    return g._replace(
        log_scales=low + step * np.floor(np.clip((g.log_scales - low) / step + 0.5, 1, N_STEPS_COMPACT)),
        quats=np.concatenate([1 - d, np.sqrt(np.maximum(2 - d, 0)) * p], axis=1),
        opacity_logits=_logits(_bytes(_opacities(g))),
    )


EXACT = Storage("", _as_they_are)
BYTES = Storage("colours without harmonics and opacities in bytes, these rounded down", _floored_bytes)
SPLAT = Storage("32 bytes: colours, opacities, quaternions in bytes, no harmonics", _splat)
SPLAT_AND_HARMONICS = Storage("32 bytes and harmonics in bytes, between -1 and 1", _splat_and_harmonics)
COMPACT = Storage("20 bytes: scales in steps of 8 %, opacities in bytes, quaternions in 32 bits", _compact)
PACKED = Storage("16 bytes: means of half precision, scales in steps of 8 %, quaternions in 3 bytes", _packed)
