"""Films from the images of a rendering: GIF by Pillow, MP4 (H.264) by imageio and its ffmpeg, which are optional."""

import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.images import read_image

SUFFIXES = (".gif", ".mp4")
N_COLORS = 256  # a GIF holds no more in a frame
MP4_OPTIONS: dict[str, Any] = {
    "format": "FFMPEG",
    "codec": "libx264",
    "pixelformat": "yuv420p",  # which every player supports
    "quality": 8,  # of 10
    "macro_block_size": 2,  # yuv420p has even widths and heights
}


def check_film(path: Path, sizes: Sequence[tuple[int, int]]) -> None:
    """Refuse a film that cannot be written, before its images are rendered.

    Parameters
    ----------
    path : Path
        The film.
    sizes : sequence of (width, height)
        Of its images, pixels.

    Raises
    ------
    InputError
        The suffix is unknown, imageio is missing, the folder does not exist, or the images differ in size.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a film is {' or '.join(SUFFIXES)}; give one of these suffixes")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: the folder {path.absolute().parent} does not exist; create it first")
    if different := sorted(set(sizes)):
        if len(different) > 1:
            (width, height), (other_width, other_height) = different[:2]
            raise InputError(
                f"{path}: the images of a film have one size, and these are {width} x {height} and {other_width} x"
                f" {other_height}: give --cameras orbit"
            )
        if path.suffix.lower() == ".mp4" and min(different[0]) < 2:
            raise InputError(f"{path}: an MP4 is at least 2 x 2 pixels; give a larger --size")
    if path.suffix.lower() == ".mp4":
        _import_imageio(path)


def write_film(path: Path, paths: Sequence[Path], fps: float) -> None:
    """Write images as a film, which a GIF repeats without end.

    Parameters
    ----------
    path : Path
        ``.gif`` or ``.mp4``, see :func:`check_film`.
    paths : sequence of Path
        Image files of one size, in order. One is read at a time. An MP4 loses the last row or column of an odd size.
    fps : float
        Images per second. A GIF counts in hundredths of a second.
    """
    with replacing(path) as temporary:
        if path.suffix.lower() == ".gif":
            _write_gif(temporary, paths, fps)
        else:
            _write_mp4(temporary, paths, fps)


def _write_gif(film: Path, paths: Sequence[Path], fps: float) -> None:
    frames = (Image.fromarray(np.asarray(read_image(path))).quantize(N_COLORS) for path in paths)
    first = next(frames)
    hundredths = max(1, round(100 / fps))
    first.save(film, format="GIF", save_all=True, append_images=frames, duration=10 * hundredths, loop=0)


def _write_mp4(film: Path, paths: Sequence[Path], fps: float) -> None:
    with TemporaryDirectory(dir=film.parent) as folder:
        unfinished = Path(folder) / "film.mp4"  # imageio refuses other suffixes
        with _import_imageio(film).get_writer(unfinished, fps=fps, **MP4_OPTIONS) as writer:
            for path in paths:
                image = read_image(path)  # [H, W, 3]
                writer.append_data(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])
        os.replace(unfinished, film)


def _import_imageio(path: Path) -> Any:
    try:
        import imageio.v2
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        raise InputError(
            f"{path}: MP4 needs imageio with ffmpeg: pip install 'minisplat_ref[video]', or give a .gif"
        ) from None
    return imageio.v2
