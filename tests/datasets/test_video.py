"""Photographs from a video: the sharpest frame of each few, and the commands that take one."""

import subprocess
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
    assert default_matching(clip) == "sequential" and default_matching(tmp_path) == "auto"
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


# what phones and older cameras record


def make_clip(path, *options, filters="null", size=(64, 48)):
    """Twelve gray frames, of 20, 40, ... 240, which a filter has changed, at six in a second."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    raw = b"".join(bytes([20 * (k + 1)]) * (3 * size[0] * size[1]) for k in range(N))
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", str(FPS), "-i", "-"]
    command = [ffmpeg, "-loglevel", "error", "-y", *source, "-vf", filters, *options, str(path)]
    subprocess.run(command, input=raw, check=True)
    return path


def grays(folder):
    """The levels of all kept frames, to the nearest twenty."""
    return [20 * round(read_image(path)[5:-5, 5:-5].mean() / 20) for path in sorted(folder.iterdir())]


@pytest.mark.parametrize(
    ("name", "times"),
    [
        ("slower.mp4", "if(lt(N,6),N,6+4*(N-6))"),  # the second half in the dark, at a quarter of the rate
        ("uneven.mkv", "N+0.4*sin(5*N)"),
        ("pause.mov", "if(lt(N,3),N,N+20)"),
        ("faster.mp4", "if(lt(N,6),4*N,24+(N-6)/4)"),  # ffmpeg would leave some out
        ("moving.gif", "if(lt(N,6),N,6+4*(N-6))"),
    ],
)
def test_each_frame_of_a_variable_rate_counts_once(tmp_path, name, times):
    codec = [] if name.endswith(".gif") else ["-c:v", "libx264", "-qp", "0", "-pix_fmt", "yuv444p"]
    options = ("-fps_mode", "passthrough", "-enc_time_base", "1:1000", *codec)
    clip = make_clip(tmp_path / name, *options, filters=f"settb=1/1000,setpts='1000*({times})/{FPS}'")
    (tmp_path / "frames").mkdir()
    kept = keep_sharpest(clip, tmp_path / "frames", 1)
    assert [path.name for path in kept] == [f"frame_{k:05}.png" for k in range(N)]
    assert grays(tmp_path / "frames") == [20 * (k + 1) for k in range(N)]


@pytest.mark.parametrize(
    ("name", "aspect", "expected"),
    [
        ("anamorphic.mp4", "4/3", (85, 48)),  # 64 x 4/3 = 85.3
        ("dv.mov", "8/9", (64, 54)),
        ("wide.mkv", "2/1", (128, 48)),
        ("square.mp4", "1/1", (64, 48)),
        ("unknown.mp4", "0/1", (64, 48)),
    ],
)
def test_frames_have_square_pixels(tmp_path, name, aspect, expected, capfd):
    clip = make_clip(tmp_path / name, "-c:v", "libx264", "-pix_fmt", "yuv420p", filters=f"setsar={aspect}")
    (tmp_path / "frames").mkdir()
    kept = keep_sharpest(clip, tmp_path / "frames", 4)
    assert len(kept) == 3
    assert {read_image(path).shape for path in kept} == {(expected[1], expected[0], 3)}
    assert "frame size" not in capfd.readouterr().err


def test_square_pixels_of_a_turned_video(tmp_path):
    """A film of 64 x 48 that is shown upright: its pixels, wide when filmed, are high when shown."""
    clip = make_clip(tmp_path / "a.mp4", "-c:v", "libx264", "-pix_fmt", "yuv420p", filters="setsar=3/2")
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    turned = tmp_path / "turned.mp4"
    command = [ffmpeg, "-loglevel", "error", "-display_rotation", "90", "-i", str(clip), "-c", "copy", str(turned)]
    subprocess.run(command, check=True)
    (tmp_path / "frames").mkdir()
    kept = keep_sharpest(turned, tmp_path / "frames", 12)
    assert read_image(kept[0]).shape == (96, 48, 3)


@pytest.mark.parametrize(
    ("version", "option"),
    [
        ("4.2.2-static", "-vsync"),
        ("5.1", "-vsync"),
        ("7.0.2-static", "-fps_mode"),
        ("n9.0.2-17-g2a571b6068", "-fps_mode"),
        ("N-109445-g7d49fef8b4", "-fps_mode"),
    ],
)
def test_versions_of_ffmpeg_have_different_options(version, option):
    assert video._each_frame_once(version)[0] == option
