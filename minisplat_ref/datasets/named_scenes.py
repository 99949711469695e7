"""A scene by the user's argument: a folder of photographs with cameras, or the name of a synthetic scene."""

from pathlib import Path

from minisplat_ref.datasets.synthetic import SCENE_NAMES, make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene
from minisplat_ref.types import Scene


def read_scene(source: str, downscale: int = 1, *, is_tested: bool = True) -> Scene:
    """Load a scene from a folder, with photographs ``downscale`` times smaller, or make the synthetic one of that name.

    Parameters
    ----------
    source : str
    downscale : int
    is_tested : bool
        Whether test views are needed.

    Raises
    ------
    InputError
        ``source`` is neither, has no test views, or is a synthetic scene although a smaller size is requested.
    """
    if Path(source).exists():
        scene = load_scene(source, downscale=downscale)
    elif source not in SCENE_NAMES:
        raise InputError(f"{source}: neither a folder nor one of {', '.join(SCENE_NAMES)}; give a scene")
    elif downscale != 1:
        raise InputError(f"{source} is made at 160 x 120; write it with minisplat-ref synthetic for another size")
    else:
        scene = make_scene(source).scene
    if is_tested and not scene.test_views:
        raise InputError(f"scene {scene.name} has no test views to measure: add photographs")
    return scene
