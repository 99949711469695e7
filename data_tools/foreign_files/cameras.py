"""Cameras of other programs for ``render``: the same views, however a file describes them."""

import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from data_tools.foreign_files.building import done, refused
from data_tools.foreign_files.dialects import gaussians
from minisplat_ref.io import read_image, save_ply
from minisplat_ref.types import Floats

WIDTH, HEIGHT = 48, 36
FRAME = ("--size", f"{WIDTH}x{HEIGHT}")
FLIP = np.diag([1.0, -1.0, -1.0])  # OpenGL's axes of a camera
LEVELS = 2  # of 255, between renders whose cameras differ by rounding


def views(seed: int, fov: float) -> list[tuple[Floats, Floats]]:
    """Return places, and rotations world_from_camera, of three cameras that look at the middle without rolling."""
    rng = np.random.default_rng(seed)
    found: list[tuple[Floats, Floats]] = []
    for _ in range(3):
        position = rng.normal(size=3) * [1, 0.4, 1]
        position *= 3.5 / math.tan(math.radians(fov) / 2) / np.linalg.norm(position)
        forward = -position / np.linalg.norm(position)
        right = np.cross(forward, [0.0, -1.0, 0.0])
        right /= np.linalg.norm(right)
        found.append((position, np.column_stack([right, np.cross(forward, right), forward])))
    return found


def focal(fov: float) -> float:
    """Return the focal length in pixels of an angle from top to bottom, degrees."""
    return 0.5 * HEIGHT / math.tan(math.radians(fov) / 2)


def matrices(seed: int, fov: float) -> list[Floats]:
    """Return world_from_camera [4, 4] in OpenGL's axes."""
    found: list[Floats] = []
    for position, rotation in views(seed, fov):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation @ FLIP, position
        found.append(matrix)
    return found


def _usual(folder: Path, seed: int, fov: float) -> Path:
    entries = [
        {"img_name": i, "width": WIDTH, "height": HEIGHT, "fx": focal(fov), "fy": focal(fov)}
        | {"position": position.tolist(), "rotation": rotation.tolist()}
        for i, (position, rotation) in enumerate(views(seed, fov))
    ]
    (folder / "cameras.json").write_text(json.dumps(entries))
    return folder / "cameras.json"


def nerfstudio(folder: Path, seed: int, fov: float) -> Path:
    """Write a path of its viewer, whose size is in the file."""
    path = [
        {"camera_to_world": matrix.ravel().tolist(), "fov": fov, "aspect": WIDTH / HEIGHT}
        for matrix in matrices(seed, fov)
    ]
    content = {"camera_type": "perspective", "render_width": WIDTH, "render_height": HEIGHT, "camera_path": path}
    content |= {"fps": 24, "seconds": 4, "keyframes": []}
    (folder / "camera_path.json").write_text(json.dumps(content))
    return folder / "camera_path.json"


def transforms(folder: Path, seed: int, fov: float) -> Path:
    """Write a transforms.json whose photographs are not there."""
    frames = [
        {"file_path": f"images/{i}.jpg", "transform_matrix": m.tolist()} for i, m in enumerate(matrices(seed, fov))
    ]
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": focal(fov), "fl_y": focal(fov), "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder / "transforms.json"


def supersplat(folder: Path, seed: int, fov: float, is_nested: bool = False) -> Path:
    """Write poses: places that are turned by 180 degrees about z, with the angle of the longer side."""
    angle = math.degrees(2 * math.atan(0.5 * max(WIDTH, HEIGHT) / focal(fov)))
    poses = [
        {
            "name": "key",
            "frame": 10 * i,
            "position": (position * [-1, -1, 1]).tolist(),
            "target": ((position + 3 * rotation[:, 2]) * [-1, -1, 1]).tolist(),
            "fov": angle,
        }
        for i, (position, rotation) in enumerate(views(seed, fov))
    ]
    content: Any = {"poseSets": [{"name": "set0", "poses": poses}]} if is_nested else {"poses": poses}
    (folder / "poses.json").write_text(json.dumps(content))
    return folder / "poses.json"


def instant_ngp(folder: Path, seed: int, fov: float) -> Path:
    """Write a path in its unit cube."""
    path = []
    for position, rotation in views(seed, fov):
        quat = Rotation.from_matrix(rotation[[1, 2, 0]]).as_quat()  # x, y, z, w
        place = 0.33 * position[[1, 2, 0]] + 0.5
        path.append({"R": quat.tolist(), "T": place.tolist(), "fov": fov, "slice": 0.0, "scale": 1.0, "dof": 0.0})
    (folder / "base_cam.json").write_text(json.dumps({"time": 1.0, "path": path}))
    return folder / "base_cam.json"


def colmap(folder: Path, seed: int, fov: float, place: str = "") -> Path:
    """Write a bare model as text."""
    model = folder / "model" / place
    model.mkdir(parents=True)
    f = focal(fov)
    (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {f!r} {f!r} {WIDTH / 2} {HEIGHT / 2}\n")
    lines = []
    for i, (position, rotation) in enumerate(views(seed, fov)):
        x, y, z, w = Rotation.from_matrix(rotation.T).as_quat().tolist()
        t = (-rotation.T @ position).tolist()
        lines.append(f"{i + 1} {w!r} {x!r} {y!r} {z!r} {' '.join(map(repr, t))} 1 {i}.png\n\n")
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text("")
    return folder / "model"


def _same(folder: Path, write: Callable[..., Path], seed: int, fov: float) -> None:
    """The same cameras give the same images."""
    save_ply(folder / "model.ply", gaussians())
    images = []
    for i, cameras in enumerate((_usual(folder, seed, fov), write(folder, seed, fov))):
        out = folder / f"views{i}"
        done("render", folder / "model.ply", "--cameras", cameras, *FRAME, "--out", out)
        images.append([read_image(file).astype(int) for file in sorted(out.glob("*.png"))])
    assert len(images[0]) == len(images[1]) == 3 and all(image.max() > 50 for image in images[0])
    for usual, theirs in zip(*images, strict=True):
        assert np.abs(usual - theirs).max() <= LEVELS, np.abs(usual - theirs).max()


def _refused(folder: Path, content: object, says: str) -> None:
    save_ply(folder / "model.ply", gaussians())
    (folder / "bad.json").write_text(json.dumps(content))
    line = refused("render", folder / "model.ply", "--cameras", folder / "bad.json", names=folder / "bad.json")
    assert says in line, line
    assert not (folder / "model-views").exists()


MIRRORED = np.diag([1.0, -1.0, 1.0, 1.0]).ravel().tolist()
WRITERS: dict[str, Callable[..., Path]] = {
    "nerfstudio": nerfstudio,
    "transforms.json": transforms,
    "SuperSplat": supersplat,
    "SuperSplat, sets": partial(supersplat, is_nested=True),
    "instant-ngp": instant_ngp,
    "COLMAP, bare": colmap,
    "COLMAP, sparse/0": partial(colmap, place="sparse/0"),
}

CASES: dict[str, Callable[[Path], None]] = {
    **{
        f"{name}, {fov:g} degrees": partial(_same, write=write, seed=seed, fov=fov)
        for name, write in WRITERS.items()
        for seed, fov in ((0, 50.0), (1, 35.0), (2, 80.0))
    },
    **{
        f"refused: {says}": partial(_refused, content=content, says=says)
        for content, says in (
            ({"camera_path": [{"camera_to_world": [1, 2, 3], "fov": 50}]}, "camera_to_world is not 4 x 4"),
            ({"camera_path": [{"camera_to_world": MIRRORED, "fov": 50}]}, "not a rotation"),
            ({"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 180}]}, "fov is 180"),
            ({"camera_path": [], "camera_type": "equirectangular"}, "equirectangular"),
            ({"poses": []}, "no cameras"),
            ({"poses": [{"position": [0, 0, 0], "target": [0, 0, 0]}]}, "one point"),
            ({"path": [{"R": [0, 0, 0, 0], "T": [0, 0, 0], "fov": 50}]}, "R and T"),
            ({"something": 1}, "SuperSplat's poses"),
        )
    },
}
