"""A film along the keyframes of a viewer."""

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from minisplat_ref.app.film import check_film, write_film
from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.app.viewer.layers import render_layer
from minisplat_ref.app.viewer.poses import Pose, camera_from_pose, travel
from minisplat_ref.io import write_image

FPS = 25.0


class Film(NamedTuple):
    """Options of a film."""

    path: Path
    """``.gif`` or ``.mp4``, which is replaced."""
    seconds: float
    width: int
    height: int
    layer: str


def write_travel(trained: Trained, keyframes: Sequence[Pose], film: Film, on_frame: Callable[[int, int], None]) -> int:
    """Render the path through keyframes, and write it as a film; return the number of its images.

    Parameters
    ----------
    trained : Trained
    keyframes : sequence of Pose
        In the frame of the model.
    film : Film
    on_frame : callable
        ``on_frame(done, total)``, after each image.

    Raises
    ------
    InputError
        The film cannot be written, there are fewer than two keyframes, or the renderer lacks the layer.
    """
    check_film(film.path, [(film.width, film.height)])
    path = travel(keyframes, max(2, round(FPS * film.seconds)))
    with TemporaryDirectory() as folder:
        files = [Path(folder) / f"{k:05d}.png" for k in range(len(path))]
        for k, (file, pose) in enumerate(zip(files, path, strict=True)):
            camera = camera_from_pose(pose, film.width, film.height)
            write_image(file, render_layer(trained, camera, film.layer, pose.time).image)
            on_frame(k + 1, len(path))
        write_film(film.path, files, FPS)
    return len(path)
