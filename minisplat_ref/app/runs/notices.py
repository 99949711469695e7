"""Warnings that do not stop a run: a scene without points, photographs of a few pixels, no Gaussians.

Each is one line, which the command line prints before it continues.
"""

import math
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from minisplat_ref.errors import InputWarning, one_line
from minisplat_ref.io.frames import describe_frame
from minisplat_ref.io.images import SIDE_MIN
from minisplat_ref.io.inventory import warn_of_unused
from minisplat_ref.strategy.initialization import N_NEIGHBOURS, N_RANDOM_POINTS
from minisplat_ref.strategy.track_gains import estimate_gains
from minisplat_ref.types import FILE_FRAME, Model, Scene

N_SIZES = 3  # of photographs that are all named
N_NAMED = 3  # photographs of unusual exposure that are named
FEW_POINTS = 20  # sparse points that are too few for a scene


def warn_of_scene(scene: Scene, *, is_dense: bool = False) -> None:
    """Warn about properties of a scene that prevent a good training.

    Parameters
    ----------
    scene : Scene
    is_dense : bool
        Whether stereo adds points to the sparse ones.
    """
    n = len(scene.points)
    if n < FEW_POINTS:
        start = "those that stereo finds in the photographs"
        if not is_dense:
            start = f"{n} Gaussians" if n > N_NEIGHBOURS else f"{N_RANDOM_POINTS:,} random ones among the cameras"
        _warn(
            f"scene {scene.name} has {n} sparse points: training begins with {start} and has to find the surfaces by"
            " itself; `minisplat-ref sfm PHOTOS --out SCENE` makes points, and a transforms.json names a file of them"
            " as ply_file_path"
        )
    sizes = [(view.camera.width, view.camera.height) for view in scene.train_views]
    width, height = min(sizes, key=min)
    if min(width, height) < SIDE_MIN:
        _warn(
            f"photographs of scene {scene.name} are {width} x {height} pixels: give larger ones; from fewer than"
            f" {SIDE_MIN} x {SIDE_MIN} hardly any structure can be learned, and measures of them say little"
        )


def report_inventory(path: Path, scene: Scene, model: str | None) -> None:
    """Report how many photographs of a scene's folder have cameras; warn of files that are not used."""
    inventory = warn_of_unused(path, scene, model)
    if not inventory.unused:
        print(f"{scene.name}: {inventory.line}")


def describe_place(scene: Scene) -> str:
    """Return a sentence about the frame of a scene, empty where it is that of its files."""
    if scene.frame == FILE_FRAME:
        return ""
    extent = scene.frame.unit * scene.extent
    distance = math.hypot(*scene.frame.origin)
    far = f", {distance:.4g} from the origin" if distance else ""
    return (
        f"scene {scene.name} is {extent:.4g} units large{far}: while it is trained it is {describe_frame(scene.frame)};"
        " files keep its coordinates"
    )


def describe_exposures(scene: Scene) -> str:
    """Describe the exposures of the training photographs, as the tracks of their sparse points show them."""
    gains = estimate_gains(scene)
    factors = np.exp(gains.log_gains.mean(axis=1))
    far = [f"{scene.train_views[row].name} {factors[row]:.2f}" for row in gains.outliers[:N_NAMED]]
    rest = f" and {len(gains.outliers) - N_NAMED} more" if len(gains.outliers) > N_NAMED else ""
    return gains.describe() + (f"; far from the others, as a factor: {', '.join(far)}{rest}" if far else "")


def describe_sizes(sizes: Sequence[tuple[int, int]]) -> str:
    """Return the sizes (width, height) of photographs in half a line, with the number of each if they are mixed."""
    counts = sorted(Counter(sizes).items(), reverse=True)
    if len(counts) == 1:
        return f"{sizes[0][0]} x {sizes[0][1]}"
    if len(counts) <= N_SIZES:
        return " and ".join(f"{width} x {height} ({n} of them)" for (width, height), n in counts)
    (min_width, min_height), (width, height) = (pick(sizes, key=math.prod) for pick in (min, max))
    n_portrait = sum(width < height for width, height in sizes)
    return (
        f"{len(counts)} sizes from {min_width} x {min_height} to {width} x {height} ({len(sizes) - n_portrait}"
        f" landscape, {n_portrait} portrait)"
    )


def warn_of_model(model: Model, source: object) -> None:
    """Warn of a model of nothing; ``source`` is the file or folder that it comes from."""
    if len(model.gaussians.means) == 0:
        _warn(f"{source} holds no Gaussians: every image shows the background alone; give another file or train again")


def _warn(message: str) -> None:
    warnings.warn(one_line(message), InputWarning, stacklevel=3)
