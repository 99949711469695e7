"""``.splat``: 32 bytes for each Gaussian, without a header, as antimatter15's viewer introduced it.

======== =====================================================
centre   3 x float32
scales   3 x float32, not their logarithms
colour   3 x uint8 in 255ths: ``0.5 + SH_C0 c``, clipped
opacity  uint8 in 255ths
rotation 4 x uint8, wxyz: ``128 q + 128``, clipped
======== =====================================================

The frame is that of the PLY. Harmonics of degree 1 and above are left out, with a warning. The order of the Gaussians
is kept; other writers put those of large volume and opacity first, for viewers that show a file while it comes.
"""

import warnings
from pathlib import Path

import numpy as np

from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io.formats import Format
from minisplat_ref.io.formats.levels8 import (
    WAY_OUT,
    check_float32,
    check_scales,
    color_bytes,
    decode_logits,
    decode_sh_dc,
    finish,
    finite_scales,
    opacity_bytes,
)
from minisplat_ref.io.packing.pieces import pieces
from minisplat_ref.types import Gaussians

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def encode(gaussians: Gaussians, level: int) -> bytes:
    """Return the content of a file; it has one level.

    Raises
    ------
    InputError
        A value is not finite, or a scale is beyond float32.
    """
    check_float32(gaussians)
    check_scales(gaussians)
    if gaussians.sh_rest.size:
        warnings.warn(".splat holds no harmonics above degree 0: they are left out", InputWarning, stacklevel=2)
    rows = np.empty(len(gaussians.means), ROW)
    for part in pieces(len(rows)):
        piece = Gaussians(*(field[part] for field in gaussians))
        rows["scales"][part] = finite_scales(piece)
        rows["means"][part] = piece.means
        rows["rgba"][part, :3] = color_bytes(piece.sh_dc)
        rows["rgba"][part, 3] = opacity_bytes(piece.opacity_logits)
        unit = piece.quats / np.linalg.norm(piece.quats.astype(np.float64), axis=1, keepdims=True)
        rows["quats"][part] = np.clip(np.floor(128.0 * unit + 128.5), 0, 255)
    return rows.tobytes()


def decode(content: bytes, source: str | Path) -> Gaussians:
    """Return the Gaussians of a file, float32, of degree 0.

    Raises
    ------
    InputError
        The file is no sequence of rows, or a value makes no sense.
    """
    if len(content) % ROW.itemsize:
        raise InputError(f"{source}: {len(content):,} bytes are no rows of {ROW.itemsize}: {WAY_OUT}")
    rows = np.frombuffer(content, ROW)
    bad = np.flatnonzero(~(rows["scales"] > 0).all(axis=1))
    if bad.size:
        raise InputError(f"{source}: row {bad[0]} has the scales {rows['scales'][bad[0]].tolist()}; {WAY_OUT}")
    with np.errstate(invalid="ignore"):
        gaussians = Gaussians(
            means=rows["means"],
            quats=(rows["quats"].astype(np.float64) - 128.0) / 128.0,
            log_scales=np.log(rows["scales"].astype(np.float64)),
            opacity_logits=decode_logits(rows["rgba"][:, 3]),
            sh_dc=decode_sh_dc(rows["rgba"][:, :3]),
            sh_rest=np.zeros((len(rows), 0, 3)),
        )
    return finish(source, gaussians)


def describe(content: bytes, source: str | Path) -> list[tuple[str, str]]:
    """Return the precision of a file, as pairs of name and text."""
    return [
        ("centres, scales", "float32"),
        ("rotations", f"each component within {0.5 / 128:.2g}"),
        ("colours, opacities", f"within {0.5 / 255:.2g}; no harmonics above degree 0"),
    ]


SPLAT = Format(
    suffix=".splat",
    summary="32 bytes each, degree 0",
    levels=("8 bits",),
    default_level=0,
    encode=encode,
    decode=decode,
    describe=describe,
)
"""The format of the first viewers in the browser."""
