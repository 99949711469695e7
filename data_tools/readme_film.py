"""The README's film: once around a trained scene, and beyond a line that moves, the Gaussians that it consists of.

::

    minisplat-ref train BANANA --out runs/banana
    python -m data_tools.readme_film runs/banana

On the right of the line every Gaussian has a third of its size, so that single ones are seen. The line crosses the
images while the camera goes around, and is back where it began when the camera is. BANANA is the data set of the
README's figure (``minisplat-ref data banana``), whose licence lies beside both.
"""

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from data_tools.readme_figure import DOCS
from minisplat_ref.app.reports.images import to_8_bits
from minisplat_ref.app.runs.model_source import Source, open_source
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.orbits import orbit
from minisplat_ref.types import view_from

SHRUNK = math.log(1 / 3)  # added to the logarithms of all scales
FPS = 10.0
LINE = 2  # pixels
LINE_COLOR = 255
BYTES_MAX = 600_000  # of the film: the README is read on phones, too


def main() -> None:
    """Write the film."""
    parser = argparse.ArgumentParser(description="Render the README's film.")
    parser.add_argument("run", type=Path, metavar="RUN", help="the --out folder of a training")
    parser.add_argument("--frames", type=int, default=48, metavar="N", help="images of the film (default 48)")
    parser.add_argument("--width", type=int, default=360, metavar="PX", help="of the images (default 360)")
    parser.add_argument("--quality", type=int, default=35, metavar="Q", help="of WebP, 0 to 100 (default 35)")
    parser.add_argument(
        "--out", type=Path, default=DOCS / "figures" / "readme.webp", metavar="WEBP", help="file to write"
    )
    args = parser.parse_args()
    write(args.out, film(open_source(args.run), args.frames, args.width), args.quality)
    print(f"{args.out}: {args.out.stat().st_size:,} bytes")


def film(source: Source, n_frames: int, width: int) -> list[NDArray[np.uint8]]:
    """Return the images [H, W, 3] of the film.

    Parameters
    ----------
    source : Source
        A run, whose training cameras the path follows.
    n_frames, width : int
        Number of images, and their width in pixels; their height follows from the photographs.
    """
    cameras = [view for view in source.cameras if view.split != "test"]
    if not cameras:
        raise InputError("the film follows the training cameras of a run: give the folder of a training")
    like = cameras[0].camera
    height = 2 * round(width * like.height / like.width / 2)
    model = source.trained.model
    small = model._replace(gaussians=model.gaussians._replace(log_scales=model.gaussians.log_scales + SHRUNK))
    images = []
    path = orbit(model.gaussians.means, cameras, n_frames, width, height)
    for k, place in enumerate(with_progress(path, "rendering", "images")):
        view = view_from(place.camera, time=place.time)
        whole, parts = (
            to_8_bits(source.trained._replace(model=shown).render(view).image[..., :3]) for shown in (model, small)
        )
        images.append(divided(whole, parts, 0.5 - 0.5 * math.cos(2 * math.pi * k / n_frames)))
    return images


def divided(left: NDArray[np.uint8], right: NDArray[np.uint8], share: float) -> NDArray[np.uint8]:
    """Return an image of which ``share`` is ``right``, with a white line between both where both are seen."""
    width = left.shape[1]
    column = width - round(share * width)
    image = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    if 0 < column < width:
        image[:, max(0, column - LINE // 2) : column + LINE // 2] = LINE_COLOR
    return image


def write(out: Path, images: list[NDArray[np.uint8]], quality: int) -> None:
    """Write a film in WebP that repeats without end.

    Raises
    ------
    InputError
        It would be larger than BYTES_MAX.
    """
    first, *others = [Image.fromarray(image) for image in images]
    settings: dict[str, Any] = {"quality": quality, "method": 6, "minimize_size": True}
    with replacing(out) as temporary:
        first.save(
            temporary, "WEBP", save_all=True, append_images=others, duration=round(1000 / FPS), loop=0, **settings
        )
        if (n_bytes := temporary.stat().st_size) > BYTES_MAX:
            raise InputError(f"{out} would have {n_bytes:,} bytes: lower --frames, --width or --quality")


if __name__ == "__main__":
    main()
