"""Estimate cameras and points from matches by two mappers of COLMAP.

The *incremental* mapper begins with two photographs and adds one after the other. It is accurate, but may find no good
beginning, for example where the photographer walked forwards. The *global* one (GLOMAP) estimates all cameras at once;
it places every photograph that matches another, however badly. Therefore the points of both are triangulated again, by
the same rules, and a photograph that sees too few of them loses its place.

A point that only two photographs see is kept if it projects closely. COLMAP leaves such points out, because they help
no camera, but training can start from them.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io.lens import import_quiet_pycolmap

SEED = 0
SEEN_MIN = 15  # points with three views or more that a photograph must see for its camera to be credible
PAIR_ERROR_MAX = 1.0  # of a point in two views, pixels; no third view can contradict a wrong match
MAPPERS = ("incremental", "global")


class Mapped(NamedTuple):
    """The result of one mapper."""

    mapper: str
    """Its name."""
    features: str
    """Name of the features."""
    model: Any
    """The largest model, a ``pycolmap.Reconstruction``; None if there is none."""
    n_placed: int
    """Photographs with a camera."""
    n_points: int
    """Points in the largest model."""
    other_groups: tuple[int, ...]
    """Photographs in each of the other models."""
    n_explained: int = 0
    """Matches that the cameras explain, see :mod:`.judging`."""


def map_photographs(database: Path, images: Path, work: Path, features: str, n_photos: int) -> Iterator[Mapped]:
    """Yield the result of each mapper, in the order of MAPPERS; a mapper runs when its result is asked for.

    Parameters
    ----------
    database : Path
        With verified matches.
    images : Path
        Folder of photographs, for the colours of points.
    work : Path
        New folder for COLMAP's files.
    features : str
        Name of the features, for the results.
    n_photos : int
        For the progress bar.
    """
    pycolmap = import_quiet_pycolmap()
    for mapper in MAPPERS:
        folder = work / mapper
        folder.mkdir(parents=True)
        pycolmap.set_random_seed(SEED)  # for parts that have no seed among their options
        with progress_bar(f"{mapper} mapper", "photographs", n_photos, delay=0.0) as bar:
            if mapper == "incremental":
                options = pycolmap.IncrementalPipelineOptions(random_seed=SEED)
                found = pycolmap.incremental_mapping(
                    database, images, folder, options, next_image_callback=lambda: bar.update()
                )
            else:  # which reports nothing in between
                options = pycolmap.GlobalPipelineOptions(random_seed=SEED)
                for part in (options.mapper, options.mapper.rotation_averaging, options.mapper.global_positioning):
                    part.random_seed = SEED
                found = pycolmap.global_mapping(database, images, folder, options)
            models = [complete(model, database, images, folder) for model in found.values()]
        models = sorted((model for model in models if model.num_reg_images() > 0), key=_size, reverse=True)
        yield _result(mapper, features, models)


def complete(model: Any, database: Path, images: Path, work: Path) -> Any:
    """Triangulate all points of a model again, those in two views too, and take back cameras without support."""
    pycolmap = import_quiet_pycolmap()
    options = pycolmap.IncrementalPipelineOptions(random_seed=SEED)
    options.triangulation.ignore_two_view_tracks = False
    unsupported = None
    while unsupported is None or unsupported:
        if model.num_reg_images() < 2:  # a single photograph has no points
            for frame_id in model.reg_frame_ids():
                model.deregister_frame(frame_id)
            return model
        model = pycolmap.triangulate_points(model, database, images, work, clear_points=True, options=options)
        unsupported = _unsupported(model)
        for frame_id in unsupported:
            model.deregister_frame(frame_id)
    points = model.points3D.items()
    for point_id in [i for i, point in points if point.track.length() == 2 and point.error > PAIR_ERROR_MAX]:
        model.delete_point3D(point_id)
    return model


def _unsupported(model: Any) -> list[int]:
    """Return the frames of photographs that see fewer than SEEN_MIN points that a third view confirms."""
    n_views = min(3, model.num_reg_images())  # of two photographs, all that there is
    seen = {image_id: 0 for image_id, image in model.images.items() if image.has_pose}
    for point in model.points3D.values():
        images = {element.image_id for element in point.track.elements}
        if len(images) >= n_views:
            for image_id in images:
                seen[image_id] += 1
    return [model.images[image_id].frame_id for image_id, n in seen.items() if n < SEEN_MIN]


def _size(model: Any) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def _result(mapper: str, features: str, models: list[Any]) -> Mapped:
    """Return a mapper's result of its models, the largest first."""
    if not models:
        return Mapped(mapper, features, None, 0, 0, ())
    others = tuple(model.num_reg_images() for model in models[1:])
    return Mapped(mapper, features, models[0], *_size(models[0]), others)
