"""Recordings as phones and older cameras make them: frames at a variable rate, and pixels that are not square."""

import subprocess
from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from minisplat_ref.datasets.video import keep_sharpest
from minisplat_ref.io import read_image

N, SIZE, FPS = 10, (48, 36), 8  # of a clip
STEP = 24  # between the gray levels of its frames


def _clip(path: Path, filters: str, *options: str) -> Path:
    """Write a clip of gray frames, each brighter than the one before."""
    import imageio_ffmpeg

    raw = b"".join(bytes([STEP * (k + 1)]) * (3 * SIZE[0] * SIZE[1]) for k in range(N))
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{SIZE[0]}x{SIZE[1]}", "-r", str(FPS), "-i", "-"]
    program = imageio_ffmpeg.get_ffmpeg_exe()
    subprocess.run([program, "-loglevel", "error", *source, "-vf", filters, *options, str(path)], input=raw, check=True)
    return path


def _variable(folder: Path, name: str, times: str) -> None:
    """Each frame is kept once, in order."""
    codec = [] if name.endswith(".gif") else ["-c:v", "libx264", "-qp", "0", "-pix_fmt", "yuv444p"]
    filters = f"settb=1/1000,setpts='1000*({times})/{FPS}'"
    clip = _clip(folder / name, filters, "-fps_mode", "passthrough", "-enc_time_base", "1:1000", *codec)
    (folder / "frames").mkdir()
    grays = [read_image(path).mean() / STEP for path in keep_sharpest(clip, folder / "frames", 1)]
    assert np.array_equal(np.round(grays), np.arange(1, N + 1)), grays


def _aspect(folder: Path, name: str, ratio: str, size: tuple[int, int]) -> None:
    """Frames have square pixels."""
    clip = _clip(folder / name, f"setsar={ratio}", "-c:v", "libx264", "-pix_fmt", "yuv420p")
    (folder / "frames").mkdir()
    shapes = {read_image(path).shape for path in keep_sharpest(clip, folder / "frames", 3)}
    assert shapes == {(size[1], size[0], 3)}, shapes


CASES: Mapping[str, Callable[[Path], None]] = {
    **{
        f"video at a variable rate, {name}": partial(_variable, name=name, times=times)
        for name, times in (
            ("dim.mp4", "if(lt(N,4),N,4+5*(N-4))"),
            ("jitter.mov", "N+0.3*sin(3*N)"),
            ("bursts.mkv", "4*floor(N/2)+mod(N,2)/4"),
            ("animation.gif", "if(lt(N,7),N,7+3*(N-7))"),
        )
        if find_spec("imageio_ffmpeg")
    },
    **{
        f"video with pixels of {ratio}": partial(_aspect, name=name, ratio=ratio, size=size)
        for name, ratio, size in (
            ("pal.mov", "16/15", (51, 36)),
            ("ntsc.mp4", "10/11", (48, 40)),
            ("scope.mkv", "2/1", (96, 36)),
            ("square.mp4", "1/1", (48, 36)),
        )
        if find_spec("imageio_ffmpeg")
    },
}
