"""Feature maps of photographs, and the memory of their features with its readout by a pixel.

A folder has one map for each photograph, ``NAME.npy`` or ``NAME.npz`` with one array [h, w, D], of whatever bank or
network; h and w may be smaller than the photograph's. Nothing is downloaded. Without a folder the map is that of
:data:`~minisplat_ref.mechanisms.features.filters.CLASSICAL`: at each of its three scales the mean colours and the
energies in four directions, and one constant, 22 numbers for each pixel. Signed responses are left out, since they
change with the place of a stripe. These features describe colours and textures, not objects.

The memory M [K, D] keeps a feature r of the photographs, one after the other, if it is like none that is kept::

    max_k (r . m_k) / (|r| |m_k|) < gamma

A blended query q [d] reads it by attention, and an adapter W [D, D] maps the result::

    a = softmax(q (M P)^T / sqrt(d)),   f = (a M) W

P [D, d] makes keys as wide as queries. Where D is d and P the identity, this is ``softmax(q M^T / sqrt(d))`` as in the
paper.
"""

from collections.abc import Iterable, Mapping
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

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
ROWS_MAX = 512  # of the memory
RANK_MIN = 1e-3  # of the largest singular value: smaller ones count as 0
CHUNK = 1_024  # features that are compared with the memory at once
LENGTH_MIN = 1e-3  # of a feature, where the cosine would have no derivative


# --- maps ---


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


# --- the memory ---


def remember(features: Iterable[Floats], similarity: float) -> Floats:
    """Return the memory M [K, D] of features, scanned in their order; at most ``ROWS_MAX`` are kept.

    Parameters
    ----------
    features : iterable of ndarray of shape (R, D)
    similarity : float
        gamma.

    Returns
    -------
    memory : ndarray of shape (K, D)
        float64; the first feature, which may be zero, is always in it.
    """
    kept: list[Floats] = []
    directions: list[Floats] = []
    for rows in features:
        rows = rows.astype(np.float64)
        units = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
        for begin in range(0, len(rows), CHUNK):
            part = units[begin : begin + CHUNK]
            n_before = len(directions)
            cosines = part @ np.array(directions).T if directions else np.full((len(part), 1), -np.inf)
            for i in np.flatnonzero(cosines.max(axis=1) < similarity):
                newer = directions[n_before:]
                if len(kept) < ROWS_MAX and (not newer or (np.array(newer) @ part[i]).max() < similarity):
                    kept.append(rows[begin + i])
                    directions.append(part[i])
    return np.array(kept)


def first_keys(memory: Floats, n: int) -> Floats:
    """Return P [D, n]: the memory's n first principal axes, scaled so that keys have a mean square of 1 along each.

    There are zeros for axes beyond D, and for those in which the memory has nothing.
    """
    _, sizes, axes = np.linalg.svd(memory / np.sqrt(len(memory)), full_matrices=False)
    is_there = sizes > RANK_MIN * sizes.max(initial=0.0)
    axes = axes[is_there][:n] / sizes[is_there][:n, None]
    keys: Floats = np.pad(axes, ((0, n - len(axes)), (0, 0))).T
    return keys


class Reading(NamedTuple):
    """The values that :func:`read` keeps for its gradient."""

    queries: Floats
    memory: Floats
    keys: Floats
    adapter: Floats
    attention: Floats
    """[B, K] a."""


def read(queries: Floats, memory: Floats, keys: Floats, adapter: Floats) -> tuple[Floats, Reading]:
    """Return the features f [B, D] of queries.

    Parameters
    ----------
    queries : ndarray of shape (B, d)
    memory : ndarray of shape (K, D)
    keys : ndarray of shape (D, d)
        P.
    adapter : ndarray of shape (D, D)
        W.
    """
    scores = queries @ (memory @ keys).T / queries.dtype.type(np.sqrt(queries.shape[1]))
    weights = np.exp(scores - scores.max(axis=1, keepdims=True))
    attention = weights / weights.sum(axis=1, keepdims=True)
    return attention @ memory @ adapter, Reading(queries, memory, keys, adapter, attention)


def read_vjp(reading: Reading, v_f: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Gradient of :func:`read` with respect to queries, memory, P and W.

    ::

        v_W = (a M)^T v_f,        v_o = v_f W^T              (o = a M)
        v_a = v_o M^T,            v_s = a (v_a - sum_k a_k v_a_k)
        v_q = v_s M P / sqrt(d),  v_(MP) = v_s^T q / sqrt(d)
        v_M = a^T v_o + v_(MP) P^T,   v_P = M^T v_(MP)
    """
    q, memory, keys, adapter, a = reading
    root = q.dtype.type(np.sqrt(q.shape[1]))
    v_o = v_f @ adapter.T
    v_a = v_o @ memory.T
    v_s = a * (v_a - np.sum(a * v_a, axis=1, keepdims=True))
    v_projected = v_s.T @ q / root  # [K, d]
    v_memory = a.T @ v_o + v_projected @ keys.T
    return v_s @ (memory @ keys) / root, v_memory, memory.T @ v_projected, (a @ memory).T @ v_f


def feature_error(found: Floats, target: Floats) -> tuple[float, Floats]:
    """Return ``mean_p mean_c (f - t)^2 + mean_p (1 - cos(f, t))`` of features [B, D], and its derivative v_f.

    ::

        cos = f . t / (n(f) n(t)),  n(x) = sqrt(x . x + eps^2)
        v_f = 2 (f - t) / (B D) - (t / (n(f) n(t)) - cos f / n(f)^2) / B
    """
    n, eps = len(found), found.dtype.type(LENGTH_MIN)
    of_found, of_target = (np.sqrt(np.sum(x * x, axis=1, keepdims=True) + eps**2) for x in (found, target))
    cosines = np.sum(found * target, axis=1, keepdims=True) / (of_found * of_target)
    difference = found - target
    v = 2 * difference / difference.size - (target / (of_found * of_target) - cosines * found / of_found**2) / n
    return float(np.mean(difference**2) + np.mean(1 - cosines)), v
