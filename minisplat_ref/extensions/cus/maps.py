"""Feature maps of photographs: given as files, or of the classical bank.

A folder has one file for each photograph, ``NAME.npy`` or ``NAME.npz`` with one array [h, w, D], of whatever bank or
network; h and w may be smaller than the photograph's. Nothing is downloaded.

Without a folder the map is that of :data:`~minisplat_ref.mechanisms.features.filters.CLASSICAL`: at each of its three
scales the mean colours and the energies in four directions, and one constant, 22 numbers for each pixel. Signed
responses are left out, since they change with the place of a stripe. These features describe colours and textures, not
objects.
"""

from collections.abc import Mapping
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.io.npz import read_npz
from minisplat_ref.mechanisms.features.filters import CLASSICAL, CONSTANT, ENERGY
from minisplat_ref.types import Floats, Ints, View

COLORS = slice(0, 3)  # channels of the bank
GRIDS = ((3, 2), (8, 2), (18, 4))  # pixel of the first response and pixels between two, at each scale
MARGIN = 18  # pixels by which photographs are continued at their borders, so that all have responses
N_SAMPLES = 2_048  # features of a photograph that the memory is made of
N_KEPT = 64  # maps that stay in memory


def feature_map(view: View, folder: str) -> Floats:
    """Return the map [h, w, D] of a photograph, float32.

    Parameters
    ----------
    view : View
    folder : str
        Of maps; empty for the classical one.

    Raises
    ------
    InputError
        A file is missing, is no map, or has a number that is not finite.
    """
    if folder:
        return _read_map(Path(folder), view.name)
    return _classical(_Photograph(view.load().image))


def sample_rows(features: Floats, rng: np.random.Generator) -> Floats:
    """Return at most ``N_SAMPLES`` features [R, D] of a map, drawn at random."""
    rows = features.reshape(-1, features.shape[2])
    return rows[rng.permutation(len(rows))[:N_SAMPLES]]


def at_pixels(features: Floats, pixels: Ints, height: int, width: int) -> Floats:
    """Return the features [B, D] of the cells of a map in which pixels [B, 2], rows and columns, have their centres."""
    h, w = features.shape[:2]
    return features[(2 * pixels[:, 0] + 1) * h // (2 * height), (2 * pixels[:, 1] + 1) * w // (2 * width)]


def check_depths(n_channels: Mapping[str, int], folder: str) -> None:
    """Refuse maps of photographs, by name, that do not have the same number of channels.

    Raises
    ------
    InputError
        Names the first that differs from the first of all.
    """
    (first, expected), *others = n_channels.items()
    for name, n in others:
        if n != expected:
            raise InputError(
                f"features={folder}: the map of photograph {name} has {n} channels, that of {first} {expected}; make"
                " all with one bank"
            )


class _Photograph:
    """An image, equal to another of the same pixels, as the key of a cache."""

    def __init__(self, image: NDArray[np.uint8]) -> None:
        self.image = image
        self.digest = (image.shape, blake2b(image.tobytes()).digest())

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Photograph) and self.digest == other.digest


@lru_cache(maxsize=N_KEPT)
def _classical(photograph: _Photograph) -> Floats:
    image = photograph.image
    height, width = image.shape[:2]
    margins = (MARGIN, MARGIN + 3)  # the coarsest grid ends up to three pixels early
    padded = np.pad(image / np.float32(255), (margins, margins, (0, 0)), mode="edge").astype(np.float32)
    maps, _ = CLASSICAL.features(padded)
    parts = [
        _resized(np.concatenate([map_[..., COLORS], map_[..., ENERGY]], axis=2), grid, height, width)
        for map_, grid in zip(maps, GRIDS, strict=True)
    ]
    return np.concatenate([*parts, np.full((height, width, 1), CONSTANT, np.float32)], axis=2)


def _resized(map_: Floats, grid: tuple[int, int], height: int, width: int) -> Floats:
    """Return a map at all pixels of the photograph, linear between responses."""
    first, step = grid
    for axis, n in ((0, height), (1, width)):
        places = np.clip((np.arange(n) + MARGIN - first) / step, 0, map_.shape[axis] - 1)
        below = np.minimum(places.astype(np.int64), max(map_.shape[axis] - 2, 0))
        above = np.minimum(below + 1, map_.shape[axis] - 1)
        share = (places - below).astype(np.float32).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        map_ = (1 - share) * np.take(map_, below, axis) + share * np.take(map_, above, axis)
    return map_.astype(np.float32)


@lru_cache(maxsize=N_KEPT)
def _read_map(folder: Path, name: str) -> Floats:
    npy, npz = folder / f"{name}.npy", folder / f"{name}.npz"
    path = npz if npz.exists() and not npy.exists() else npy
    way_out = f"give every photograph NAME.npy or NAME.npz, an array [h, w, D], in features={folder}"
    if path is npz:
        arrays = list(read_npz(path, way_out).values())
        if len(arrays) != 1:
            raise InputError(f"{path} holds {len(arrays)} arrays: {way_out}")
        (array,) = arrays
    else:
        try:
            array = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"{path} cannot be read as an array: {way_out}") from error
    if not isinstance(array, np.ndarray) or array.ndim != 3 or 0 in array.shape or array.dtype.kind not in "fiu":
        found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else "several arrays"
        raise InputError(f"{path} is {found}: {way_out}")
    if not np.isfinite(array).all():
        raise InputError(f"{path} has features that are not finite: make the map again without them")
    return array.astype(np.float32)
