"""The photographs of a run, small, to be shown in its cameras."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from minisplat_ref.app.reports.images import Image8, fit_image
from minisplat_ref.app.runs.settings import load, load_frame, load_photographs
from minisplat_ref.errors import InputError
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.types import Scene

LONGEST = 160  # pixels
SCALE = 0.05  # of the spread of the cameras: height of a camera that is shown


def load_thumbnails(folder: Path) -> dict[str, Image8]:
    """Return the photographs of a run by the names of its cameras.

    Raises
    ------
    InputError
        The scene is not where it was.
    """
    settings = load(folder)
    if not Path(settings.scene).exists():
        raise InputError(f"{settings.scene}, the scene of {folder}, is not there: its photographs are not shown")
    return thumbnails(load_photographs(settings, load_frame(folder)))


def thumbnails(scene: Scene) -> dict[str, Image8]:
    """Return the photographs of a scene by name, made small."""
    views = (view.load() for view in (*scene.train_views, *scene.test_views))
    return {view.name: fit_image(view.image, LONGEST) for view in views}


def camera_scale(cameras: Sequence[Viewpoint]) -> float:
    """Return the size at which cameras are shown, world units: by the distances between them, 1 where these are 0."""
    centres = np.array([view.camera.center for view in cameras])  # [V, 3]
    spread = math.sqrt(float(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return SCALE * (spread or 1.0)
