"""One file to send: its arrays worked out by hand, what it refuses, and the picture that a browser makes of it."""

import base64
import gzip
import io
import json
import re
import time

import numpy as np
import pytest
from PIL import Image

from browser import WEBGL, Browser, find_browser
from compact import population, refused_line
from minisplat_ref.app.cli import main
from minisplat_ref.app.viewer.page import pack, write_page
from minisplat_ref.io import save_ply
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Camera, Gaussians

SECONDS = 60.0  # until the picture must be there; it takes two on an idle machine
SIZE = (96, 72)
BACKGROUND = np.array([0.1, 0.2, 0.3])
UP = np.array([0.0, -1.0, 0.0])
PSNR_MIN = 52.0  # dB: pixels of 8 bits alone cost 59 dB; harmonics in 8 bits and blending in half floats the rest
PSNR_OF_ANOTHER = 25.0  # dB that a wrong order of the quaternion's components must not reach


def one():
    return Gaussians(
        means=np.array([[1.0, -2.0, 0.5], [0.0, 0.0, 4.0]], np.float32),
        quats=np.array([[2.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0]], np.float32),
        log_scales=np.array([[-10.0, -5.0, 0.0], [0.0, 0.0, 0.0]], np.float32),
        opacity_logits=np.array([0.0, 90.0], np.float32),
        sh_dc=np.array([[1.0, -2.0, 0.5], [0.0, 0.0, 0.0]], np.float32),
        sh_rest=np.array([[[0.254, 0.0, -0.126], [0, 0, 0], [0, 0, 0]], np.zeros((3, 3))], np.float32),
    )


def page_of(title, gaussians, views):
    return b"".join(write_page(title, gaussians, views, BACKGROUND, UP)).decode()


def test_arrays_by_hand():
    header, content = pack(one())
    raw = gzip.decompress(content)
    assert header["n"] == 2 and header["n_rest"] == 3
    assert header["scale_low"] == -10.0 and header["scale_step"] == pytest.approx(10 / 65535)
    assert header["sh_step"] == pytest.approx(0.254 / 127)
    assert len(raw) == 2 * (12 + 6 + 8 + 2 + 6 + 9)
    np.testing.assert_array_equal(np.frombuffer(raw, "<f4", 6), [1, -2, 0.5, 0, 0, 4])
    np.testing.assert_array_equal(np.frombuffer(raw, "<u2", 6, 24), [0, 32768, 65535, 65535, 65535, 65535])
    np.testing.assert_array_equal(np.frombuffer(raw, "<i2", 8, 36), [32767, 0, 0, 0, 0, 0, -23170, 23170])
    np.testing.assert_array_equal(np.frombuffer(raw, "<u2", 2, 52), [32768, 65535])  # 32767.5 to the even one
    np.testing.assert_array_equal(np.frombuffer(raw, "<f2", 6, 56), [1, -2, 0.5, 0, 0, 0])
    np.testing.assert_array_equal(np.frombuffer(raw, "i1", 3, 68), [127, 0, -63])


def parts(page):
    """The scene and the arrays' bytes of a page."""
    scene = re.search(r'id="scene">(.*?)</script>', page, re.DOTALL).group(1)
    gaussians = re.search(r'id="gaussians">(.*?)</script>', page, re.DOTALL).group(1)
    return json.loads(scene), gzip.decompress(base64.b64decode(gaussians))


def camera():
    return Camera(np.eye(3), np.array([0.0, 0.0, 1.0]), 80.0, 80.0, 50.0, 34.0, *SIZE)


def test_a_page_holds_its_cameras_and_loads_nothing():
    page = page_of("<fox> & co", one(), [Viewpoint("</script>", camera(), "train")])
    assert "<title>&lt;fox&gt; &amp; co</title>" in page
    assert not re.findall(r"(?:src|href)=|https?:", page)
    scene, _ = parts(page)
    view = scene["views"][0]
    assert view["name"] == "</script>" and view["position"] == [0.0, 0.0, -1.0] and view["cx"] == 50.0
    assert scene["background"] == BACKGROUND.tolist() and scene["target"][:2] == [0.0, 0.0]


def test_a_camera_on_its_side_is_turned_upright():
    """What was up is at the right of its image; the page gets an image that is higher than wide, and what is up."""
    up = np.array([1.0, 0.0, 0.0])
    scene, _ = parts(b"".join(write_page("a", one(), [Viewpoint("a", camera(), "train")], BACKGROUND, up)).decode())
    (view,) = scene["views"]
    assert (view["width"], view["height"]) == SIZE[::-1] and scene["up"] == up.tolist()
    assert view["R"] == [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]


@pytest.mark.parametrize("n", [0, 3])
def test_without_cameras_there_is_a_circle(n, tmp_path, capsys):
    save_ply(tmp_path / "a.ply", population(n))
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.HTML")]) == 0
    assert f"{n} Gaussians of a.ply" in capsys.readouterr().out
    scene, raw = parts((tmp_path / "a.HTML").read_text())
    assert len(scene["views"]) == 8 and len(raw) == n * (12 + 6 + 8 + 2 + 6 + 45)


def test_what_a_page_does_not_take(tmp_path, capfd):
    save_ply(tmp_path / "a.ply", population(3))
    line = refused_line(capfd, tmp_path, "convert", tmp_path / "a.ply", tmp_path / "a.html", "--level", 0)
    assert "a page has one precision, so --level means nothing" in line
    save_ply(tmp_path / "a.ply", population(3)._replace(sh_dc=np.full((3, 3), 1e6, np.float32)))
    assert "1e+06, beyond 65504" in refused_line(capfd, tmp_path, "convert", tmp_path / "a.ply", tmp_path / "a.html")


def scene_before_the_camera():
    """Long Gaussians of full colour and strong harmonics, some of them behind, at the border and before the camera."""
    rng = np.random.default_rng(5)
    n = 60
    means = rng.uniform([-1.5, -1.2, -2.0], [1.5, 1.2, 3.0], (n, 3))
    log_scales = np.log(rng.uniform([0.3, 0.005, 0.005], [0.6, 0.06, 0.06], (n, 3)))
    fields = (
        means,
        rng.normal(size=(n, 4)),
        log_scales,
        rng.normal(2.0, 3.0, n),
        rng.normal(size=(n, 3)),
        rng.normal(0, 0.2, (n, 15, 3)),
    )
    return Gaussians(*(field.astype(np.float32) for field in fields))


def psnr(image, other):
    return -10 * np.log10(np.mean((image - other) ** 2))


def picture(browser, path):
    """What a browser shows of a page in a window of SIZE, without the bar."""
    browser.open(path, width=SIZE[0])
    width, height = SIZE
    browser.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
    browser.run("document.body.classList.add('bare')")
    end = time.perf_counter() + SECONDS
    while browser.run("innerHeight + document.body.dataset.drawn + document.querySelector('canvas').height") != "72072":
        assert time.perf_counter() < end, browser.run("document.getElementById('problem').textContent")
        time.sleep(0.05)
    data = base64.b64decode(browser.send("Page.captureScreenshot", format="png")["data"])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) / 255.0


@pytest.mark.interop
def test_a_browser_shows_what_we_render(tmp_path):
    program = find_browser()
    if program is None:
        pytest.skip("no Chromium on the PATH")
    gaussians = scene_before_the_camera()
    output, _ = render(gaussians, camera(), background=BACKGROUND, backend=REFERENCE)
    ours = np.clip(output.image, 0.0, 1.0)
    views = [Viewpoint("0001", camera(), "train")]
    (tmp_path / "right.html").write_text(page_of("right", gaussians, views))
    xyzw = gaussians._replace(quats=np.roll(gaussians.quats, -1, axis=1))
    (tmp_path / "wrong.html").write_text(page_of("wrong", xyzw, views))
    with Browser(program, tmp_path / "profile", WEBGL) as browser:
        right = psnr(picture(browser, tmp_path / "right.html"), ours)
        assert right > PSNR_MIN
        assert [url for url in browser.requests() if not url.startswith("blob:")] == []
        assert psnr(picture(browser, tmp_path / "wrong.html"), ours) < PSNR_OF_ANOTHER
