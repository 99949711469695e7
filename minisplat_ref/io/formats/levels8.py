"""Encodings of several formats: bytes of opacity and colour, and quaternions without their largest component."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.io.packing.pieces import pieces
from minisplat_ref.types import Floats, Gaussians, Ints
from minisplat_ref.validation import check_gaussians

WAY_OUT = "copy or export the file again"
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # of w, x, y, z, by which of them is left out


def to_bytes(values: Floats) -> NDArray[np.uint8]:
    """Return values in [0, 1] in 255ths, rounded; others are clipped."""
    return np.clip(np.floor(255.0 * values + 0.5), 0, 255).astype(np.uint8)


def opacities_of(logits: Floats) -> Floats:
    """Return the sigmoid of logits, without an overflow."""
    return 0.5 * (1.0 + np.tanh(0.5 * logits))


def opacity_bytes(logits: Floats) -> NDArray[np.uint8]:
    """Return opacities in 255ths."""
    return to_bytes(opacities_of(logits.astype(np.float64)))


def decode_logits(levels: NDArray[np.uint8]) -> Floats:
    """Return the logits of opacities in 255ths; 0 and 1, which have none, as a quarter of a level away."""
    clipped = np.clip(levels.astype(np.float64), 0.25, 254.75)
    return np.log(clipped / (255.0 - clipped))


def color_bytes(sh_dc: Floats) -> NDArray[np.uint8]:
    """Return the colours of coefficients of degree 0 in 255ths; others than [0, 1] are clipped."""
    return to_bytes(0.5 + SH_C0 * sh_dc.astype(np.float64))


def decode_sh_dc(levels: NDArray[np.uint8]) -> Floats:
    """Return the coefficients of degree 0 of colours in 255ths."""
    return (levels / 255.0 - 0.5) / SH_C0


def drop_largest(quats: Floats) -> tuple[Ints, Floats]:
    """Return the index of the largest of w, x, y, z [N], and the other components [N, 3] in [0, 1].

    Of unit quaternions with a positive largest component no other is beyond ``1 / sqrt(2)``; u = q / sqrt(2) + 1/2.
    """
    unit = quats / np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    largest = np.argmax(np.abs(unit), axis=1)
    unit = unit * np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)
    return largest, np.take_along_axis(unit, OTHERS[largest], axis=1) / math.sqrt(2.0) + 0.5


def restore_largest(largest: Ints, others: Floats) -> Floats:
    """Return unit quaternions [N, 4], wxyz, from the output of :func:`drop_largest`."""
    others = math.sqrt(2.0) * (others - 0.5)
    quats = np.empty((len(others), 4))
    np.put_along_axis(quats, OTHERS[largest], others, axis=1)
    rest = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=1)))
    np.put_along_axis(quats, largest[:, None], rest[:, None], axis=1)
    return quats


def finish(source: str | Path, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians of a file in float32, after checking them.

    Raises
    ------
    InputError
        A value is not finite, or a quaternion is zero.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        gaussians = Gaussians(*(np.ascontiguousarray(field, dtype=np.float32) for field in gaussians))
    check_gaussians(gaussians, source)
    return gaussians


def check_float32(gaussians: Gaussians) -> None:
    """Refuse values that no file of float32 holds.

    Raises
    ------
    InputError
        A value is not finite, or beyond float32.
    """
    with np.errstate(over="ignore"):
        check_gaussians(Gaussians(*(field.astype(np.float32, copy=False) for field in gaussians)), "Gaussians")


def finite_scales(gaussians: Gaussians) -> NDArray[np.float32]:
    """Return the scales [N, 3] of Gaussians, for files that do not hold their logarithms; see :func:`check_scales`."""
    return np.exp(gaussians.log_scales.astype(np.float64)).astype("<f4")


def check_scales(gaussians: Gaussians) -> None:
    """Refuse Gaussians whose scales a file of float32 does not hold.

    Raises
    ------
    InputError
        One is infinite or zero in float32.
    """
    for part in pieces(len(gaussians.log_scales), "checking"):
        rows = gaussians._replace(log_scales=gaussians.log_scales[part])
        with np.errstate(over="ignore"):
            scales = finite_scales(rows)
        bad = np.flatnonzero(~np.isfinite(scales).all(axis=1) | (scales == 0).any(axis=1))
        if bad.size:
            value = rows.log_scales[bad[0]].tolist()
            row = part.start + bad[0]
            raise InputError(f"the scales of row {row}, e^{value}, are beyond float32: remove its Gaussian")


def refuse_size(source: str | Path, needed: int, found: int) -> None:
    """Refuse a file that is shorter than its header states.

    Raises
    ------
    InputError
        It is.
    """
    if needed > found:
        raise InputError(f"{source}: truncated, {needed:,} bytes expected, {found:,} found; {WAY_OUT}")
