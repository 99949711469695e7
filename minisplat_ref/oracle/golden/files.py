"""A folder of golden vectors: written completely or not at all, and checked when it is read."""

import hashlib
import json
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.json_file import read_json
from minisplat_ref.io.names import file_names, is_file
from minisplat_ref.io.npz import read_npz as read_arrays
from minisplat_ref.oracle.golden.format import (
    DIFFERENTIATED,
    FRAMES,
    SPECS,
    STAGE_COTANGENTS,
    STAGE_INPUTS,
    Arrays,
    Golden,
    convention_words,
    names_of,
    readme,
)
from minisplat_ref.types import Ints

FORMAT = "minisplat_ref golden vectors"
VERSION = 2  # changes when an older folder can no longer be read
MANIFEST, README = "manifest.json", "README.md"
AGAIN = "write it again with: minisplat-ref oracle export DIR"


def export(path: str | Path, scenes: Mapping[str, Golden]) -> None:
    """Write scenes: one folder each, one .npz for each stage; a manifest and a README beside them.

    Parameters
    ----------
    path : str or Path
        Folder to make; may exist if it is empty.
    scenes : mapping of str to Golden
        With all arrays.

    Raises
    ------
    InputError
        If the folder is not empty or cannot be made.
    """
    with making_folder(path) as folder:
        listed = {name: _write_scene(folder, scene) for name, scene in scenes.items()}
        text = json.dumps(_manifest(listed), indent=1, allow_nan=False)
        (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")
        (folder / README).write_text(readme(scenes), encoding="utf-8")


def load(path: str | Path) -> dict[str, Golden]:
    """Read the files of :func:`export`, and check them: format, version, hashes, names, shapes, dtypes.

    Parameters
    ----------
    path : str or Path
        The folder.

    Returns
    -------
    dict
        Scenes by name.

    Raises
    ------
    InputError
        If anything is missing, damaged or of another version; the message of one line names it.
    """
    folder = Path(path)
    manifest = read_manifest(folder)
    if manifest is None:
        raise InputError(f"{folder / MANIFEST} does not exist: give a folder of minisplat-ref oracle export")
    try:
        return {name: _read_scene(folder, name, entry) for name, entry in manifest["scenes"].items()}
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{folder / MANIFEST} lacks {error}; {AGAIN}") from error


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the manifest of a folder, None if there is none.

    Raises
    ------
    InputError
        If it is no manifest, has another version, or a file that it lists is missing or was changed.
    """
    path = folder / MANIFEST
    if not path.exists():
        return None
    manifest = read_json(path, AGAIN)
    try:
        found = manifest["format"], manifest["version"]
        listed = [
            (scene, file, about)
            for scene, entry in manifest["scenes"].items()
            for file, about in entry["files"].items()
        ]
        hashes = [str(about["sha256"]) for *_, about in listed]
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is not a manifest of golden vectors ({error}); {AGAIN}") from error
    if found != (FORMAT, VERSION):
        raise InputError(f"{path} is {found[0]!r} version {found[1]}, this reads {FORMAT!r} version {VERSION}; {AGAIN}")
    for (scene, file, _), sha256 in zip(listed, hashes, strict=True):
        if [scene, file] != file_names([scene, file]):
            raise InputError(f"{path} lists '{scene}/{file}', which is no name of a file below it; {AGAIN}")
        if not is_file(folder / scene / file):
            raise InputError(f"{folder / scene / file} is missing, though {MANIFEST} lists it; {AGAIN}")
        if _sha256(folder / scene / file) != sha256:
            raise InputError(
                f"{folder / scene / file} is not the file that {MANIFEST} lists (SHA-256 differs); {AGAIN}"
            )
    return manifest


def read_npz(path: Path) -> Arrays:
    """Return the arrays of a file.

    Raises
    ------
    InputError
        If it cannot be read, or holds anything but arrays of numbers.
    """
    arrays = read_arrays(path, "write it again")
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise InputError(f"{path}: {name} has dtype {array.dtype}; only floating point and integers are read")
    return arrays


def _write_scene(folder: Path, scene: Golden) -> dict[str, Any]:
    """Write the files of a scene and return their entry of the manifest."""
    (folder / scene.name).mkdir()
    files = {}
    for stage in dict.fromkeys(spec.stage for spec in SPECS.values()):
        names = names_of(stage, "input", "output", "cotangent", "gradient")
        arrays = {name: np.ascontiguousarray(scene.arrays[name]).reshape(scene.arrays[name].shape) for name in names}
        path = folder / scene.name / f"{stage}.npz"
        np.savez(path, allow_pickle=False, **arrays)
        shapes = {name: {"shape": list(array.shape), "dtype": str(array.dtype)} for name, array in arrays.items()}
        files[path.name] = {"sha256": _sha256(path), "arrays": shapes}
    return {
        "what": scene.what,
        "is_exact": scene.is_exact,
        "sh_degree": scene.sh_degree,
        "conventions": scene.conventions._asdict(),
        "files": files,
    }


def _manifest(listed: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "loss": f"{DIFFERENTIATED}; v_x = dL/dx, of the shape of x",
        "frames": FRAMES,
        "conventions": convention_words(),
        "arrays": {
            spec.name: {
                "file": f"{spec.stage}.npz",
                "role": spec.role,
                "shape": list(spec.shape),
                "dtype": spec.kind,
                "unit": spec.unit,
                "meaning": spec.meaning,
                "tolerance": {
                    "relative_to": "largest magnitude in the array",
                    "float64": spec.tolerance.float64,
                    "float32": spec.tolerance.float32,
                    "reason": spec.tolerance.reason,
                },
            }
            for spec in SPECS.values()
        },
        "stages": {
            stage: {
                "inputs": list(STAGE_INPUTS[stage]),
                "outputs": list(names_of(stage, "output")),
                "cotangents": list(STAGE_COTANGENTS[stage]),
                "gradients": list(names_of(stage, "gradient")),
            }
            for stage in STAGE_INPUTS
        },
        "scenes": dict(listed),
    }


def _read_scene(folder: Path, name: str, entry: Mapping[str, Any]) -> Golden:
    arrays: Arrays = {}
    for file, about in entry["files"].items():
        found = read_npz(folder / name / file)
        for key, array in found.items():
            promised = about["arrays"].get(key)
            if promised != {"shape": list(array.shape), "dtype": str(array.dtype)}:
                raise InputError(
                    f"{folder / name / file}: {key} is {array.dtype}{list(array.shape)}, not as in {MANIFEST}"
                )
        arrays |= found
    missing = [key for key in SPECS if key not in arrays]
    if missing:
        raise InputError(f"{folder / name} lacks {', '.join(missing)}; {AGAIN}")
    _check_arrays(folder / name, arrays, AGAIN)
    conventions = _conventions(folder, name, entry["conventions"])
    return Golden(name, str(entry["what"]), conventions, arrays, is_exact=entry["is_exact"] is True)


def _conventions(folder: Path, name: str, values: Mapping[str, Any]) -> Conventions:
    """Return the conventions of a scene, each value of the type that the profiles have."""
    conventions = Conventions(**values)
    for field, value, usual in zip(Conventions._fields, conventions, GSPLAT_MAIN, strict=True):
        is_number = isinstance(usual, float) and isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number and type(value) is not type(usual):
            raise InputError(f"{folder / MANIFEST}: {field} of {name} is {reprlib.repr(value)}; {AGAIN}")
    return conventions


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _check_arrays(source: Path, arrays: Arrays, way_out: str) -> None:
    """Refuse a scene whose shapes, types or indices contradict the format: kernels would index past their ends.

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
