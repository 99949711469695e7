"""The points that a training starts from in place of the scene's own: ``--init``."""

from pathlib import Path

from minisplat_ref.errors import InputError
from minisplat_ref.io.frames import place_points
from minisplat_ref.io.ply import MEANS, NORMALS, load_points
from minisplat_ref.io.ply_file import property_names
from minisplat_ref.strategy.initialization import N_NEIGHBOURS, are_seen
from minisplat_ref.types import Scene


def load_start(path: str | Path, scene: Scene) -> tuple[Scene, list[str]]:
    """Read a point cloud and replace the scene's points by it.

    The scene that is returned is for the start alone: its views do not know which of these points they see.

    Parameters
    ----------
    path : str or Path
        A PLY, in the frame of the scene's files; see :func:`minisplat_ref.io.ply.load_points`.
    scene : Scene

    Returns
    -------
    start : Scene
        For :func:`minisplat_ref.training.loop.initial_state`.
    notices : list of str
        Sentences on what the file lacks.

    Raises
    ------
    InputError
        The file is missing or not a point cloud, has too few points, or no training view sees any of them.
    """
    cloud = load_points(path)
    cloud = cloud._replace(points=place_points(cloud.points, scene.frame))
    n = len(cloud.points)
    if n <= N_NEIGHBOURS:
        raise InputError(
            f"{path}: {n} point{'s'[: n != 1]}{f', as {cloud.dropped}' if cloud.dropped else ''}; to start from them,"
            f" give at least {N_NEIGHBOURS + 1}, or leave --init out"
        )
    if not are_seen(cloud.points, [view.camera for view in scene.train_views]).any():
        raise InputError(
            f"{path}: no training view sees any of the {n:,} points; give them in the world frame of scene {scene.name}"
        )
    notices = [f"{path}: {cloud.dropped} and left out"] if cloud.dropped else []
    if not cloud.has_colors:
        others = ", ".join(name for name in property_names(path) if name not in (*MEANS, *NORMALS))
        notices.append(
            f"{path}: no properties red, green, blue{f', but {others}' if others else ''}; all points start gray"
        )
    return scene._replace(points=cloud.points, point_colors=cloud.colors), notices
