"""Files of GaussianSplats3D, which minisplat_ref reads and does not write."""

import struct

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.types import Gaussians

CAPACITY, BLOCK, RANGE = 16, 5.0, 32767
ORDER = (0, 3, 8)  # coefficients of each channel, by degree
BOUNDS = (-1.25, 1.75)  # of harmonics in 8 bits


def write_ksplat(gaussians: Gaussians, level: int, n_sections: int = 2) -> bytes:
    """Return Gaussians of degree 0 to 2 in sections of full and partly filled buckets, of which the first is empty.

    Parameters
    ----------
    gaussians : Gaussians
    level : int
        0 for floats, 1 for half floats, 2 for harmonics in 8 bits.
    n_sections : int
        That have Gaussians, as far as these suffice.
    """
    n = len(gaussians.means)
    degree = ORDER.index(gaussians.sh_rest.shape[1])
    headers, bodies = [bytes(1024)], []
    for rows in np.array_split(np.arange(n), n_sections):
        part = Gaussians(*(field[rows] for field in gaussians))
        sizes = [CAPACITY] * (len(rows) // CAPACITY)
        rest = len(rows) % CAPACITY
        partial = [size for size in (rest // 3, rest - rest // 3) if size]
        counts = [*sizes, *partial]
        buckets = np.repeat(np.arange(len(counts)), counts)
        ends = np.cumsum(counts)
        centers = np.array([part.means[e - c : e].mean(axis=0) for e, c in zip(ends, counts, strict=True)], "<f4")
        values = (*(len(rows), len(rows) + 3, CAPACITY, len(counts), BLOCK, 12, 0, 0), len(sizes), len(partial), degree)
        headers.append(struct.pack("<IIIIfHxxIIIIH", *values).ljust(1024, b"\0"))
        body = _rows(part, level, degree, centers[buckets])
        room = bytes(3 * (len(body) // max(1, len(rows))))
        bodies += [np.array(partial, "<u4").tobytes(), centers.tobytes(), body, room]
    header = struct.pack("<BBxxIIIIH14xff", 0, 1, len(headers), len(headers) - 1, n, n, level, *BOUNDS)
    return b"".join([header.ljust(4096, b"\0"), *headers, *bodies])


def _rows(part: Gaussians, level: int, degree: int, centers: np.ndarray) -> bytes:
    kind, other = ("<f4", "<f4") if level == 0 else ("<u2", "<f2")
    means = part.means if level == 0 else np.rint((part.means - centers) / (BLOCK / 2 / RANGE) + RANGE)
    quats = part.quats / np.linalg.norm(part.quats, axis=1, keepdims=True)
    colors = np.clip(np.rint(255 * (0.5 + SH_C0 * part.sh_dc)), 0, 255)
    opacities = np.rint(255 / (1 + np.exp(-part.opacity_logits)))[:, None]
    bands = (part.sh_rest[:, :3], part.sh_rest[:, 3:8])[:degree]
    rest = [band.transpose(0, 2, 1).reshape(len(part.means), -1) for band in bands]
    if level == 2:
        low, high = BOUNDS
        rest = [np.clip(np.rint(255 * (band - low) / (high - low)), 0, 255) for band in rest]
    columns = [
        (means, kind),
        (np.exp(part.log_scales), other),
        (quats, other),
        (np.concatenate([colors, opacities], axis=1), "u1"),
        *((band, ("<f4", "<f2", "u1")[level]) for band in rest),
    ]
    parts = [np.ascontiguousarray(values.astype(dtype)).view(np.uint8) for values, dtype in columns]
    return np.concatenate(parts, axis=1).tobytes()
