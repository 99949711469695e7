"""Find features in photographs and match them between pairs, into the database that the mappers read.

SIFT, by COLMAP, on the CPU. *Standard* is COLMAP's own setting. *Dense* finds weaker features, and more of them, and
searches once more along the epipolar lines of pairs that match. That takes some twenty times as long, so it is done
only between photographs that overlap according to their standard features. Photographs and pairs are handed over in
batches: between them the progress bar moves, and an interruption is noticed.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from minisplat_ref.datasets.sfm.photographs import Photographs
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io.lens import import_quiet_pycolmap

SEED = 0  # of RANSAC: the same photographs give the same matches
NEIGHBOURS = (*range(1, 11), 16, 32, 64, 128, 256, 512)  # distances in the order of names, for sequential matching
MATCHES_MIN = 15  # of a pair that overlaps, after geometric verification: COLMAP's own threshold
PARTNERS = 10  # of a photograph in dense matching: those with which it has most standard matches
PAIRS_AT_ONCE = 16  # a call takes 0.06 s besides its pairs
GUIDED_AT_ONCE = 2  # for each core

Pair = tuple[str, str]


class Features(NamedTuple):
    """Settings of finding and matching features."""

    name: str
    """As ``--features`` calls it."""
    n_max: int
    """Features in a photograph."""
    peak_threshold: float
    """Contrast that a feature needs."""
    is_guided: bool
    """Whether matches are searched once more along the epipolar lines."""


STANDARD = Features("standard", n_max=8192, peak_threshold=0.02 / 3, is_guided=False)
DENSE = Features("dense", n_max=16384, peak_threshold=0.002, is_guided=True)


def find_features(database: Path, photographs: Photographs, features: Features, camera_model: str) -> None:
    """Write the features of all photographs into a new database, with one camera for each group.

    Parameters
    ----------
    database : Path
        File to make.
    photographs : Photographs
    features : Features
    camera_model : str
        COLMAP model of the cameras.

    Raises
    ------
    InputError
        If COLMAP has left out a photograph.
    """
    pycolmap = import_quiet_pycolmap()
    options = pycolmap.FeatureExtractionOptions()
    n_at_once = os.cpu_count() or 1
    options.sift.max_num_features, options.sift.peak_threshold = features.n_max, features.peak_threshold
    reader = pycolmap.ImageReaderOptions(camera_model=camera_model)
    with opened(database):
        pass  # which makes the file
    for names in photographs.groups.values():  # threads finish in any order; images that are in it keep theirs
        pycolmap.import_images(database, photographs.images, pycolmap.CameraMode.SINGLE, names, reader)
    masked = [name for name in photographs.originals if name in photographs.masked]
    others = [name for name in photographs.originals if name not in photographs.masked]
    with progress_bar(f"{features.name} features", "photographs", len(photographs.originals)) as bar:
        for batch in (*_batches(masked, n_at_once), *_batches(others, n_at_once)):
            # With a folder of masks, COLMAP skips a photograph that has none.
            reader.mask_path = photographs.masks if batch[0] in photographs.masked else ""
            pycolmap.extract_features(
                database,
                photographs.images,
                batch,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            bar.update(len(batch))
    with opened(database) as content:
        images = content.read_all_images()
        found = {image.name for image in images if content.exists_keypoints(image.image_id)}
    missing = [str(original) for name, original in photographs.originals.items() if name not in found]
    if missing:
        raise InputError(
            f"{photographs.source}: COLMAP could not read {', '.join(missing)}; convert to JPEG again, or remove"
        )


def match_features(database: Path, work: Path, pairs: Sequence[Pair], features: Features) -> None:
    """Match the features of pairs of photographs, and verify that the matches fit two views of something rigid.

    Parameters
    ----------
    database : Path
        With the features of all photographs.
    work : Path
        Folder for a list of pairs.
    pairs : sequence of Pair
        Names of photographs.
    features : Features
    """
    pycolmap = import_quiet_pycolmap()
    options = pycolmap.FeatureMatchingOptions(guided_matching=features.is_guided)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    listed = pycolmap.ImportedPairingOptions(match_list_path=work / "pairs.txt")
    n_at_once = GUIDED_AT_ONCE * (os.cpu_count() or 1) if features.is_guided else PAIRS_AT_ONCE
    with progress_bar(f"{features.name} matches", "pairs", len(pairs)) as bar:
        for batch in _batches(pairs, n_at_once):
            Path(listed.match_list_path).write_text("".join(f"{a} {b}\n" for a, b in batch), encoding="utf-8")
            pycolmap.match_image_pairs(database, options, listed, verification, pycolmap.Device.cpu)
            bar.update(len(batch))


def pairs_to_match(names: Sequence[str], matching: str) -> list[Pair]:
    """Return all pairs of photographs, or for sequential matching those of neighbours in the order of names."""
    n = len(names)
    distances = range(1, n) if matching == "exhaustive" else [d for d in NEIGHBOURS if d < n]
    return [(names[i], names[i + d]) for i in range(n) for d in distances if i + d < n]


def overlapping_pairs(database: Path, pairs: Sequence[Pair], placed: frozenset[str]) -> list[Pair]:
    """Return those of the pairs that are worth a denser search, in their order.

    A photograph is paired with the PARTNERS with which it has most verified matches, and one that is not ``placed``
    with every other as well.

    Parameters
    ----------
    database : Path
        With verified matches of the pairs.
    pairs : sequence of Pair
    placed : frozenset of str
        Names of photographs whose cameras were found.
    """
    partners: dict[str, list[tuple[int, str]]] = {}
    for (a, b), count in _count_matches(database).items():
        partners.setdefault(a, []).append((count, b))
        partners.setdefault(b, []).append((count, a))
    chosen = {
        frozenset((name, other))
        for name, others in partners.items()
        for _, other in sorted(others, reverse=True)[:PARTNERS]
    }
    return [pair for pair in pairs if frozenset(pair) in chosen or not placed.issuperset(pair)]


def is_connected(database: Path) -> bool:
    """Return whether chains of pairs that match lead from each photograph to every other."""
    with opened(database) as content:
        rows = {image.name: row for row, image in enumerate(content.read_all_images())}
    pairs = [(rows[a], rows[b]) for a, b in _count_matches(database)]
    first, second = np.array(pairs, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(pairs)), (first, second)), shape=(len(rows), len(rows)))
    return connected_components(graph, directed=False, return_labels=False) == 1


def reaches(database: Path, placed: frozenset[str]) -> bool:
    """Return whether a photograph without a place matches two with one, as it must to find one."""
    partners: dict[str, int] = {}
    for pair in _count_matches(database):
        lost = [name for name in pair if name not in placed]
        if len(lost) == 1:
            partners[lost[0]] = partners.get(lost[0], 0) + 1
    return max(partners.values(), default=0) >= min(2, len(placed))


def _count_matches(database: Path) -> dict[Pair, int]:
    """Return the verified matches of the pairs that overlap."""
    pycolmap = import_quiet_pycolmap()
    with opened(database) as content:
        names = {image.image_id: image.name for image in content.read_all_images()}
        ids, counts = content.read_two_view_geometry_num_inliers()
    found = {}
    for pair_id, count in zip(ids, counts, strict=True):
        if count >= MATCHES_MIN:
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            found[names[a], names[b]] = int(count)
    return found


@contextmanager
def opened(database: Path) -> Iterator[Any]:
    """Open a database of COLMAP while COLMAP is not working with it."""
    content = import_quiet_pycolmap().Database.open(database)
    try:
        yield content
    finally:
        content.close()


def _batches(items: Sequence[Any], size: int) -> Iterator[list[Any]]:
    """Yield the items in lists of at most ``size``."""
    for i in range(0, len(items), size):
        yield list(items[i : i + size])
