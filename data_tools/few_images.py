"""The few images of a published scene that papers on few views train on, copied to a folder of their own."""

import json
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.llff import POSES_BOUNDS, read_poses_bounds
from minisplat_ref.io.transforms import BLENDER_FILES


class FewImages(NamedTuple):
    """Which images of Lego remain."""

    folder: str
    """Name of the folder that they are copied to."""
    train: tuple[int, ...]
    """Numbers of the training images."""
    test_every: int
    """Step between the test images."""

    def copy(self, scene: Path, out: Path) -> None:
        """Copy the images, with their cameras.

        Parameters
        ----------
        scene : Path
            Folder with both files of cameras.
        out : Path
            A new folder.

        Raises
        ------
        InputError
            A file of cameras, or a training image, is missing.
        """
        chosen = []
        for name in BLENDER_FILES:
            file = scene / name
            if not file.is_file():
                raise InputError(f"{file} is missing: give the folder that `minisplat-ref data lego --out DIR` fetches")
            content = json.loads(file.read_text(encoding="utf-8"))
            frames = {Path(frame["file_path"]).name: frame for frame in content["frames"]}
            if name == BLENDER_FILES[0]:
                missing = [k for k in self.train if f"r_{k}" not in frames]
                if missing:
                    raise InputError(f"{file} has no image r_{missing[0]}: it is not that of Lego")
                content["frames"] = [frames[f"r_{k}"] for k in self.train]
            else:
                content["frames"] = content["frames"][:: self.test_every]
            chosen.append((name, content))
        for name, content in chosen:
            for frame in content["frames"]:
                target = out / f"{frame['file_path']}.png"
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(scene / f"{frame['file_path']}.png", target)
            (out / name).write_text(json.dumps(content), encoding="utf-8")


class FewPhotographs(NamedTuple):
    """Which photographs of a scene of LLFF remain, whose order says which are held out."""

    folder: str
    """Name of the folder that they are copied to."""
    images: str
    """Folder of the photographs, which says how much smaller they are."""
    rows: tuple[int, ...]
    """Of ``poses_bounds.npy``, ascending."""

    def copy(self, scene: Path, out: Path) -> None:
        """Copy the photographs, with their cameras.

        Parameters
        ----------
        scene : Path
            Folder of ``poses_bounds.npy``.
        out : Path
            A new folder.

        Raises
        ------
        InputError
            The cameras, or a photograph, are missing.
        """
        poses, bounds = read_poses_bounds(scene / POSES_BOUNDS)
        folder = scene / self.images
        files = sorted(file for file in folder.iterdir() if file.is_file()) if folder.is_dir() else []
        if not len(files) == len(poses) > self.rows[-1]:
            raise InputError(f"{folder} has {len(files)} files, and {POSES_BOUNDS} {len(poses)} rows: it is not fern")
        (out / self.images).mkdir(parents=True)
        for row in self.rows:
            shutil.copy(files[row], out / self.images / files[row].name)
        rows = list(self.rows)
        np.save(out / POSES_BOUNDS, np.hstack([poses.reshape(-1, 15), bounds])[rows])


PAPERS = FewImages("lego-8", (26, 86, 2, 55, 75, 93, 16, 73), 8)
"""As papers on few views take them."""
FIRST = FewImages("lego-first-8", tuple(range(8)), 1)
"""As the user of the code of 3DGS took them whose figures are compared with."""
THREE = FewPhotographs("fern-3", "images_4", (0, 1, 8, 10, 16, 19))
"""Photographs 0, 8 and 16 are held out, every eighth; of the 17 others, the first, the middle and the last are trained
on, as papers on few views do. So every second of the six is held out."""


def thin_out(scene: Path, few: FewImages | FewPhotographs, out: Path) -> Path:
    """Copy a few images of a scene to a new folder, and return it; one that is there already is returned as it is.

    Raises
    ------
    InputError
        The scene is another one.
    """
    if not out.exists():
        few.copy(scene, out)
    return out
