"""Scenes of LLFF, Mildenhall et al. 2019: photographs beside ``poses_bounds.npy``.

Its row of a photograph has 17 numbers: a matrix [R | t | (height, width, focal length)], 3 x 5 row by row, and the
depths between which the scene lies. R is world_from_camera, with the camera's axes *down, right, backward*; t is the
camera's centre. OpenCV's axes, right, down and forward, are therefore columns 1, 0 and -2 of R. The principal point is
the centre of the image. Rows are those of the photographs by name.

There are no points. Random ones are drawn in the box around what the photographs show between the two depths.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.images import PHOTOGRAPHS, image_size
from minisplat_ref.io.ply import NO_POINTS
from minisplat_ref.io.scene import Listing, Photo, make_listing, split_photos
from minisplat_ref.types import Camera, Floats

POSES_BOUNDS = "poses_bounds.npy"
FOLDERS = ("images", "images_2", "images_4", "images_8", "images_16")  # the first that is there has the photographs


def is_llff(path: Path) -> bool:
    """Return whether a folder holds such a scene."""
    return path.is_dir() and (path / POSES_BOUNDS).is_file()


def list_llff(path: Path, test_every: int, offset: int = 0) -> Listing:
    """Return everything about a scene but its photographs.

    Parameters
    ----------
    path : Path
        Folder of ``poses_bounds.npy``.
    test_every, offset : int
        As for :func:`~minisplat_ref.io.scene.split_photos`. The published split holds out every eighth, from the first.

    Raises
    ------
    InputError
        The file has other numbers, there are no photographs, or not as many as rows.
    """
    poses, bounds = read_poses_bounds(path / POSES_BOUNDS)
    folder = next((path / name for name in FOLDERS if (path / name).is_dir()), None)
    files = [] if folder is None else sorted(f.name for f in folder.iterdir() if f.suffix.lower() in PHOTOGRAPHS)
    if folder is None or not files:
        raise InputError(f"{path}: no photographs in {', '.join(FOLDERS)}; put them beside {POSES_BOUNDS}")
    if len(files) != len(poses):
        raise InputError(
            f"{path / POSES_BOUNDS} has {len(poses)} rows, and {folder} has {len(files)} photographs: they belong"
            " together by their order, so that none may be missing"
        )
    cameras = [make_camera(pose, image_size(folder / file)) for pose, file in zip(poses, files, strict=True)]
    photos = [Photo(folder, file, None, camera, None) for file, camera in zip(files, cameras, strict=True)]
    train_photos, test_photos = split_photos(photos, test_every, offset)
    listing = make_listing(path, train_photos, test_photos, NO_POINTS.points, NO_POINTS.colors, alpha_is_mask=True)
    return listing._replace(random_box=box_of_frustums(cameras, bounds))


def read_poses_bounds(file: Path) -> tuple[Floats, Floats]:
    """Return the matrices [V, 3, 5] and the depths [V, 2] of a file.

    Raises
    ------
    InputError
        It is not an array of 17 finite numbers for each photograph, or its depths are not positive.
    """
    try:
        rows: Any = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(
            f"{file} is no array of NumPy; make it again, for instance with LLFF's imgs2poses.py"
        ) from error
    if getattr(rows, "ndim", 0) != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "fiu":
        raise InputError(f"{file} is an array of shape {getattr(rows, 'shape', '?')}; give 17 numbers per photograph")
    rows = rows.astype(np.float64)
    if not np.isfinite(rows).all():
        raise InputError(
            f"{file}: photograph {int(np.argmin(np.isfinite(rows).all(axis=1)))} has a number that is not"
            " finite; make it again"
        )
    bounds = rows[:, 15:]
    if not (bounds[:, 0] > 0).all() or not (bounds[:, 1] > bounds[:, 0]).all():
        raise InputError(f"{file}: depths are positive, the nearer first; those of this file are not")
    return rows[:, :15].reshape(-1, 3, 5), bounds


def make_camera(pose: Floats, size: tuple[int, int]) -> Camera:
    """Return the camera of a photograph.

    Parameters
    ----------
    pose : ndarray of shape (3, 5)
        [R | t | (height, width, focal length)] of the file.
    size : (width, height)
        Of the photograph, which may be a reduced one.
    """
    down, right, backward, center = pose[:, :4].T
    height, width, focal = pose[:, 4]
    R = np.stack([right, down, -backward])  # cam_from_world: its rows are the camera's axes
    return Camera(
        cam_from_world_R=R,
        cam_from_world_t=-R @ center,
        fx=float(focal * size[0] / width),
        fy=float(focal * size[1] / height),
        cx=size[0] / 2,
        cy=size[1] / 2,
        width=size[0],
        height=size[1],
    )


def box_of_frustums(cameras: Sequence[Camera], bounds: Floats) -> Floats:
    """Return the lowest and highest corner [2, 3] of what cameras show between their depths.

    Parameters
    ----------
    cameras : sequence of Camera
        V.
    bounds : ndarray of shape (V, 2)
        Nearest and farthest depth of each, world units.
    """
    corners = []
    for camera, depths in zip(cameras, bounds, strict=True):
        for z in depths:
            for u in (0, camera.width):
                for v in (0, camera.height):
                    p = np.array([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
                    corners.append(camera.cam_from_world_R.T @ (p - camera.cam_from_world_t))
    return np.array([np.min(corners, axis=0), np.max(corners, axis=0)])
