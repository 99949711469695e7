"""``.omg`` of a training, with its codes, codebooks and networks as they were trained, and the command ``omg pack``.

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

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.omg.codes import (
    FARTHEST,
    GAUSSIANS_MAX,
    are_codes,
    are_planes,
    decode_differences,
    encode_differences,
    is_center,
    read_codes,
    read_integers,
    refuse_header,
    round_to_halves,
)
from minisplat_ref.extensions.omg.model import CODEBOOKS, PLACE, SIZES, OmgGaussians, split_codes
from minisplat_ref.extensions.omg.model import decode as decode_model
from minisplat_ref.extensions.omg.recipe import OMG
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
    offsets = round_to_halves(g.means - center.astype(g.means.dtype), "means")
    order = morton_order(offsets)
    integers: dict[str, Any] = {"means": encode_differences(offsets[order])}
    streams, codes = {}, {}
    for name, rows in split_codes(g.codes[order], shared, tuple(CODEBOOKS)).items():
        integers[name], used = _find_used(rows)
        streams[f"{name} codes"] = b"".join(
            round_to_halves(codebook[ids], name).tobytes() for codebook, ids in zip(shared[name], used, strict=True)
        )
        codes[name] = [len(ids) for ids in used]
    planes = {}
    for name, of_rows in integers.items():
        streams[name], planes[name] = to_planes(of_rows)
    weights = np.concatenate([shared[name].ravel() for name in _network_shapes()])
    streams["networks"], _ = to_planes(round_to_halves(weights, "weights").view(np.uint16).astype(np.uint64)[:, None])
    header = {
        "n": len(g.means),
        "center": [float(o + frame.unit * c) for o, c in zip(frame.origin, center, strict=True)],
        "unit": float(frame.unit),
        "inverse_radius": float(shared[PLACE][3]),
        "codes": codes,
        "planes": planes,
    }
    return pack(CONTAINER, header, streams.items())


def _find_used(rows: Ints) -> tuple[Any, list[Ints]]:
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
        found = read_codes(packed, header, name, shape[2])
        rows = [part.astype(np.float32) for part in found.codes]
        shared[name] = np.stack([np.pad(part, ((0, shape[1] - len(part)), (0, 0))) for part in rows])
        columns.append(found.indices.astype(np.float32))
    offsets = decode_differences(read_integers(packed, header, "means", 3)).astype(np.float32)
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
        is_count(n, GAUSSIANS_MAX)
        and is_center(center)
        and _is_length(unit)
        and _is_length(inverse_radius)
        and are_codes(codes, {name: shape[:2] for name, shape in CODEBOOKS.items()})
        and are_planes(planes, CODEBOOKS)
    )
    if not is_right:
        raise refuse_header(packed)
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


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "pack",
        help="write the codes and networks of a run as .omg",
        description="Write the codes and networks of a run of the recipe omg, as they were trained,\n"
        "into one file, which every command reads that reads a PLY. (convert fits codes\n"
        "to the Gaussians of any run.)",
        epilog="example: minisplat-ref omg pack runs/small/checkpoint.npz --out small.omg",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("checkpoint", type=Path, metavar="CHECKPOINT", help="checkpoint.npz in the folder of the run")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="file to write, named .omg")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the file, and print its size.

    Raises
    ------
    InputError
        The checkpoint is none of the recipe omg, or not trained to the end; or the file cannot be written.
    """
    from minisplat_ref.io.formats import write_content

    if args.out.suffix.lower() != ".omg":
        raise InputError(f"{args.out} is not named .omg, by which commands know what it is: give another --out")
    model, frame = read_training(args.checkpoint)
    try:
        content = encode(model, frame)
    except InputError as error:
        raise InputError(f"{args.checkpoint}: {error}") from None
    write_content(args.out, content)
    n = len(model.gaussians.means)
    print(f"{n:,} Gaussians in {args.out}, {len(content):,} bytes, {len(content) / max(n, 1):.1f} each")
    print(*(f"  {name}: {value}" for name, value in describe(content, args.out)), sep="\n")
    return 0


def read_training(path: Path) -> tuple[Model, Frame]:
    """Return the population and the shared parameters of a checkpoint, and their frame.

    Raises
    ------
    InputError
        It is damaged, or of another recipe.
    """
    from minisplat_ref.io.checkpoint import load_checkpoint
    from minisplat_ref.training.saved_state import read_bundles, read_frame, recorded_recipe

    if path.is_dir():
        raise InputError(f"{path} is a folder: give the checkpoint.npz in it")
    arrays, metadata = load_checkpoint(path)
    recipe, _ = recorded_recipe(metadata)
    if recipe != OMG.name:
        raise InputError(f"{path} was trained by recipe {recipe}, which has no codes: train with --recipe {OMG.name}")
    bundles = read_bundles(path, arrays, OmgGaussians)
    return Model(bundles.gaussians, bundles.shared), read_frame(path, metadata)
