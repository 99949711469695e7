"""Synthetic scenes, stage 9: a scene as a folder that every splatting program reads.

``images/*.png`` and ``sparse/0/{cameras,images,points3D}.txt`` are a COLMAP text model with tracks. The truth is stored
with it: ``depths/*.npy`` and ``normals/*.npy`` (float32), ``ids/*.npy`` (int16), and ``scene_info.json``.
"""

import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from minisplat_ref.datasets.synthetic import SyntheticScene
from minisplat_ref.datasets.synthetic.sparse_points import project_points
from minisplat_ref.errors import InputError
from minisplat_ref.io.images import write_image
from minisplat_ref.types import Camera, Floats, Ints, View

CAMERA_ID = 1  # one camera takes all images; COLMAP counts from 1
INFO = "scene_info.json"
UNITS = (
    "metres, world z up; depths are camera z at pixel centres, 0 at the sky; normals are in the world frame, towards "
    "the camera, 0 at the sky"
)


def check_free(folder: Path) -> None:
    """Refuse a folder that is not empty.

    Raises
    ------
    InputError
        It is a file, or not empty.
    """
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder} exists already; name a new folder or remove this one")


def nothing_more(folder: Path) -> None:
    """Write nothing."""


def write_scene(
    synthetic: SyntheticScene,
    folder: Path,
    settings: Mapping[str, Any],
    write_more: Callable[[Path], None] = nothing_more,
) -> None:
    """Write a scene, complete or not at all.

    Parameters
    ----------
    synthetic : SyntheticScene
        The scene.
    folder : Path
        A folder that does not exist or is empty.
    settings : mapping
        How the scene was made, for ``scene_info.json``.
    write_more : callable
        Writes further files into the folder, before it gets its name.

    Raises
    ------
    InputError
        The folder is occupied or cannot be written.
    """
    check_free(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Beside the folder, because renaming across disks would copy.
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as temporary:
            unfinished = Path(temporary) / "scene"
            _write_files(synthetic, unfinished, settings)
            write_more(unfinished)
            if folder.exists():
                folder.rmdir()
            os.replace(unfinished, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error}); choose another place") from error


def load_depths(folder: Path, names: Sequence[str]) -> list[Floats] | None:
    """Return the true depths [H, W] of views; None where :func:`write_scene` has not written them.

    Parameters
    ----------
    folder : Path
        Of any scene.
    names : sequence of str
        Of the views, without suffix.

    Returns
    -------
    list of ndarrays of shape (H, W) or None
        float32 camera z at pixel centres, world units; 0 at the sky.

    Raises
    ------
    InputError
        A file is damaged.
    """
    paths = [folder / "depths" / f"{name}.npy" for name in names]
    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    # Other programs write depths/ and notes too: only our sentence on units identifies these as the truth.
    if not isinstance(info, dict) or info.get("units") != UNITS or not all(path.is_file() for path in paths):
        return None
    return [_load_depth(path) for path in paths]


def _load_depth(path: Path) -> Floats:
    try:
        depth = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} cannot be read ({error}): write the scene again, or remove depths/") from error
    if depth.ndim != 2 or depth.dtype != np.float32:
        raise InputError(f"{path} holds no depth [H, W] of float32: write the scene again, or remove depths/")
    return depth


def _write_files(synthetic: SyntheticScene, folder: Path, settings: Mapping[str, Any]) -> None:
    """Write everything into the folder."""
    scene = synthetic.scene
    model = folder / "sparse" / "0"
    for subfolder in (folder / "images", folder / "depths", folder / "normals", folder / "ids", model):
        subfolder.mkdir(parents=True)
    for views, depths, normals, ids in (
        (scene.train_views, synthetic.train_depths, synthetic.train_normals, synthetic.train_ids),
        (scene.test_views, synthetic.test_depths, synthetic.test_normals, synthetic.test_ids),
    ):
        for view, depth, normal, of_primitives in zip(views, depths, normals, ids, strict=True):
            write_image(folder / "images" / f"{view.name}.png", view.image)
            np.save(folder / "depths" / f"{view.name}.npy", depth.astype(np.float32))
            np.save(folder / "normals" / f"{view.name}.npy", normal.astype(np.float32))
            np.save(folder / "ids" / f"{view.name}.npy", of_primitives)

    track_ids = [np.flatnonzero(row) for row in synthetic.point_visibility]  # of V views: the points that each sees
    tracks = dict(zip((view.name for view in scene.train_views), track_ids, strict=True))
    all_views = sorted((*scene.train_views, *scene.test_views), key=lambda view: view.name)
    (model / "cameras.txt").write_text(_camera_line(all_views[0].camera))
    seen = [tracks.get(view.name, np.zeros(0, int)) for view in all_views]
    (model / "images.txt").write_text(
        "".join(_image_lines(i + 1, all_views[i], seen[i], scene.points) for i in range(len(all_views)))
    )
    (model / "points3D.txt").write_text(_point_lines(synthetic, seen))
    info = {
        **settings,
        "train_views": [view.name for view in scene.train_views],
        "test_views": [view.name for view in scene.test_views],
        "n_points": len(scene.points),
        "units": UNITS,
    }
    (folder / INFO).write_text(json.dumps(info, indent=2) + "\n")


def _camera_line(camera: Camera) -> str:
    """Return COLMAP's line for a pinhole: id, model, size, fx fy cx cy. Its pixel centres are at +0.5, as ours are."""
    intrinsics = _numbers([camera.fx, camera.fy, camera.cx, camera.cy])
    return f"{CAMERA_ID} PINHOLE {camera.width} {camera.height} {intrinsics}\n"


def _image_lines(image_id: int, view: View, point_ids: Ints, points: Floats) -> str:
    """Return COLMAP's two lines for a view: its pose (quaternion wxyz, translation); x, y, id of its points."""
    x, y, z, w = Rotation.from_matrix(view.camera.cam_from_world_R).as_quat()
    pose = _numbers([w, x, y, z, *view.camera.cam_from_world_t])
    pixels, _ = project_points(view.camera, points[point_ids])
    observations = " ".join(f"{_numbers(pixels[row])} {point_ids[row] + 1}" for row in range(len(point_ids)))
    return f"{image_id} {pose} {CAMERA_ID} {view.name}.png\n{observations}\n"


def _point_lines(synthetic: SyntheticScene, seen: Sequence[Ints]) -> str:
    """Return COLMAP's line for each point: id, position, colour, reprojection error, track of (image, observation).

    The observations are projections of the points themselves, noise included, so that the error is 0.
    """
    tracks: list[list[str]] = [[] for _ in synthetic.scene.points]
    for index, point_ids in enumerate(seen):
        for row, point_id in enumerate(point_ids):
            tracks[point_id].append(f"{index + 1} {row}")
    lines = []
    for point_id, track in enumerate(tracks):
        position = _numbers(synthetic.scene.points[point_id])
        red, green, blue = synthetic.scene.point_colors[point_id]
        lines.append(f"{point_id + 1} {position} {red} {green} {blue} 0 {' '.join(track)}\n")
    return "".join(lines)


def _numbers(values: list[float] | Floats) -> str:
    """Return decimal numbers that read back as the same float64."""
    return " ".join(repr(float(value)) for value in values)
