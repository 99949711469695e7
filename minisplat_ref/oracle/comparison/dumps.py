"""A folder of arrays that some other renderer has written, in the golden format."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.oracle.comparison.renderers import Renderer
from minisplat_ref.oracle.golden.arrays import SPECS, Arrays
from minisplat_ref.oracle.golden.files import read_manifest, read_npz
from minisplat_ref.oracle.golden.scenes import Golden


def from_dumps(path: str | Path, dtype: str | None = None) -> Renderer:
    """Compare what is in ``path/SCENE/*.npz``.

    Parameters
    ----------
    path : str or Path
        Folder with a folder for each scene. A manifest is not needed; where there is one, its hashes are checked.
    dtype : str, optional
        What the renderer computed in, if it wrote another dtype than that.

    Raises
    ------
    InputError
        If there is no scene, or a manifest that does not fit.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give a renderer's name, or the folder of its arrays")
    read_manifest(folder)
    scenes = tuple(sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and any(entry.glob("*.npz"))))
    if not scenes:
        raise InputError(f"{folder} holds no SCENE/*.npz; minisplat-ref oracle export DIR shows the format")
    return Renderer(str(folder), dtype, False, lambda truth: _read(folder / truth.name, truth), scenes=scenes)


def _read(folder: Path, truth: Golden) -> Arrays:
    """Arrays of a scene that the truth has, too; the input among them must be the truth's."""
    arrays: Arrays = {}
    for file in sorted(folder.glob("*.npz")):
        for name, array in read_npz(file).items():
            if name not in SPECS:
                raise InputError(f"{file}: {name!r} is no array of the golden format; its README.md lists the names")
            if name in arrays:
                raise InputError(f"{file}: {name} was already in another file of {folder}; write it once")
            _check_kind(file, name, array)
            arrays[name] = array
    for name, array in arrays.items():
        if SPECS[name].role in ("input", "cotangent") and name != "tile_size":
            expected = truth.arrays[name].astype(np.float32)  # what float32 kept of it
            if not np.array_equal(array.astype(np.float32), expected):
                raise InputError(
                    f"{folder}: its {name} is not that of the golden scene {truth.name!r}; render the scene that"
                    " minisplat-ref oracle export writes, or give that folder with --against"
                )
    return arrays


def _check_kind(file: Path, name: str, array: NDArray[Any]) -> None:
    is_integer, is_float = array.dtype.kind in "iu", array.dtype in (np.float32, np.float64)
    if not (is_float if SPECS[name].kind == "float64" else is_integer):
        allowed = "float32 or float64" if SPECS[name].kind == "float64" else "integers"
        raise InputError(f"{file}: {name} has dtype {array.dtype}; write {allowed}")
