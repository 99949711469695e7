"""How bundles show themselves: by hand-worked lines and pictures."""

import io

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

import minisplat_ref as ms
from minisplat_ref.interface.showing import LENGTH_MAX, PER_ROW, THUMBNAIL, as_bytes, to_sheet
from minisplat_ref.types import Model, RenderOutput, Scene, View, view_from
from scenes import make_camera, make_gaussians


def pixels_of(png):
    return np.asarray(Image.open(io.BytesIO(png)))


def test_a_bundle_is_one_line():
    g = make_gaussians(np.random.default_rng(0), 3)
    assert repr(g) == (
        "Gaussians(means=float64[3, 3], quats=float64[3, 4], log_scales=float64[3, 3], opacity_logits=float64[3],"
        f" sh_dc=float64[3, 3], sh_rest=float64{list(g.sh_rest.shape)})"
    )
    assert repr(Model(g, {"sky": np.zeros(3)})) == "Model(gaussians=Gaussians(...), shared={sky})"


def test_a_scene_of_many_photographs_is_one_line():
    view = view_from(make_camera())
    scene = Scene("s" * 200, (view,) * 5, (), np.zeros((7, 3)), np.zeros((7, 3), np.uint8), np.zeros(3), 1.0)
    line = repr(scene)
    assert "train_views=5 x View, test_views=()" in line and "points=float64[7, 3]" in line
    assert len(line) < 300 and "s" * (LENGTH_MAX - 4) + "...," in line and "s" * LENGTH_MAX not in line


def test_an_image_of_floats_is_clipped_and_rounded():
    image = np.array([[[-1.0, 0.5, 2.0, 9.0], [np.nan, 0.1, 1.0, 0.0]]])
    assert_array_equal(as_bytes(image), [[[0, 128, 255], [0, 26, 255]]])
    assert_array_equal(as_bytes(np.array([[[0.2]]])), [[[51, 51, 51]]])  # one channel is grey
    assert as_bytes(np.full((1, 1, 3), 7, np.uint8)).max() == 7


def test_a_render_a_view_and_a_scene_are_pictures():
    output = RenderOutput(np.full((4, 6, 3), 0.2), np.ones((4, 6)), None, None)
    assert_array_equal(pixels_of(output._repr_png_()), np.full((4, 6, 3), 51))
    photograph = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)
    view = View("a", make_camera(), photograph, None)
    assert_array_equal(pixels_of(view._repr_png_()), photograph)
    assert view_from(make_camera())._repr_png_() is None
    scene = Scene("x", (view,), (view,), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)
    assert_array_equal(pixels_of(scene._repr_png_())[:4, :6], photograph)


@pytest.mark.parametrize(("n", "rows", "columns"), [(0, 1, 1), (1, 1, 1), (7, 2, 6), (40, 2, 6)])
def test_a_sheet_has_rows_of_thumbnails(n, rows, columns):
    size = (100, 2 * THUMBNAIL, 3) if n else (1, 1, 3)
    sheet = to_sheet(np.zeros(size, np.uint8) for _ in range(n))
    height, width = (50, THUMBNAIL) if n else (1, 1)
    assert sheet.shape == (rows * (height + 4), columns * (width + 4), 3) and columns <= PER_ROW
    assert (sheet[height:, :, :].max() == 255) and (n == 0 or sheet[0, 0].max() == 0)


def test_completion_offers_the_public_names():
    assert dir(ms) == sorted(ms.__all__) and "render" in dir(ms) and "Any" not in dir(ms)
