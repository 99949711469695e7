"""``.omg`` of a training: its codes, codebooks and networks, as they were trained.

The other ``.omg`` (:mod:`.file`) is fitted to any Gaussians; both are read in the same way. Streams:

===============  ==========================================================================
means            half floats of the offset from the scene's centre, as differences
NAME             indices [N, P] into the codebooks of ``scale_codes`` and the other two
NAME codes       the codes that are in use, half floats
networks         weights and biases of all networks, one after the other, half floats
===============  ==========================================================================

Codebooks and weights are rounded to half floats; the rest is as it was trained. Opacity, colour and harmonics are
products of matrices, so their last digits depend on the machine.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.omg import parts
from minisplat_ref.extensions.omg.centers import FARTHEST, from_differences, to_differences, to_halves
from minisplat_ref.extensions.omg.decoding import split_codes
from minisplat_ref.extensions.omg.population import CODEBOOKS, PLACE, SIZES, OmgGaussians
from minisplat_ref.extensions.omg.renderer import decode as decode_model
from minisplat_ref.io.packing.container import Container, Packed, is_count, pack, parse, unpack
from minisplat_ref.io.packing.morton import morton_order
from minisplat_ref.io.packing.planes import from_planes, to_planes
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY
from minisplat_ref.types import Floats, Frame, Gaussians, Ints, Model
from minisplat_ref.validation import check_gaussians

CONTAINER = Container(b"OMT\n", version=1)
N_REST = 15  # coefficients of degrees 1 to 3
N_PARTS = sum(shape[0] for shape in CODEBOOKS.values())


def encode(model: Model, frame: Frame) -> bytes:
    """Return the content of a file.

    Parameters
    ----------
    model : Model
        Of a run, with features and codes.
    frame : Frame
        Of the run; the file is in that of the scene's files.

    Raises
    ------
    InputError
        It has no codes, a value is beyond half floats, or zstandard is missing.
    """
    g, shared = model.gaussians, model.shared
    if g.codes.shape[1] != N_PARTS:
        raise InputError("the run has no codes for its features, which its last iterations make: train it to its end")
    center = shared[PLACE][:3]
    offsets = to_halves(g.means - center.astype(g.means.dtype), "means")
    order = morton_order(offsets)
    integers: dict[str, Any] = {"means": to_differences(offsets[order])}
    streams, codes = {}, {}
    for name, rows in split_codes(g.codes[order], shared, tuple(CODEBOOKS)).items():
        integers[name], used = _in_use(rows)
        streams[f"{name} codes"] = b"".join(
            to_halves(codebook[ids], name).tobytes() for codebook, ids in zip(shared[name], used, strict=True)
        )
        codes[name] = [len(ids) for ids in used]
    planes = {}
    for name, of_rows in integers.items():
        streams[name], planes[name] = to_planes(of_rows)
    weights = np.concatenate([shared[name].ravel() for name in _network_shapes()])
    streams["networks"], _ = to_planes(to_halves(weights, "weights").view(np.uint16).astype(np.uint64)[:, None])
    header = {
        "n": len(g.means),
        "center": [float(o + frame.unit * c) for o, c in zip(frame.origin, center, strict=True)],
        "unit": float(frame.unit),
        "inverse_radius": float(shared[PLACE][3]),
        "codes": codes,
        "planes": planes,
    }
    return pack(CONTAINER, header, streams)


def _in_use(rows: Ints) -> tuple[Any, list[Ints]]:
    """Return indices [N, P] among the codes that are in use, and the rows of these by part."""
    pairs = [np.unique(of_part, return_inverse=True) for of_part in rows.T]
    return np.stack([inverse for _, inverse in pairs], axis=1).astype(np.uint64), [used for used, _ in pairs]


def _network_shapes() -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of all networks by their shared names, in the order of a file."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, sizes in SIZES.items():
        for k in range(len(sizes) - 1):
            shapes |= {f"{name}_weights_{k}": sizes[k : k + 2], f"{name}_biases_{k}": sizes[k + 1 : k + 2]}
    return shapes


def decode(content: bytes, source: str | Path) -> Gaussians:
    """Return the Gaussians of a file, float32.

    Raises
    ------
    InputError
        The file is damaged, or of another kind or version.
    """
    packed = parse(CONTAINER, content, source)
    header = _check_header(packed)
    n = header.n
    shared = _networks(packed)
    columns = []
    for name, shape in CODEBOOKS.items():
        found = parts.read_codes(packed, header, name, shape[2])
        rows = [part.astype(np.float32) for part in found.codes]
        shared[name] = np.stack([np.pad(part, ((0, shape[1] - len(part)), (0, 0))) for part in rows])
        columns.append(found.indices.astype(np.float32))
    offsets = from_differences(parts.read_integers(packed, header, "means", 3)).astype(np.float32)
    shared[PLACE] = np.array([0, 0, 0, header.inverse_radius])
    # of damaged files; values that are not finite are refused
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        coded = OmgGaussians(
            means=offsets,
            quats=np.zeros((n, 4), np.float32),
            log_scales=np.zeros((n, 3), np.float32),
            opacity_logits=np.zeros(n, np.float32),
            sh_dc=np.zeros((n, 3), np.float32),
            sh_rest=np.zeros((n, N_REST, 3), np.float32),
            features=np.zeros((n, 6), np.float32),
            codes=np.concatenate(columns, axis=1),
        )
        decoded, _ = decode_model(Model(coded, shared), IN_NUMPY)
        gaussians = Gaussians(*decoded[: len(Gaussians._fields)])._replace(
            means=np.asarray(header.center, np.float32) + np.float32(header.unit) * offsets,
            log_scales=decoded.log_scales + np.float32(math.log(header.unit)),
        )
    check_gaussians(gaussians, source)
    return gaussians


def _networks(packed: Packed) -> dict[str, Floats]:
    """Return the arrays of the networks by their shared names, float32."""
    shapes = _network_shapes()
    sizes = [math.prod(shape) for shape in shapes.values()]
    bits = from_planes(unpack(packed, "networks", 2 * sum(sizes)), 2, 1, sum(sizes))[:, 0].astype(np.uint16)
    arrays = np.split(bits.view(np.float16).astype(np.float32), np.cumsum(sizes)[:-1])
    return {name: array.reshape(shape) for (name, shape), array in zip(shapes.items(), arrays, strict=True)}


class _Header(NamedTuple):
    """The checked content of a header."""

    n: int
    center: tuple[float, ...]
    unit: float
    inverse_radius: float
    codes: Mapping[str, list[int]]
    planes: Mapping[str, int]


def _is_length(value: Any) -> bool:
    return type(value) is float and 1 / FARTHEST <= value <= FARTHEST


def _check_header(packed: Packed) -> _Header:
    """Return the header after checking every value that is read."""
    values = {name: packed.header.get(name) for name in _Header._fields}
    n, center, unit, inverse_radius, codes, planes = values.values()
    is_right = (
        is_count(n, parts.GAUSSIANS_MAX)
        and parts.is_center(center)
        and _is_length(unit)
        and _is_length(inverse_radius)
        and parts.are_codes(codes, {name: shape[:2] for name, shape in CODEBOOKS.items()})
        and parts.are_planes(planes, CODEBOOKS)
    )
    if not is_right:
        raise parts.no_gaussians(packed)
    return _Header(**values)  # type: ignore[arg-type]


def describe(content: bytes, source: str | Path) -> list[tuple[str, str]]:
    """Return the content of a file, as pairs of name and text.

    Raises
    ------
    InputError
        The header is refused, as by :func:`decode`.
    """
    header = _check_header(parse(CONTAINER, content, source))
    rows = [("trained", "codes, codebooks and networks of a run of the recipe omg")]
    rows += [(name.replace("_", " "), ", ".join(map(str, counts))) for name, counts in header.codes.items()]
    sizes = sum(math.prod(shape) for shape in _network_shapes().values())
    return [*rows, ("networks", f"{sizes:,} weights as half floats")]
