"""Files that differ from the usual in a way that does not matter, and videos without a picture."""

import io
import json
import shutil
import struct
import wave
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from data_tools.foreign_files.building import NAMES, done, refused, room
from data_tools.foreign_files.dialects import gaussians
from data_tools.foreign_files.leftovers import as_transforms
from minisplat_ref.io import load_ply, load_scene, save_ply


def _camera_model(folder: Path, model: str, entries: dict[str, float], is_lens: bool) -> None:
    """The name of a camera model in any case is that model."""
    scene = room(folder)
    expected = load_scene(scene, test_every=0).train_views
    content = as_transforms(load_scene(scene), camera_model=model, **entries)
    shutil.rmtree(scene / "sparse")
    (scene / "transforms.json").write_text(json.dumps(content))
    if is_lens:
        assert "has lens distortion" in refused("train", scene, "--out", folder / "run", names=scene)
    views = load_scene(scene, test_every=0, undistort=is_lens).train_views
    if not is_lens:
        assert [view.camera[2:8] for view in views] == [view.camera[2:8] for view in expected]
    assert "8 of 8 photographs have cameras" in done("info", scene).out


def _header(folder: Path, change: Callable[[bytes], bytes]) -> None:
    """A PLY whose header has more than it needs is read as without that."""
    save_ply(folder / "usual.ply", gaussians())
    head, end, body = (folder / "usual.ply").read_bytes().partition(b"end_header\n")
    (folder / "theirs.ply").write_bytes(change(head) + end + body)
    for value, other in zip(load_ply(folder / "theirs.ply"), gaussians(), strict=True):
        np.testing.assert_array_equal(value, other)
    done("info", folder / "theirs.ply")


def _comment(head: bytes, n: int) -> bytes:
    return head.replace(b"element", b"comment " + b"x" * n + b"\nelement", 1)


def _blank(head: bytes, before: bytes, line: bytes) -> bytes:
    return head.replace(before, line + before, 1)


def _without_end(folder: Path) -> None:
    """A header that only has blank lines after its properties is torn, and ends."""
    save_ply(folder / "usual.ply", gaussians())
    head, _, _ = (folder / "usual.ply").read_bytes().partition(b"end_header\n")
    (folder / "torn.ply").write_bytes(head + b"\n" * 5000)
    assert "no end_header" in refused("info", folder / "torn.ply", names=folder / "torn.ply")


def _without(folder: Path, name: str, is_binary: bool) -> None:
    """A model that lacks one of two files of newer versions has its cameras where they were."""
    scene = room(folder)
    expected = load_scene(scene, test_every=0).train_views
    model = scene / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(model))
    for file in model.iterdir():
        file.unlink()
    (reconstruction.write_binary if is_binary else reconstruction.write_text)(str(model))
    (model / name).unlink()
    for view, other in zip(load_scene(scene, test_every=0).train_views, expected, strict=True):
        np.testing.assert_allclose(view.camera.cam_from_world_t, other.camera.cam_from_world_t, atol=1e-9)
    assert "8 of 8 photographs have cameras" in done("info", scene).out


def _smaller(folder: Path, suffix: str, kind: str) -> None:
    """Smaller copies in another format are used."""
    scene = room(folder)
    (scene / "images_2").mkdir()
    for i, name in enumerate(NAMES):
        Image.new("RGB", (24, 18), (10 * i, 20 * i, 200)).save(scene / "images_2" / f"{name}{suffix}", kind, quality=95)
    views = load_scene(scene, downscale=2, test_every=0).train_views
    colors = np.array([view.image.reshape(-1, 3).mean(axis=0) for view in views])
    np.testing.assert_allclose(colors, [(10 * i, 20 * i, 200) for i in range(8)], atol=3)


def _two_smaller(folder: Path) -> None:
    """Which of two copies is meant is not guessed."""
    scene = room(folder)
    (scene / "images_2").mkdir()
    for suffix in (".jpg", ".webp"):
        Image.new("RGB", (24, 18)).save(scene / "images_2" / f"{NAMES[1]}{suffix}")
    line = refused("train", scene, "--downscale", 2, "--out", folder / "run", names=f"images_2/{NAMES[1]}.png")
    assert "no such image" in line


def _video(folder: Path, name: str, content: bytes, says: str) -> None:
    """A video without a picture is refused in a line that says so, without what ffmpeg says of itself."""
    (folder / name).write_bytes(content)
    for command in ("sfm", "photos"):
        line = refused(command, folder / name, "--out", folder / command, names=folder / name)
        assert says in line and "ffmpeg version" not in line and "stderr" not in line, line
        assert len(line) < 300
    assert not (folder / "sfm").exists()


def _sound(n_channels: int, rate: int) -> bytes:
    file = io.BytesIO()
    with wave.open(file, "wb") as sound:
        sound.setnchannels(n_channels)
        sound.setsampwidth(2)
        sound.setframerate(rate)
        sound.writeframes(np.zeros(n_channels * rate, np.int16).tobytes())
    return file.getvalue()


def _box(kind: bytes, content: bytes = b"") -> bytes:
    return struct.pack(">I", 8 + len(content)) + kind + content


BEGUN = _box(b"ftyp", b"isom\0\0\2\0isomiso2mp41") + _box(b"mdat", bytes(500))  # recording was cut off before its index
VIDEOS = {
    "sound.mp4": (_sound(1, 8000), "sound and no picture"),
    "stereo.mkv": (_sound(2, 44100), "sound and no picture"),
    "sound.mov": (_sound(2, 8000), "sound and no picture"),
    "cut off.mp4": (BEGUN, "moov atom not found"),
    "empty.mp4": (b"", "not a video"),
    "noise.webm": (np.random.default_rng(0).bytes(3000), "not a video"),
    "text.avi": (b"hello " * 100, "not a video"),
}

CASES: dict[str, Callable[[Path], None]] = {
    **{
        f"camera_model {model}": partial(_camera_model, model=model, entries=entries, is_lens=is_lens)
        for model, entries, is_lens in (
            ("pinhole", {}, False),
            ("Simple_Pinhole", {}, False),
            ("perspective", {}, False),
            ("opencv", {"k1": 0.02}, True),
            ("fisheye", {"k1": 0.02}, True),
        )
    },
    **{f"comment of {n}": partial(_header, change=partial(_comment, n=n)) for n in (4090, 6000, 100_000)},
    **{
        f"blank line before {before.decode()}{' of spaces' if line != b'@' else ''}": partial(
            _header, change=partial(_blank, before=before, line=line.replace(b"@", b"\n"))
        )
        for before, line in ((b"format", b"@"), (b"element", b"@"), (b"property float opacity", b" \t@"))
    },
    "blank lines without an end": _without_end,
    **{
        f"without {name}": partial(_without, name=name, is_binary=name.endswith("bin"))
        for name in ("frames.bin", "rigs.bin", "frames.txt", "rigs.txt")
    },
    **{
        f"images_2 of {suffix}": partial(_smaller, suffix=suffix, kind=kind)
        for suffix, kind in ((".jpg", "JPEG"), (".JPG", "JPEG"), (".webp", "WEBP"), (".jfif", "JPEG"))
    },
    "images_2 with two": _two_smaller,
    **{
        f"video {name}": partial(_video, name=name, content=content, says=says)
        for name, (content, says) in VIDEOS.items()
        if find_spec("imageio_ffmpeg")
    },
}
