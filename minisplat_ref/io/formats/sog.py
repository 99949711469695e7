"""``.sog``: PlayCanvas' Spatially Ordered Gaussians, version 2: a ZIP of lossless WebP images and ``meta.json``.

A pixel is a Gaussian, row by row from the top left; those of all images at one place belong together.

============= ===============================================================================================
means_l, _u   low and high byte of 16 bits for x, y, z between ``mins`` and ``maxs`` of ``sign(x) ln(1 + |x|)``
quats         three components without the largest, ``255 (q / sqrt(2) + 1/2)``; alpha is 252 + its place in wxyz
scales        indices into a codebook of 256 log-scales
sh0           indices into a codebook of 256 coefficients of degree 0; alpha is the opacity in 255ths
shN_centroids a palette of harmonics, 64 entries a row, a pixel for each coefficient, RGB; indices into a codebook
shN_labels    low and high byte of the entry that a Gaussian has
============= ===============================================================================================

Up to 65,536 Gaussians have an entry each. Of more, the palette is the means of the leaves of a tree, whose nodes are
halved along the coefficient of largest variance; of more than a million, the tree is that of a sample from all over the
scene. Codebooks begin at equal shares of the cube root of the histogram, which is best for squared errors where levels
are many, and are improved by Lloyd's steps. We write Gaussians in Morton order. The frame is that of the PLY. Left out
are version 1 and reading levels of detail, which :mod:`minisplat_ref.app.runs.levels` writes.
"""

import json
import math
import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from minisplat_ref import memory
from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.formats import Format
from minisplat_ref.io.formats.levels8 import (
    WAY_OUT,
    check_float32,
    decode_logits,
    drop_largest,
    finish,
    opacity_bytes,
    restore_largest,
)
from minisplat_ref.io.packing.morton import morton_order
from minisplat_ref.io.packing.pieces import pieces
from minisplat_ref.types import Floats, Gaussians, Ints

VERSION = 2
META = "meta.json"
PALETTE_MAX = 1 << 16  # entries, a power of two
SAMPLES_MAX = 1 << 20  # Gaussians of which the tree is made
PER_ROW = 64  # entries of the palette
MODE = 252  # alpha of a rotation whose largest component is w
N_LEVELS, N_BINS, N_STEPS = 256, 256, 8  # of a codebook, of the histogram that it begins with, and of Lloyd
RATIO_MAX = 1000  # bytes of pixels made of one of the file
META_BYTES_MAX = 1 << 20
DATE = (1980, 1, 1, 0, 0, 0)  # the earliest that a ZIP holds: equal Gaussians make equal files


class _File(NamedTuple):
    """A file, its images decoded."""

    meta: Mapping[str, Any]
    n: int
    images: Mapping[str, NDArray[np.uint8]]
    """[P, 4] by their places in ``meta``: P >= N pixels, and those of the palette [H, W, 4]."""


def encode(gaussians: Gaussians, level: int) -> bytes:
    """Return the content of a file, with the Gaussians in Morton order; it has one level.

    Raises
    ------
    InputError
        A value is not finite, or beyond float32.
    """
    check_float32(gaussians)
    order = morton_order(gaussians.means)
    n, n_rest = gaussians.sh_rest.shape[:2]
    mins, maxs, steps = _steps(gaussians.means[order].astype(np.float64))
    scale_book, scales = _codebook(gaussians.log_scales[order].astype(np.float64))
    color_book, colors = _codebook(gaussians.sh_dc[order].astype(np.float64))
    quats, opacities = np.empty((n, 4), np.uint8), np.empty((n, 1), np.uint8)
    for part in pieces(n):
        largest, others = drop_largest(gaussians.quats[order[part]].astype(np.float64))
        quats[part, :3], quats[part, 3] = np.floor(255.0 * others + 0.5), MODE + largest
        opacities[part, 0] = opacity_bytes(gaussians.opacity_logits[order[part]])
    width = max(4, 4 * math.ceil(math.sqrt(n) / 4))
    images = {
        "means_l": _image(steps & 255, width),
        "means_u": _image(steps >> 8, width),
        "quats": _image(quats, width),
        "scales": _image(scales, width),
        "sh0": _image(np.concatenate([colors, opacities], axis=1), width),
    }
    meta: dict[str, Any] = {
        "version": VERSION,
        "count": n,
        "means": {"mins": mins.tolist(), "maxs": maxs.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book, "files": ["sh0.webp"]},
    }
    if n_rest and n:
        palette, labels = _palette(gaussians.sh_rest, order)
        book, entries = _codebook(palette)
        rows = np.zeros((math.ceil(len(palette) / PER_ROW) * PER_ROW, 3 * n_rest), np.uint8)
        rows[: len(entries)] = entries
        images["shN_centroids"] = _image(rows.reshape(-1, 3), PER_ROW * n_rest)
        images["shN_labels"] = _image(np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1), width)
        files = ["shN_centroids.webp", "shN_labels.webp"]
        bands = math.isqrt(n_rest + 1) - 1
        meta["shN"] = {"count": len(palette), "bands": bands, "codebook": book, "files": files}
    file = BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(zipfile.ZipInfo(META, DATE), json.dumps(meta))
        for name, image in with_progress(images.items(), "packing", "images"):
            packed = BytesIO()
            image.save(packed, "webp", lossless=True, exact=True, quality=100)  # exact: colours under alpha 0 count
            archive.writestr(zipfile.ZipInfo(f"{name}.webp", DATE), packed.getvalue())
    return file.getvalue()


def _steps(means: Floats) -> tuple[Floats, Floats, NDArray[np.uint16]]:
    """Return the bounds [3] of the logarithms of centres [N, 3], and the steps between them."""
    logs = np.sign(means) * np.log1p(np.abs(means))  # [N, 3]
    mins, maxs = (logs.min(axis=0), logs.max(axis=0)) if len(means) else (np.zeros(3), np.zeros(3))
    return mins, maxs, np.rint(65535 * (logs - mins) / np.where(maxs > mins, maxs - mins, 1.0)).astype(np.uint16)


def _image(values: NDArray, width: int) -> Image.Image:
    """Return pixels [P, 3 or 4] as an image, filled up with zeros."""
    height = max(1, -(-len(values) // width))
    pixels = np.zeros((height * width, values.shape[1]), np.uint8)
    pixels[: len(values)] = values
    return Image.fromarray(pixels.reshape(height, width, -1))


def _codebook(values: Floats) -> tuple[list[float], NDArray[np.uint8]]:
    """Return 256 ascending levels, and the index of the nearest for each value."""
    flat = values.ravel()
    if not flat.size:
        return [0.0] * N_LEVELS, np.zeros(values.shape, np.uint8)
    distinct = np.unique(flat)
    if len(distinct) <= N_LEVELS:
        book = np.concatenate([distinct, np.full(N_LEVELS - len(distinct), distinct[-1])])
    else:
        counts, edges = np.histogram(flat, N_BINS)
        shares = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
        book = np.interp((np.arange(N_LEVELS) + 0.5) / N_LEVELS * shares[-1], shares, edges)
        for _ in range(N_STEPS):
            nearest = np.searchsorted(0.5 * (book[1:] + book[:-1]), flat)
            n = np.bincount(nearest, minlength=N_LEVELS)
            book = np.where(n > 0, np.bincount(nearest, flat, N_LEVELS) / np.maximum(n, 1), book)
    book = book.astype(np.float32).astype(np.float64)
    indices = np.searchsorted(0.5 * (book[1:] + book[:-1]), values)
    return book.tolist(), indices.astype(np.uint8)


def _palette(sh_rest: Floats, order: Ints) -> tuple[Floats, Ints]:
    """Return at most 65,536 rows [M, 3 (K-1)] that represent harmonics, and the index [N] of the one for each.

    Parameters
    ----------
    sh_rest : ndarray of shape (N, K-1, 3)
    order : ndarray of shape (N,)
        Rows in the order of the file. Of more than :data:`SAMPLES_MAX`, the tree is that of a sample, which is evenly
        spaced in this order and hence in space; all rows then go down the tree to a leaf.
    """
    n, n_columns = len(order), 3 * sh_rest.shape[1]
    samples = sh_rest[order[:: -(-n // SAMPLES_MAX)]].astype(np.float64).reshape(-1, n_columns)
    if n <= PALETTE_MAX:
        return samples, np.arange(n)
    labels, cuts = _halve(samples)
    sums, counts = _sum_leaves(samples, labels)
    if n <= SAMPLES_MAX:
        return sums / counts[:, None], labels
    palette = sums / counts[:, None]  # for leaves that no row gets into
    labels = np.empty(n, np.int64)
    sums[:], counts[:] = 0, 0
    for part in pieces(n, "choosing entries"):
        rows = sh_rest[order[part]].astype(np.float64).reshape(-1, n_columns)
        labels[part] = _go_down(rows, cuts)
        of_part = _sum_leaves(rows, labels[part])
        sums += of_part[0]
        counts += of_part[1]
    is_used = counts > 0
    palette[is_used] = sums[is_used] / counts[is_used, None]
    return palette, labels


class _Cut(NamedTuple):
    """The halving of all nodes of one depth of a tree."""

    columns: Ints
    """[nodes] the coefficient along which each is halved."""
    begins: Floats
    """[nodes] where its upper half begins."""


def _halve(rows: Floats) -> tuple[Ints, list[_Cut]]:
    """Return the leaf [N] of each of more than 65,536 rows [N, D], and the cuts that lead there."""
    n, n_columns = rows.shape
    nodes, n_nodes = np.zeros(n, np.int64), 1
    cuts = []
    for _ in with_progress(range(PALETTE_MAX.bit_length() - 1), "halving", "levels"):
        counts = np.bincount(nodes, minlength=n_nodes)
        variances = np.empty((n_columns, n_nodes))
        for column, values in zip(variances, rows.T, strict=True):
            mean = np.bincount(nodes, values, n_nodes) / counts
            column[:] = np.bincount(nodes, (values - mean[nodes]) ** 2, n_nodes)
        columns = variances.argmax(axis=0)
        along = np.take_along_axis(rows, columns[nodes][:, None], axis=1)[:, 0]  # [N]
        order = np.lexsort((along, nodes))
        begins = np.cumsum(counts) - counts
        ranks = np.arange(n) - begins[nodes[order]]
        is_upper = np.empty(n, np.int64)
        is_upper[order] = 2 * ranks >= counts[nodes[order]]
        cuts.append(_Cut(columns, along[order[begins + (counts + 1) // 2]]))
        nodes, n_nodes = 2 * nodes + is_upper, 2 * n_nodes
    return nodes, cuts


def _go_down(rows: Floats, cuts: list[_Cut]) -> Ints:
    """Return the leaf [N] that each of some rows [N, D] belongs to."""
    nodes = np.zeros(len(rows), np.int64)
    for cut in cuts:
        along = np.take_along_axis(rows, cut.columns[nodes][:, None], axis=1)[:, 0]
        nodes = 2 * nodes + (along >= cut.begins[nodes])
    return nodes


def _sum_leaves(rows: Floats, labels: Ints) -> tuple[Floats, Ints]:
    """Return the sums [65,536, D] of the rows of each leaf, and their numbers [65,536]."""
    counts = np.bincount(labels, minlength=PALETTE_MAX)
    return np.stack([np.bincount(labels, values, PALETTE_MAX) for values in rows.T], axis=1), counts


def decode(content: bytes, source: str | Path) -> Gaussians:
    """Return the Gaussians of a file, float32.

    Raises
    ------
    InputError
        The file is damaged, or no SOG of version 2.
    """
    file = _parse(content, source)
    meta, n = file.meta, file.n
    low, high, quats, scales, sh0 = (
        file.images[name][:n].astype(np.int64) for name in ("means_l", "means_u", "quats", "scales", "sh0")
    )
    mins, maxs = (_numbers(meta["means"], name, 3, source) for name in ("mins", "maxs"))
    with np.errstate(over="ignore", invalid="ignore"):  # of damaged bounds, which are refused at the end
        logs = mins + (maxs - mins) * (low[:, :3] + 256 * high[:, :3]) / 65535.0
        means = np.sign(logs) * np.expm1(np.abs(logs))
    if n and quats[:, 3].min() < MODE:
        raise InputError(f"{source}: damaged, a rotation has the mode {quats[:, 3].min()}; {WAY_OUT}")
    gaussians = Gaussians(
        means=means,
        quats=restore_largest(quats[:, 3] - MODE, quats[:, :3] / 255.0),
        log_scales=_look_up(meta["scales"], scales[:, :3], source),
        opacity_logits=decode_logits(sh0[:, 3].astype(np.uint8)),
        sh_dc=_look_up(meta["sh0"], sh0[:, :3], source),
        sh_rest=_harmonics(file, source),
    )
    return finish(source, gaussians)


def _harmonics(file: _File, source: str | Path) -> Floats:
    """Return the coefficients [N, K-1, 3] of the palette's entries."""
    if "shN" not in file.meta:
        return np.zeros((file.n, 0, 3))
    part = file.meta["shN"]
    n_rest, count = (_bands(part, source) + 1) ** 2 - 1, part.get("count")
    palette = file.images["shN_centroids"][..., :3]
    labels = file.images["shN_labels"][: file.n].astype(np.int64)
    labels = labels[:, 0] + 256 * labels[:, 1]
    height, width = palette.shape[:2]
    if (
        not isinstance(count, int)
        or width != PER_ROW * n_rest
        or labels.max(initial=-1) >= min(count, PER_ROW * height)
    ):
        raise InputError(f"{source}: damaged, a Gaussian has an entry that its palette lacks; {WAY_OUT}")
    entries = palette.reshape(PER_ROW * height, n_rest, 3)[labels]
    return _look_up(part, entries.astype(np.int64), source)


def _bands(part: Mapping[str, Any], source: str | Path) -> int:
    bands = part.get("bands")
    if not isinstance(bands, int) or not 1 <= bands <= SH_DEGREE_MAX:
        raise InputError(f"{source}: damaged, its harmonics are of degree {bands}; {WAY_OUT}")
    return bands


def _look_up(part: Mapping[str, Any], indices: Ints, source: str | Path) -> Floats:
    book = _numbers(part, "codebook", None, source)
    if len(book) <= indices.max(initial=-1):
        raise InputError(f"{source}: damaged, a codebook has {len(book)} levels; {WAY_OUT}")
    return book[indices]


def _numbers(part: Mapping[str, Any], name: str, n: int | None, source: str | Path) -> Floats:
    values = part.get(name)
    if (
        not isinstance(values, list)
        or not all(isinstance(value, int | float) and abs(value) < 1e300 for value in values)
        or (n is not None and len(values) != n)
    ):
        raise InputError(f"{source}: damaged, its {name} are not numbers; {WAY_OUT}")
    return np.array(values, np.float64)


def _parse(content: bytes, source: str | Path) -> _File:
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            if archive.getinfo(META).file_size > META_BYTES_MAX:
                raise InputError(f"{source}: its {META} has more than {META_BYTES_MAX:,} bytes; {WAY_OUT}")
            meta = json.loads(archive.read(META))
            _check_meta(meta, source)
            places = {"means": ("means_l", "means_u"), "quats": ("quats",), "scales": ("scales",), "sh0": ("sh0",)}
            if "shN" in meta:
                places["shN"] = ("shN_centroids", "shN_labels")
            images = {}
            for part, names in places.items():
                for name, file in zip(names, meta[part]["files"], strict=True):
                    if archive.getinfo(file).file_size > len(content):  # images are packed already
                        raise InputError(f"{source}: damaged, {file} is larger than the whole; {WAY_OUT}")
                    images[name] = _pixels(archive.read(file), name, meta, len(content))
    except InputError:
        raise
    except Exception as error:  # zipfile, json and Pillow raise a dozen types of errors for damaged bytes
        raise InputError(f"{source}: not a SOG file, or damaged ({error or type(error).__name__}); {WAY_OUT}") from None
    return _File(meta, meta["count"], images)


def _check_meta(meta: Any, source: str | Path) -> None:
    if not isinstance(meta, dict) or not isinstance(meta.get("count"), int) or meta["count"] < 0:
        raise InputError(f"{source}: damaged, its {META} says no number of Gaussians; {WAY_OUT}")
    if meta.get("version") != VERSION:
        raise InputError(
            f"{source}: SOG of version {meta.get('version')!r}, which is not supported: export it as version {VERSION}"
        )
    for part, n_files in (("means", 2), ("quats", 1), ("scales", 1), ("sh0", 1), ("shN", 2)):
        if part == "shN" and part not in meta:
            continue
        files = meta[part].get("files") if isinstance(meta.get(part), dict) else None
        if not isinstance(files, list) or len(files) != n_files or not all(isinstance(file, str) for file in files):
            raise InputError(f"{source}: damaged, its {META} names no files of {part}; {WAY_OUT}")


def _pixels(data: bytes, name: str, meta: Mapping[str, Any], n_bytes: int) -> NDArray[np.uint8]:
    """Return an image's pixels after a check of its size: [P, 4], or [H, W, 4] of the palette."""
    with Image.open(BytesIO(data), formats=("WEBP", "PNG")) as image:
        width, height = image.size
        if 4 * width * height > min(RATIO_MAX * n_bytes, memory.free_bytes()):
            raise ValueError(f"{name} has {width} x {height} pixels, made of {n_bytes:,} bytes")
        if name != "shN_centroids" and width * height < meta["count"]:
            raise ValueError(f"{name} has {width} x {height} pixels for {meta['count']:,} Gaussians")
        pixels = np.asarray(image.convert("RGBA"))
    return pixels if name == "shN_centroids" else pixels.reshape(-1, 4)


def describe(content: bytes, source: str | Path) -> list[tuple[str, str]]:
    """Return the precision of a file, as pairs of name and text.

    Raises
    ------
    InputError
        The file is refused, as by :func:`decode`.
    """
    meta = _parse(content, source).meta
    mins, maxs = (_numbers(meta["means"], name, 3, source) for name in ("mins", "maxs"))
    with np.errstate(over="ignore", invalid="ignore"):
        relative = 0.5 * (maxs - mins).max() / 65535
    rows = [
        ("SOG version", str(VERSION)),
        ("centres", f"within {relative:.2g} (1 + their distance from the origin) along each axis"),
        ("scales, colours", f"codebooks of {N_LEVELS} levels"),
        ("rotations", f"each component within {0.5 * math.sqrt(2) / 255:.2g}"),
        ("opacities", f"within {0.5 / 255:.2g}"),
    ]
    return [*rows, ("harmonics", f"a palette of {meta['shN'].get('count')} entries")] if "shN" in meta else rows


SOG = Format(
    suffix=".sog",
    summary="PlayCanvas', version 2: images and codebooks",
    levels=("16 and 8 bits",),
    default_level=0,
    encode=encode,
    decode=decode,
    describe=describe,
)
"""The format that SuperSplat publishes."""
