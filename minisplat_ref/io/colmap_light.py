"""COLMAP models without their 2D features, which are nearly all of a model and of no use to a training.

pycolmap reads a copy in which each image's list of features and each point's track is empty. Which images see a point
is read here, piece by piece, and kept as one number for each image and point, so that a model takes about as much
memory as what is used of it. pycolmap makes an object of each feature and of each element of a track.
"""

import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.io.colmap_records import LAYOUTS, N_COUNT, read_records, without_items
from minisplat_ref.io.colmap_text import text_lines
from minisplat_ref.types import Ints

PIECE = 1_000_000  # elements of tracks that are held before they are divided among the images
N_BEFORE_TRACK = 8  # words of a point's line: its number, place, colour and error
POINTS, IMAGES = "points3D", "images"


class Track(NamedTuple):
    """Which images see a point."""

    point_id: int
    image_ids: Ints
    """[E], of one twice if it has matched the point twice."""


@contextmanager
def without_features(model: Path) -> Iterator[tuple[Path, Mapping[int, Ints] | None]]:
    """Give a folder of the same model without features and tracks, and what the tracks say.

    Parameters
    ----------
    model : Path
        A model that pycolmap can read, as from :func:`.colmap_text.readable`.

    Returns
    -------
    folder : Path
        For as long as the context lasts.
    seen : mapping of int to ndarray of shape (K,), or None
        Of each image's number, the points that it sees: their places, ascending, among all points by their numbers.
        None for a model without tracks.

    Raises
    ------
    InputError
        A binary file ends too early.
    ValueError, OverflowError
        A number in a text file is none.
    """
    suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
    with tempfile.TemporaryDirectory(prefix="model-") as temporary:
        folder = Path(temporary)
        for file in model.iterdir():
            if file.is_file() and file.stem not in (POINTS, IMAGES):
                (folder / file.name).symlink_to(file.resolve())
        if (model / f"{IMAGES}{suffix}").is_file():  # pycolmap says that it is missing
            copy_images = _copy_binary_images if suffix == ".bin" else _copy_text_images
            copy_images(model / f"{IMAGES}{suffix}", folder / f"{IMAGES}{suffix}")
        copy_points = _copy_binary_points if suffix == ".bin" else _copy_text_points
        yield folder, seen_by_image(copy_points(model / f"{POINTS}{suffix}", folder / f"{POINTS}{suffix}"))


def seen_by_image(tracks: Iterable[Track]) -> dict[int, Ints] | None:
    """Return which points each image sees, by the image's number, as :func:`without_features` does."""
    point_ids: list[int] = []
    places: dict[int, list[Ints]] = defaultdict(list)  # of the points in the file, by image
    held: list[Ints] = []
    n_held = 0
    for track in chain(tracks, (None,)):
        if track is None or n_held >= PIECE:
            _add_places(places, held, len(point_ids))
            held, n_held = [], 0
        if track is not None:
            point_ids.append(track.point_id)
            held.append(track.image_ids)
            n_held += len(track.image_ids)
    ranks = np.empty(len(point_ids), np.int64)
    ranks[np.argsort(point_ids, kind="stable")] = np.arange(len(point_ids))
    return {image_id: np.sort(ranks[np.concatenate(places.pop(image_id))]) for image_id in list(places)} or None


def _add_places(places: dict[int, list[Ints]], images: list[Ints], end: int) -> None:
    """Add to the places of each image those of the points before ``end``, of which ``images`` says who sees them."""
    lengths = [len(of_point) for of_point in images]
    of_elements = np.repeat(np.arange(end - len(images), end, dtype=np.uint32), lengths)
    image_ids = np.concatenate([*images, np.zeros(0, np.int64)])
    by_image = np.argsort(image_ids, kind="stable")
    image_ids, of_elements = image_ids[by_image], of_elements[by_image]
    is_first = np.ones(len(image_ids), bool)
    is_first[1:] = (np.diff(image_ids) != 0) | (of_elements[1:] != of_elements[:-1])
    image_ids, starts = np.unique(image_ids[is_first], return_index=True)
    for image_id, of_image in zip(image_ids, np.split(of_elements[is_first], starts[1:]), strict=False):
        places[int(image_id)].append(of_image)


def _copy_binary_images(file: Path, copy: Path) -> None:
    layout = LAYOUTS[file.name]
    with file.open("rb") as original, copy.open("wb") as written:
        written.write(original.read(N_COUNT))
        written.writelines(without_items(record, layout) for record in read_records(file))


def _copy_binary_points(file: Path, copy: Path) -> Iterator[Track]:
    layout = LAYOUTS[file.name]
    with file.open("rb") as original, copy.open("wb") as written:
        written.write(original.read(N_COUNT))
        for record in read_records(file, with_items=True):
            written.write(without_items(record, layout))
            elements = np.frombuffer(record.items, "<u4")[::2]  # of each, the image and which of its features
            yield Track(int.from_bytes(record.head[:8], "little"), elements.astype(np.int64))


def _copy_text_images(file: Path, copy: Path) -> None:
    """Copy every image's first line, with an empty one for its features."""
    with copy.open("w", encoding="utf-8", errors="surrogateescape") as written:
        lines = text_lines(file)
        for line in lines:
            if line.strip() and not line.startswith("#"):
                written.write(f"{line}\n\n")
                next(lines, None)


def _copy_text_points(file: Path, copy: Path) -> Iterator[Track]:
    with copy.open("w", encoding="utf-8", errors="surrogateescape") as written:
        for line in text_lines(file):
            if line.strip() and not line.startswith("#"):
                words = line.split(maxsplit=N_BEFORE_TRACK)
                written.write(" ".join(words[:N_BEFORE_TRACK]) + "\n")
                elements = "".join(words[N_BEFORE_TRACK:]).split()[::2]
                yield Track(int(words[0]), np.array(elements, np.int64))
