"""``.glb``: glTF 2.0 with the extension KHR_gaussian_splatting, which Khronos ratified in 2026; floats, not compressed.

A header, a chunk of JSON and a chunk of bytes. One mesh has a primitive of points with these attributes, of which those
that are not of glTF itself have the extension's name before a colon:

================== ====================================================================================
POSITION           3 x float32
COLOR_0            4 x uint8 in 255ths, colour and opacity, for programs that show points
ROTATION           4 x float32, a unit quaternion xyzw
SCALE              3 x float32, not their logarithms
OPACITY            float32 in [0, 1]
SH_DEGREE_l_COEF_n 3 x float32, RGB
================== ====================================================================================

The frame of glTF is LUF (x left, y up, z forward), that of the PLY RDF: x and y change sign, a rotation by 180 degrees
around z. So do the x and y of a quaternion, and the harmonics that are odd in x and y together, :data:`SIGNS`.

We read what we write, and rotations, scales and opacities in integers as the extension allows them. Left out are files
beside the .glb, nodes that move their mesh, more than one primitive, other kernels and colour spaces, and compression
by further extensions; they are refused.
"""

import json
import math
import struct
from collections.abc import Callable, Mapping
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.errors import InputError
from minisplat_ref.io.formats import GLTF_AXES, Format
from minisplat_ref.io.formats.levels8 import (
    WAY_OUT,
    check_float32,
    check_scales,
    color_bytes,
    finish,
    finite_scales,
    opacities_of,
    opacity_bytes,
    refuse_size,
)
from minisplat_ref.io.packing.pieces import pieces
from minisplat_ref.types import Floats, Gaussians

NAME = "KHR_gaussian_splatting"
COLOR_SPACE = "srgb_rec709_display"
MAGIC, VERSION = b"glTF", 2
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
ARRAY_BUFFER, POINTS = 34962, 0
JSON_MAX = 1 << 20  # bytes
OPACITY_END = 1e-6  # opacities 0 and 1 have no logit, and are read as so far from the end
SCALE_MIN = 1e-10  # world units, as which a scale of 0, which the extension allows, is read
# Under (x, y, z) -> (-x, -y, z), by whether the polynomials are odd in x and y together; the order is that of SPZ's.
SIGNS = np.array([-1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1], np.float32)


class _File(NamedTuple):
    attributes: Mapping[str, Any]
    document: Mapping[str, Any]
    content: bytes | memoryview
    """The chunk of bytes."""


def encode(gaussians: Gaussians, level: int) -> bytes:
    """Return the content of a file; arguments and errors as for :func:`write`."""
    file = BytesIO()
    write(file, gaussians, level)
    return file.getvalue()


def write(file: BinaryIO, gaussians: Gaussians, level: int) -> None:
    """Write the content of a file a piece at a time, as it is as large as the Gaussians; it has one level.

    Raises
    ------
    InputError
        A value is not finite, or a scale is beyond float32; nothing has been written then.
    """
    check_float32(gaussians)
    check_scales(gaussians)
    n, n_rest = gaussians.sh_rest.shape[:2]
    attributes = _attributes(n_rest)
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    begin = 0
    for name, attribute in attributes.items():
        n_bytes = n * attribute.row_bytes
        views.append({"buffer": 0, "byteOffset": begin, "byteLength": n_bytes, "target": ARRAY_BUFFER})
        begin += n_bytes
        accessor: dict[str, Any] = {"bufferView": len(accessors), "componentType": attribute.component, "count": n}
        accessor["type"] = "SCALAR" if attribute.n_columns == 1 else f"VEC{attribute.n_columns}"
        if name == "COLOR_0":
            accessor["normalized"] = True
        if name == "POSITION" and n:
            means = attribute.values(gaussians)
            accessor |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
        accessors.append(accessor)
    splatting = {"kernel": "ellipse", "colorSpace": COLOR_SPACE}
    primitive = {"attributes": {name: i for i, name in enumerate(attributes)}, "mode": POINTS}
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "minisplat_ref"}, "extensionsUsed": [NAME]}
    if n:  # an accessor of glTF has at least one element
        document |= {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
        document |= {"meshes": [{"primitives": [primitive | {"extensions": {NAME: splatting}}]}]}
        document |= {"buffers": [{"byteLength": begin}], "bufferViews": views, "accessors": accessors}
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    n_chunks = CHUNK.size + len(text) + (CHUNK.size + begin if n else 0)
    file.write(HEADER.pack(MAGIC, VERSION, HEADER.size + n_chunks))
    file.write(CHUNK.pack(len(text), b"JSON") + text + (CHUNK.pack(begin, b"BIN\0") if n else b""))
    for name, attribute in attributes.items():
        for part in pieces(n, f"writing {name.removeprefix(f'{NAME}:')}"):
            file.write(attribute.values(Gaussians(*(field[part] for field in gaussians))).data)


class _Attribute(NamedTuple):
    """An array of the file."""

    n_columns: int
    values: Callable[[Gaussians], NDArray]
    """Of Gaussians, [N] or [N, n_columns], C-contiguous."""
    component: int = 5126
    """Of :data:`DTYPES`."""

    @property
    def row_bytes(self) -> int:
        return self.n_columns * np.dtype(DTYPES[self.component]).itemsize


def _attributes(n_rest: int) -> dict[str, _Attribute]:
    """Return the arrays of a file by the names of their attributes, in its order."""

    def rest(gaussians: Gaussians, i: int) -> NDArray:
        return (gaussians.sh_rest[:, i] * SIGNS[i]).astype("<f4")

    return {
        "POSITION": _Attribute(3, lambda g: (g.means * GLTF_AXES).astype("<f4")),
        "COLOR_0": _Attribute(4, _colors, 5121),
        f"{NAME}:ROTATION": _Attribute(4, _rotations),
        f"{NAME}:SCALE": _Attribute(3, finite_scales),
        f"{NAME}:OPACITY": _Attribute(1, _opacities),
        f"{NAME}:SH_DEGREE_0_COEF_0": _Attribute(3, lambda g: g.sh_dc.astype("<f4")),
        **{name: _Attribute(3, partial(rest, i=i)) for i, name in enumerate(_rest_names(n_rest))},
    }


def _colors(gaussians: Gaussians) -> NDArray:
    return np.concatenate([color_bytes(gaussians.sh_dc), opacity_bytes(gaussians.opacity_logits)[:, None]], axis=1)


def _rotations(gaussians: Gaussians) -> NDArray:
    quats = gaussians.quats / np.linalg.norm(gaussians.quats.astype(np.float64), axis=1, keepdims=True)
    return np.roll(quats, -1, axis=1).astype("<f4") * np.array([-1, -1, 1, 1], "<f4")


def _opacities(gaussians: Gaussians) -> NDArray:
    return opacities_of(gaussians.opacity_logits.astype(np.float64)).astype("<f4")


def _rest_names(n_rest: int) -> list[str]:
    degrees = math.isqrt(n_rest + 1)
    return [f"{NAME}:SH_DEGREE_{degree}_COEF_{n}" for degree in range(1, degrees) for n in range(2 * degree + 1)]


def decode(content: bytes, source: str | Path) -> Gaussians:
    """Return the Gaussians of a file, float32, in the world frame of a PLY.

    Raises
    ------
    InputError
        The file is damaged, has no Gaussians, or uses a feature that is left out.
    """
    file = _parse(content, source)
    if not file.attributes:
        return Gaussians(*(np.zeros(shape, np.float32) for shape in ((0, 3), (0, 4), (0, 3), (0,), (0, 3), (0, 0, 3))))
    present = [name for name in file.attributes if name.startswith(f"{NAME}:SH_DEGREE_") and "_0_COEF" not in name]
    names = next(
        (names for d in range(SH_DEGREE_MAX + 1) if set(names := _rest_names((d + 1) ** 2 - 1)) == set(present)), None
    )
    if names is None:
        raise InputError(f"{source}: damaged, its harmonics are not those of degree 0 to {SH_DEGREE_MAX}; {WAY_OUT}")
    means = _read(file, "POSITION", 3, source)
    quats, scales, opacities = (
        _read(file, f"{NAME}:{name}", n, source) for name, n in (("ROTATION", 4), ("SCALE", 3), ("OPACITY", 1))
    )
    sh_dc = _read(file, f"{NAME}:SH_DEGREE_0_COEF_0", 3, source)
    rest = [_read(file, name, 3, source) for name in names]
    n = len(means)
    if {len(array) for array in (quats, scales, opacities, sh_dc, *rest)} != {n}:
        raise InputError(f"{source}: damaged, its attributes have different lengths; {WAY_OUT}")
    bad = np.flatnonzero(~((scales >= 0).all(axis=1) & (opacities[:, 0] >= 0) & (opacities[:, 0] <= 1)))
    if bad.size:
        values = f"the scales {scales[bad[0]].tolist()} and the opacity {opacities[bad[0], 0]:g}"
        raise InputError(f"{source}: row {bad[0]} has {values}; {WAY_OUT}")
    within = np.clip(opacities[:, 0], OPACITY_END, 1.0 - OPACITY_END)
    with np.errstate(invalid="ignore"):
        sh_rest = np.stack(rest, axis=1) * SIGNS[: len(rest), None] if rest else np.zeros((n, 0, 3))
    gaussians = Gaussians(
        means=means * GLTF_AXES,
        quats=np.roll(quats * np.array([-1, -1, 1, 1]), 1, axis=1),
        log_scales=np.log(np.maximum(scales, SCALE_MIN)),
        opacity_logits=np.log(within / (1.0 - within)),
        sh_dc=sh_dc,
        sh_rest=sh_rest,
    )
    return finish(source, gaussians)


def _read(file: _File, name: str, n_columns: int, source: str | Path) -> Floats:
    """Return an attribute [N, n_columns] in float64."""
    document = file.document
    try:
        accessor = document["accessors"][file.attributes[name]]
        view = document["bufferViews"][accessor["bufferView"]]
        dtype, count = np.dtype(DTYPES[accessor["componentType"]]), accessor["count"]
        row = dtype.itemsize * n_columns
        offset, stride = accessor.get("byteOffset", 0), view.get("byteStride", row)
        begin, length = view.get("byteOffset", 0), view["byteLength"]
        sizes = (count, offset, stride, begin, length)
        is_right = all(type(size) is int and size >= 0 for size in sizes) and "sparse" not in accessor
        if not is_right or TYPES[accessor["type"]] != n_columns or view["buffer"] != 0 or stride < row or count == 0:
            raise ValueError("it is of a kind that is not read")
        if offset + (count - 1) * stride + row > length or begin + length > len(file.content):
            raise ValueError("it ends behind its bytes")
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        raise InputError(f"{source}: damaged, its attribute {name} cannot be read ({error}); {WAY_OUT}") from None
    raw = np.frombuffer(file.content, np.uint8, (count - 1) * stride + row, begin + offset)
    rows = np.lib.stride_tricks.as_strided(raw, (count, row), (stride, 1))
    values = np.ascontiguousarray(rows).view(dtype).astype(np.float64)
    if dtype.kind != "f" and accessor.get("normalized"):
        values = np.maximum(values / np.iinfo(dtype).max, -1.0)
    return values


def _parse(content: bytes | memoryview, source: str | Path) -> _File:
    refuse_size(source, HEADER.size + CHUNK.size, len(content))
    magic, version, length = HEADER.unpack_from(content)
    if magic != MAGIC or version != VERSION:
        raise InputError(f"{source}: not a .glb of version {VERSION}; {WAY_OUT}")
    refuse_size(source, length, len(content))
    n_text, kind = CHUNK.unpack_from(content, HEADER.size)
    begin = HEADER.size + CHUNK.size
    if kind != b"JSON" or n_text > min(JSON_MAX, len(content) - begin):
        raise InputError(f"{source}: damaged, its JSON has {n_text:,} bytes; {WAY_OUT}")
    body = content[:0]
    if begin + n_text + CHUNK.size <= len(content):
        n_body, _ = CHUNK.unpack_from(content, begin + n_text)
        refuse_size(source, begin + n_text + CHUNK.size + n_body, len(content))
        body = content[begin + n_text + CHUNK.size :][:n_body]
    try:
        document = json.loads(bytes(content[begin : begin + n_text]))
        found = [
            p for mesh in document.get("meshes", []) for p in mesh["primitives"] if NAME in p.get("extensions", {})
        ]
        moved = [node for node in document.get("nodes", []) if {*node} & {"matrix", "rotation", "translation", "scale"}]
        is_empty = not document.get("meshes") and NAME in document.get("extensionsUsed", [])
        splatting = found[0]["extensions"][NAME] if found else {"kernel": "ellipse", "colorSpace": COLOR_SPACE}
        attributes = dict(found[0]["attributes"]) if found else {}
        kernel, space, further = (splatting.get(key) for key in ("kernel", "colorSpace", "extensions"))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{source}: damaged, its JSON cannot be read ({type(error).__name__}); {WAY_OUT}") from None
    if len(found) != 1 and not is_empty:
        raise InputError(f"{source}: {len(found)} primitives of {NAME}, one is read: export Gaussians alone")
    if kernel != "ellipse" or space != COLOR_SPACE or further or moved:
        raise InputError(
            f"{source}: kernel {kernel}, colour space {space}{', compressed' if further else ''}"
            f"{', on a moved node' if moved else ''}: read is ellipse, {COLOR_SPACE}, plain and not moved"
        )
    return _File(attributes, document, body)


def describe(content: bytes | memoryview, source: str | Path) -> list[tuple[str, str]]:
    """Return a description of a file, as pairs of name and text.

    Raises
    ------
    InputError
        The file is refused, as by :func:`decode`.
    """
    _parse(content, source)
    return [("glTF extension", NAME), ("values", "float32, as far as the file has no integers")]


GLB = Format(
    suffix=".glb",
    summary="glTF with KHR_gaussian_splatting",
    levels=("float32",),
    default_level=0,
    encode=encode,
    write=write,
    decode=decode,
    describe=describe,
)
"""The format that Khronos has ratified."""
