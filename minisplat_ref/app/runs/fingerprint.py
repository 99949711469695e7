"""The fingerprint of a run's scene: the cameras and photographs of its views, as ``cameras.json`` keeps them.

Hashed are the pixels as they were loaded (downscaled, undistorted, composited, with their mask), not the files: the
training used these pixels. A photograph that is saved again without loss, or a scene that is converted from COLMAP to
transforms.json, is the same; another ``--downscale`` is not. It takes as long as reading the pixels once: from memory,
or from disk where memory cannot hold them. A decoder that gives other pixels for the same JPEG makes another scene, and
a training continued on it would indeed not end with the same bytes.

Cameras are compared to nine digits: a product of matrices can differ in the last one between machines.
"""

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from minisplat_ref.app.runs.run_folder import CAMERAS
from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io import viewpoints
from minisplat_ref.io.frames import return_camera
from minisplat_ref.io.stored_views import Photograph, StoredView
from minisplat_ref.types import Scene, View

PHOTOGRAPH = "photograph"  # key of the hash
DIGITS = 1e-9
N_NAMED = 3  # views that are called by name

Entries = Sequence[Mapping[str, Any]]


def take_fingerprint(scene: Scene) -> list[dict[str, Any]]:
    """Return the content of ``cameras.json``: every view with its camera, as in the files, and a photograph's hash."""
    views = (*scene.train_views, *scene.test_views)
    found = viewpoints.scene_viewpoints(scene)
    cameras = viewpoints.to_json([v._replace(camera=return_camera(v.camera, scene.frame)) for v in found])
    return [{**camera, PHOTOGRAPH: _hash(view)} for camera, view in zip(cameras, views, strict=True)]


_HASHES: WeakKeyDictionary[Photograph, str] = WeakKeyDictionary()  # of photographs on disk, each is read once


def _hash(view: View) -> str:
    """Hash of the pixels and the mask, with their sizes."""
    if not isinstance(view, StoredView):
        return _hash_of_pixels(view)
    if view.photograph not in _HASHES:
        _HASHES[view.photograph] = _hash_of_pixels(view.load())
    return _HASHES[view.photograph]


def _hash_of_pixels(view: View) -> str:
    digest = hashlib.sha256()
    for array in (view.image, view.mask):
        if array is not None:
            digest.update(f"{array.dtype.str} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()[:32]


def read(folder: Path) -> Entries | None:
    """Return the views that a run was trained on; None where the folder does not have it.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    path = folder / CAMERAS
    if not path.exists():
        return None
    names = [viewpoint.name for viewpoint in viewpoints.read(path)]  # checks every entry
    entries = json.loads(path.read_text(encoding="utf-8"))
    return [{**entry, "img_name": name} for entry, name in zip(entries, names, strict=True)]


def difference(entries: Entries, others: Entries) -> str:
    """Describe the differences between the views of a run and those of a scene; nothing where they are the same.

    Whether a view is one for training or for testing does not matter here; see :func:`is_split_alike`.

    Parameters
    ----------
    entries, others : sequence of mappings
        From :func:`read` and :func:`take_fingerprint`.
    """
    ours, theirs = ({entry["img_name"]: entry for entry in them} for them in (entries, others))
    common = [name for name in ours if name in theirs]
    if not common:
        return "no view has the name of one of the run's"
    resized = [name for name in common if not _has_same(ours[name], theirs[name], SIZE)]
    alike = [name for name in common if name not in resized]
    parts = [
        _count([name for name in ours if name not in theirs], "is missing", "are missing"),
        _count([name for name in theirs if name not in ours], "is new", "are new"),
        _count(resized, "has another size", "have another size"),
        _count([name for name in alike if _has_moved(ours[name], theirs[name])], "has moved", "have moved"),
        _count(
            [
                name
                for name in alike
                if ours[name].get(PHOTOGRAPH, theirs[name][PHOTOGRAPH]) != theirs[name][PHOTOGRAPH]
            ],
            "has another photograph",
            "have other photographs",
        ),
    ]
    return ", ".join(part for part in parts if part)


SIZE = ("width", "height")
CAMERA = ("position", "rotation", "fx", "fy", "cx", "cy", "time")
OPTICS = "optics"  # the name of a lens and its coefficients, absent for a pinhole


def _has_moved(entry: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    (name, *ours), (other_name, *theirs) = (camera.get(OPTICS) or ["pinhole"] for camera in (entry, other))
    is_lens_alike = name == other_name and (ours == theirs or _has_same({OPTICS: ours}, {OPTICS: theirs}, (OPTICS,)))
    return not (is_lens_alike and _has_same(entry, other, CAMERA))


def _has_same(entry: Mapping[str, Any], other: Mapping[str, Any], keys: Sequence[str]) -> bool:
    for key in keys:
        a, b = np.asarray(entry.get(key, 0.0), float), np.asarray(other[key], float)
        if a.shape != b.shape or not np.all(np.abs(a - b) <= DIGITS * max(1.0, np.abs(b).max())):
            return False
    return True


def _count(names: Sequence[str], singular: str, plural: str) -> str:
    """Return ``3 views (a, b, c) are missing``; nothing for no names."""
    if not names:
        return ""
    listed = ", ".join(names[:N_NAMED]) + (", ..." if len(names) > N_NAMED else "")
    return f"{len(names)} view{'s'[: len(names) > 1]} ({listed}) {plural if len(names) > 1 else singular}"


def is_split_alike(entries: Entries, others: Entries) -> bool:
    """Return whether the same views are held out."""
    splits = [{entry["img_name"] for entry in them if entry.get("split") == "test"} for them in (entries, others)]
    return splits[0] == splits[1]


def list_trained(entries: Entries) -> set[str]:
    """Return the names of the views that a run was trained on."""
    return {entry["img_name"] for entry in entries if entry.get("split") == "train"}


def warn_of_unchecked(folder: Path, entries: Entries | None) -> None:
    """Warn about parts of a run of an older version that cannot be compared."""
    if entries is None:
        message = f"{folder} has no {CAMERAS}: whether the scene is its own cannot be checked"
    elif not all(PHOTOGRAPH in entry for entry in entries):
        message = f"{folder} is of a version that kept no hashes of photographs: only the cameras have been compared"
    else:
        return
    warnings.warn(one_line(message), InputWarning, stacklevel=2)


def check(folder: Path, scene: Scene, source: str) -> None:
    """Refuse to train a run further on another scene than its own.

    Parameters
    ----------
    folder : Path
        The run.
    scene : Scene
        As it was loaded.
    source : str
        From where, for the message.

    Raises
    ------
    InputError
        Names the difference.
    """
    entries = read(folder)
    if entries is not None:
        others = take_fingerprint(scene)
        differs = difference(entries, others) or ("" if is_split_alike(entries, others) else "other views are held out")
        if differs:
            raise InputError(f"{source} is not the scene of {folder}: {differs}; --scene PATH says where that is now")
    warn_of_unchecked(folder, entries)
