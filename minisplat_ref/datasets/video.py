"""Photographs from a video: the sharpest of every few frames.

A hand that holds a camera moves unevenly, so of neighbouring frames some are sharp and some are blurred. Sharpness is
the mean square of the Laplacian of the brightness: between frames of one place it falls with blur, while values of
different places cannot be compared.

Each frame that is stored counts once. Phones film at a variable rate, and ffmpeg by itself would repeat frames until
the rate is constant. Frames whose pixels are not square, as in DV, AVCHD or anamorphic films, are enlarged along one
side, because a camera of one focal length has square ones.
"""

import logging
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from minisplat_ref.constants import LUMA
from minisplat_ref.errors import InputError, one_line
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.images import DAMAGE_ERRORS, write_image

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp", ".gif")
AUDIO, PICTURE = re.compile(r"Stream #\S+.*: Audio:"), re.compile(r"Stream #\S+.*: Video:")
CAUSE = re.compile(r"moov atom not found|Invalid data found when processing input|No such file or directory", re.I)
SQUARE_PIXELS = "scale=w='if(gt(sar,1),round(iw*sar),iw)':h='if(lt(sar,1),round(ih/sar),ih)',setsar=1"
SECONDS = 0.5  # of a video, from which one frame is kept


def is_video(path: Path) -> bool:
    """Return whether a path is a file with the suffix of a video."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def keep_sharpest(video: Path, folder: Path, every: int | None = None) -> list[Path]:
    """Write the sharpest of every few frames into a folder, with square pixels, as ``frame_00017.png``.

    Parameters
    ----------
    video : Path
        What ffmpeg reads.
    folder : Path
        It exists.
    every : int, optional
        Frames of which one is kept; those of half a second by default.

    Raises
    ------
    InputError
        ffmpeg is missing, the file is no video, or it has no frames.
    """
    kept: list[Path] = []
    best: tuple[float, int, NDArray[np.uint8]] | None = None
    frames, every = _read(video, every)
    for i, frame in enumerate(with_progress(frames, "reading the video", "frames")):
        value = sharpness(frame)
        if best is None or value > best[0]:
            best = value, i, frame
        if (i + 1) % every == 0:
            kept.append(_write(folder, best))
            best = None
    if best is not None:
        kept.append(_write(folder, best))
    if not kept:
        raise InputError(f"{video}: no frames in it; record it again, or export it as MP4")
    return kept


def sharpness(frame: NDArray[np.uint8]) -> float:
    """Return the mean square of the Laplacian of the brightness of a frame [H, W, 3]."""
    return float(np.mean(ndimage.laplace(frame.astype(np.float32) @ np.array(LUMA, np.float32)) ** 2))


def _write(folder: Path, best: tuple[float, int, NDArray[np.uint8]]) -> Path:
    path = folder / f"frame_{best[1]:05}.png"
    write_image(path, best[2])
    return path


def _read(video: Path, every: int | None) -> tuple[Iterator[NDArray[np.uint8]], int]:
    """Return the frames [H, W, 3], and the number of them of which one is kept."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise InputError(
            f"{video}: videos need ffmpeg: pip install 'minisplat_ref[video]', or give a folder of frames"
        ) from None
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)  # it warns of sizes that are changed on purpose
    once = _each_frame_once(imageio_ffmpeg.get_ffmpeg_version())
    stream: Any = imageio_ffmpeg.read_frames(str(video), output_params=[*once, "-vf", SQUARE_PIXELS])
    try:
        about = next(stream)  # of the whole video; frames follow
    except (*DAMAGE_ERRORS, StopIteration) as error:
        raise InputError(f"{video}: {_reason(str(error), video)}; export it as MP4") from error
    per_second = max(float(about["fps"]), 1.0)
    return _frames(stream, about["size"], video), max(1, round(SECONDS * per_second)) if every is None else every


def _each_frame_once(version: str) -> list[str]:
    """Return the options of an ffmpeg for frames that are neither repeated nor left out."""
    found = re.match(r"\D*(\d+)", version)
    is_old = found is not None and int(found[1]) < 6  # 5.1 has both options, 8 has lost the older one
    return ["-vsync", "0"] if is_old else ["-fps_mode", "passthrough"]


def _reason(log: str, video: Path) -> str:
    """Return why ffmpeg does not read a file, from what it printed, of which most is about itself."""
    if AUDIO.search(log) and not PICTURE.search(log):
        return "it has sound and no picture"
    lines = [line.strip() for line in log.splitlines()]
    named = [line.partition(str(video))[2].lstrip(": ") for line in lines if line.startswith(("Error opening", "[in#"))]
    causes = [line for line in lines if CAUSE.search(line)]
    cause = CAUSE.search(causes[0]) if causes else None
    reason = cause[0] if cause else next((text for text in named if text), "it is damaged or of another kind")
    return f"not a video that ffmpeg reads ({reason})"


def _frames(stream: Any, size: tuple[int, int], video: Path) -> Iterator[NDArray[np.uint8]]:
    width, height = size
    with closing(stream):
        try:
            for pixels in stream:
                yield np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
        except DAMAGE_ERRORS as error:
            raise InputError(one_line(f"{video}: cannot be decoded ({error}); export it as MP4")) from error
