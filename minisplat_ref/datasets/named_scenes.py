"""A scene by the user's argument: a folder of photographs with cameras, or the name of a synthetic scene."""

from pathlib import Path

from minisplat_ref.datasets.synthetic import SCENE_NAMES, make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene
from minisplat_ref.types import Floats, Scene


def read_scene(source: str, downscale: int = 1, *, background: Floats | None = None, is_tested: bool = True) -> Scene:
    """Load a scene from a folder, with photographs ``downscale`` times smaller, or make the synthetic one of that name.

    Parameters
    ----------
    source : str
    downscale : int
    background : ndarray of shape (3,), optional
        Colour in [0, 1] behind the photographs, black by default.
    is_tested : bool
        Whether test views are needed.

    Raises
    ------
    InputError
        ``source`` is neither, has no test views, or is a synthetic scene although a smaller size or another background
        is requested.
    """
    if Path(source).exists():
        scene = load_scene(source, downscale=downscale, background=background)
    elif source not in SCENE_NAMES:
        raise InputError(f"{source}: neither a folder nor one of {', '.join(SCENE_NAMES)}; give a scene")
    elif downscale != 1:
        raise InputError(f"{source} is made at 160 x 120; write it with minisplat-ref synthetic for another size")
    elif background is not None and background.any():
        raise InputError(f"{source} is made on black; write it with minisplat-ref synthetic for another background")
    else:
        scene = make_scene(source).scene
    if is_tested and not scene.test_views:
        raise InputError(f"scene {scene.name} has no test views to measure: add photographs")
    return scene
