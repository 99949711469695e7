"""Some of a scene's photographs as numbers and text: files, cameras, and the points of structure from motion they show.

Whoever trains a part of a large scene needs no more of it, and does not read the scene's model, in which every point is
listed with every photograph that shows it. Text goes into JSON, arrays into an ``.npz``.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.io.lens import Lens
from minisplat_ref.io.scene import Listing, Photo
from minisplat_ref.types import Camera

ARRAYS = ("poses", "intrinsics", "times", "points", "point_colors", "point_ids")


def select(listing: Listing, names: Collection[str]) -> Listing:
    """Return the training photographs of some names, with the points that they show.

    Parameters
    ----------
    listing : Listing
        In which they are.
    names : collection of str
        Of views.

    Returns
    -------
    Listing
        In the order of the listing, without test photographs. All points remain where it is unknown which of them a
        photograph shows.
    """
    chosen = [pair for pair in zip(listing.names, listing.train_photos, strict=False) if pair[0] in names]
    photos = [photo for _, photo in chosen]
    known = [photo.point_ids for photo in photos if photo.point_ids is not None]
    selected = listing._replace(train_photos=photos, test_photos=(), names=[name for name, _ in chosen])
    if len(known) < len(photos):
        return selected
    rows = np.unique(np.concatenate(known))  # [Q]
    own = [photo._replace(point_ids=np.searchsorted(rows, ids)) for photo, ids in zip(photos, known, strict=True)]
    return selected._replace(train_photos=own, points=listing.points[rows], point_colors=listing.point_colors[rows])


def to_json(listing: Listing) -> dict[str, Any]:
    """Return the text of a listing of training photographs; paths are relative to the scene where they lie in it."""
    folder = _folder(listing.source)

    def inside(path: Path) -> str:
        return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)

    photographs = [
        {
            "name": name,
            "folder": inside(photo.folder),
            "file": photo.file,
            "mask": None if photo.mask_path is None else inside(photo.mask_path),
            "size": [photo.camera.width, photo.camera.height],
            "lens": None if photo.lens is None else [photo.lens.model, *photo.lens.params],
            "n_points": None if photo.point_ids is None else len(photo.point_ids),
        }
        for name, photo in zip(listing.names, listing.train_photos, strict=True)
    ]
    return {"alpha_is_mask": listing.alpha_is_mask, "photographs": photographs}


def to_arrays(listing: Listing) -> dict[str, NDArray[Any]]:
    """Return the numbers of a listing, by the names in ``ARRAYS``."""
    cameras = [photo.camera for photo in listing.train_photos]
    ids = [photo.point_ids for photo in listing.train_photos if photo.point_ids is not None]
    return {
        "poses": np.stack([np.column_stack((c.cam_from_world_R, c.cam_from_world_t)) for c in cameras]),  # [V, 3, 4]
        "intrinsics": np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras]),  # [V, 4]
        "times": np.array([photo.time for photo in listing.train_photos]),  # [V]
        "points": listing.points,
        "point_colors": listing.point_colors,
        "point_ids": np.concatenate([np.zeros(0, np.int32), *ids]).astype(np.int32),  # one photograph after the other
    }


def read_listing(source: Path, content: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Listing:
    """Return the listing of which :func:`to_json` and :func:`to_arrays` made ``content`` and ``arrays``.

    Parameters
    ----------
    source : Path
        Of the scene, where it is now.
    content, arrays : mapping
        Those of a damaged file raise KeyError, TypeError, ValueError or AttributeError.
    """
    entries = list(content["photographs"])
    counts = [entry["n_points"] for entry in entries]
    ends = np.cumsum([0 if count is None else int(count) for count in counts])
    rows = np.split(arrays["point_ids"].astype(np.int64), ends[:-1])
    photos = [
        _photo(_folder(source), entry, {name: arrays[name][k] for name in ("poses", "intrinsics", "times")})
        for k, entry in enumerate(entries)
    ]
    photos = [
        photo if count is None else photo._replace(point_ids=ids)
        for photo, count, ids in zip(photos, counts, rows, strict=True)
    ]
    names = [str(entry["name"]) for entry in entries]
    points, colors = arrays["points"], arrays["point_colors"]
    return Listing(source, photos, (), names, points, colors, bool(content["alpha_is_mask"]))


def _photo(folder: Path, entry: Mapping[str, Any], numbers: Mapping[str, Any]) -> Photo:
    pose = numbers["poses"]  # [3, 4]
    fx, fy, cx, cy = numbers["intrinsics"].tolist()
    width, height = map(int, entry["size"])
    R, t = np.ascontiguousarray(pose[:, :3]), np.ascontiguousarray(pose[:, 3])
    mask_path = None if entry["mask"] is None else folder / entry["mask"]
    camera, lens = Camera(R, t, fx, fy, cx, cy, width, height), _lens(entry["lens"])
    return Photo(folder / entry["folder"], str(entry["file"]), mask_path, camera, lens, time=float(numbers["times"]))


def _lens(content: Sequence[Any] | None) -> Lens | None:
    if content is None:
        return None
    model, *params = content
    return Lens(str(model), tuple(map(float, params)))


def _folder(source: Path) -> Path:
    return source if source.is_dir() else source.parent
