"""Photographs from a video: the sharpest frame of each few, and the commands that take one."""

import sys

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy import ndimage

from minisplat_ref.app.cli import main
from minisplat_ref.datasets import video
from minisplat_ref.datasets.sfm import default_matching, run_sfm
from minisplat_ref.datasets.video import is_video, keep_sharpest, sharpness
from minisplat_ref.errors import InputError
from minisplat_ref.io.images import read_image

# imageio_ffmpeg leaves the pipes of ffmpeg, which has ended, to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

N, WIDTH, HEIGHT, FPS = 12, 64, 48, 6
SHARP = {1, 5, 6, 10}  # frames that were not blurred


def frames():
    noise = np.random.default_rng(0).uniform(0, 255, (HEIGHT, WIDTH, 3))
    for k in range(N):
        yield ndimage.gaussian_filter(noise, (1 if k in SHARP else 3,) * 2 + (0,)).astype(np.uint8)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path_factory.mktemp("videos") / "walk.mp4"
    with imageio.get_writer(path, fps=FPS, macro_block_size=1, quality=9) as writer:
        for frame in frames():
            writer.append_data(frame)
    return path


def test_sharpness_by_hand():
    """A step of 100 along x: the Laplacian is 100 on one side, -100 on the other, in 2 of 4 columns."""
    frame = np.zeros((5, 4, 3), np.uint8)
    frame[:, 2:] = 100
    assert sharpness(frame) == pytest.approx(100**2 / 2)
    assert sharpness(np.full((5, 4, 3), 80, np.uint8)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("every", "expected"), [(4, [1, 5, 10]), (12, None), (None, [1, 5, 6, 10])])
def test_the_sharpest_of_each_few_is_kept(clip, tmp_path, every, expected):
    """Half a second is three frames here."""
    names = [path.name for path in keep_sharpest(clip, tmp_path, every)]
    if expected is None:
        assert len(names) == 1 and int(names[0][6:11]) in SHARP
    else:
        assert names == [f"frame_{k:05}.png" for k in expected]
    assert_array_equal(sorted(path.name for path in tmp_path.iterdir()), sorted(names))
    assert read_image(tmp_path / names[0]).shape == (HEIGHT, WIDTH, 3)


def test_the_frames_that_are_left_at_the_end_count_too(clip, tmp_path):
    assert len(keep_sharpest(clip, tmp_path, 5)) == 3  # 5, 5 and 2


def test_a_video_is_matched_with_neighbours(clip, tmp_path):
    assert default_matching(clip) == "sequential" and default_matching(tmp_path) == "exhaustive"
    assert is_video(clip) and not is_video(tmp_path) and not is_video(tmp_path / "no.mp4")


@pytest.mark.parametrize("command", ["sfm", "photos"])
def test_a_command_takes_a_video(clip, tmp_path, command, monkeypatch, capsys):
    """Noise finds no place; nothing of it is left."""
    pytest.importorskip("pycolmap")
    assert main([command, str(clip), "--out", str(tmp_path / "out")]) == 2
    assert "walk.mp4: no two photographs could be placed" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.png"))


def test_what_is_no_video(clip, tmp_path, monkeypatch, capsys):
    damaged = tmp_path / "bad.mp4"
    damaged.write_bytes(b"not a video")
    with pytest.raises(InputError, match=r"bad\.mp4: not a video that ffmpeg reads"):
        keep_sharpest(damaged, tmp_path)
    with pytest.raises(InputError, match=r"--every is for a video"):
        run_sfm(tmp_path, tmp_path / "out", every=3)
    monkeypatch.setattr(video, "_read", lambda *_: (iter(()), 2))
    with pytest.raises(InputError, match=r"walk\.mp4: no frames in it"):
        keep_sharpest(clip, tmp_path)
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main(["sfm", str(clip), "--out", str(tmp_path / "out")]) == 2
    assert "pip install 'minisplat_ref[video]'" in capsys.readouterr().err
