"""Arguments, scenes and output that the studies of several extensions share."""

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from minisplat_ref.datasets.synthetic import SCENE_NAMES, make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.sampling import block_means, zoom_camera
from minisplat_ref.types import Floats, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PNG_DPI = 150
Item = TypeVar("Item")
GRID_COLOR = "#e6eaee"


def add_out(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``."""
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="new folder for result.json and figure.png"
    )


def add_scene(parser: argparse.ArgumentParser, downscale: int, iterations: int) -> None:
    """Add the scene, ``--downscale``, ``--iterations``, ``--seeds`` and ``--out`` with their defaults."""
    parser.add_argument(
        "scene",
        nargs="?",
        default="room",
        metavar="SCENE",
        help=f"folder of a scene, or a synthetic one: {', '.join(SCENE_NAMES)} (default room)",
    )
    parser.add_argument(
        "--downscale", type=int, default=downscale, metavar="D", help=f"train at 1/D of its size (default {downscale})"
    )
    parser.add_argument(
        "--iterations", type=int, default=iterations, metavar="N", help=f"per training (default {iterations})"
    )
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="number of seeds, from 0 on (default 2)")
    add_out(parser)


def check_at_least(least: int, **numbers: int) -> None:
    """Refuse arguments that are too small.

    Raises
    ------
    InputError
        One of them is below ``least``.
    """
    for name, number in numbers.items():
        if number < least:
            raise InputError(f"--{name} is {number}: give at least {least}")


def read_scene(source: str, downscale: int = 1) -> Scene:
    """Load a scene from a folder, with photographs ``downscale`` times smaller, or make the synthetic one of that name.

    Raises
    ------
    InputError
        ``source`` is neither, has no test views, or is a synthetic scene that is to be made smaller.
    """
    from minisplat_ref.io import load_scene

    if Path(source).exists():
        scene = load_scene(source, downscale=downscale)
    elif source in SCENE_NAMES:
        if downscale != 1:
            raise InputError(f"{source} is made at 160 x 120: leave --downscale out, or give the folder of a scene")
        scene = make_scene(source).scene
    else:
        raise InputError(f"{source}: neither a folder nor one of {', '.join(SCENE_NAMES)}; give a scene")
    if not scene.test_views:
        raise InputError(f"scene {scene.name} has no test views to measure: add photographs")
    return scene


def shrunk(scene: Scene, n: int) -> Scene:
    """Return the scene with photographs of 1/n of the size, by :func:`block_means`.

    Raises
    ------
    InputError
        A photograph has fewer than 16 n pixels a side.
    """
    if n == 1:
        return scene
    views = []
    for view in scene.train_views:
        photograph = view.load()
        camera = zoom_camera(photograph.camera, 1 / n)
        if min(camera.width, camera.height) < 16:
            raise InputError(f"photograph {view.name} at 1/{n} of its size has fewer than 16 pixels: lower --downscale")
        image = np.rint(block_means(photograph.image.astype(np.float64), n)).astype(np.uint8)
        views.append(photograph._replace(camera=camera, image=image, mask=None))
    return scene._replace(train_views=tuple(views))


def with_progress(items: Iterable[Item], description: str) -> Iterable[Item]:
    """Return an iterable that shows a progress bar while it is consumed; none is shown outside a terminal."""
    from tqdm import tqdm

    bar: Iterable[Item] = tqdm(items, desc=description, leave=False, disable=None)
    return bar


def psnr_of(image: Floats, target: Floats) -> float:
    """Return the PSNR of a picture clipped to [0, 1], dB."""
    return float(-10 * np.log10(np.mean((np.clip(image, 0, 1).astype(np.float64) - target) ** 2)))


def tidy(axes: "Axes") -> None:
    """Remove the upper and right spines, and draw a pale grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color=GRID_COLOR)
    axes.set_axisbelow(True)


def write(folder: Path, result: dict[str, Any], figure: "Figure") -> None:
    """Write ``result.json`` and ``figure.png`` to a folder that exists."""
    (folder / "result.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    figure.savefig(folder / "figure.png", dpi=PNG_DPI, facecolor="white")
