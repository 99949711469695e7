"""Check that the arrays of a golden scene are consistent: otherwise kernels would index past their ends."""

from pathlib import Path

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.oracle.golden.format import SPECS, Arrays
from minisplat_ref.types import Ints


def check_arrays(source: Path, arrays: Arrays, way_out: str) -> None:
    """Refuse a scene whose shapes, types or indices contradict the format.

    Parameters
    ----------
    source : Path
        Folder of the scene, which messages begin with.
    arrays : dict of str to ndarray
        All arrays of the format.
    way_out : str
        What to do about it, for the end of the message.

    Raises
    ------
    InputError
        One line that names the array.
    """
    sizes: dict[str | int, int] = {}
    for name, spec in SPECS.items():
        array = arrays[name]
        expected = [
            size if isinstance(size, int) else sizes.setdefault(size, actual)
            for size, actual in zip(spec.shape, array.shape, strict=False)
        ]
        if list(array.shape) != expected or len(spec.shape) != array.ndim:
            letters = ", ".join(map(str, spec.shape))
            raise InputError(f"{source}: {name} has shape {list(array.shape)}, not [{letters}]; {way_out}")
        if (array.dtype.kind == "f") != spec.kind.startswith("float"):
            raise InputError(f"{source}: {name} has dtype {array.dtype}, not {spec.kind}; {way_out}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError(f"{source}: {name} holds NaN or infinity; {way_out}")
    width, height = map(int, arrays["image_size"])
    tile_width, tile_height = map(int, arrays["tile_size"])
    ids, offsets, boxes = (arrays[name].astype(np.int64) for name in ("gaussian_ids", "tile_offsets", "boxes"))
    fits = {
        "image_size": (sizes["W"], sizes["H"]) == (width, height),
        "tile_size": min(tile_width, tile_height) > 0,
        "gaussian_ids": _are_rows(ids, 0, sizes["N"]),
        "tile_offsets": offsets[:1].tolist() == [0] and offsets[-1] == len(ids) and (np.diff(offsets) >= 0).all(),
        "adam_rows": _are_rows(arrays["adam_rows"], 0, sizes["A"]),
        "surface_ids": _are_rows(arrays["surface_ids"], -1, sizes["N"]),
        "boxes": not boxes.size or (boxes.min() >= 0 and (boxes <= [width, height, width, height]).all()),
    }
    wrong = [name for name, is_right in fits.items() if not is_right]
    n_tiles = -(-width // tile_width) * -(-height // tile_height) if not wrong else 0
    if not wrong and len(offsets) != n_tiles + 1:
        wrong = ["tile_offsets"]
    if wrong:
        raise InputError(f"{source}: {', '.join(wrong)} do not fit the other arrays; {way_out}")


def _are_rows(ids: Ints, lowest: int, n: int) -> bool:
    """Return whether ids lie in [lowest, n)."""
    return not ids.size or bool(ids.min() >= lowest and ids.max() < n)
