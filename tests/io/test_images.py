"""Image files: what is read, written and resized."""

import numpy as np
import pytest
from PIL import Image

from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io import load_scene
from minisplat_ref.io.images import (
    composite_alpha,
    downscaled_size,
    image_size,
    read_image,
    read_mask,
    resize_image,
    resize_mask,
    write_image,
)
from photo_scenes import HEIGHT, WIDTH, write_colmap


@pytest.fixture
def pixels(rng):
    return rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)


# Reading and writing


@pytest.mark.parametrize("channels", [3, 4])
def test_png_round_trip(tmp_path, rng, channels):
    pixels = rng.integers(0, 256, (6, 8, channels), dtype=np.uint8)
    write_image(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), pixels)
    assert image_size(tmp_path / "a.png") == (8, 6)


def test_floats_are_clipped_and_rounded_to_nearest(tmp_path):
    levels = np.array([-1.0, 0.0, 0.49 / 255, 0.51 / 255, 254.49 / 255, 254.51 / 255, 1.0, np.inf], np.float32)
    write_image(tmp_path / "a.png", np.repeat(levels[None, :, None], 3, axis=2))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[0, :, 0], [0, 0, 0, 1, 254, 255, 255, 255])


def test_every_level_survives_float(tmp_path):
    levels = np.arange(256, dtype=np.uint8)
    write_image(tmp_path / "a.png", np.repeat((levels / 255.0)[None, :, None], 3, axis=2))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[0, :, 0], levels)


def test_sixteen_bits_keep_the_upper_eight(tmp_path):
    gray = np.array([[0, 255, 256, 0x1234, 0xFFFF]], np.uint16)
    Image.fromarray(gray).save(tmp_path / "gray.png")
    np.testing.assert_array_equal(
        read_image(tmp_path / "gray.png"), np.array([[[0] * 3, [0] * 3, [1] * 3, [0x12] * 3, [255] * 3]])
    )


def test_gray_palette_and_transparency(tmp_path, pixels):
    Image.fromarray(pixels[..., 0]).save(tmp_path / "gray.png")
    np.testing.assert_array_equal(read_image(tmp_path / "gray.png"), np.repeat(pixels[..., :1], 3, axis=2))
    Image.fromarray(pixels[..., 0]).convert("P").save(tmp_path / "palette.png")
    np.testing.assert_array_equal(read_image(tmp_path / "palette.png"), np.repeat(pixels[..., :1], 3, axis=2))
    Image.fromarray(pixels[..., :2], mode=None).save(tmp_path / "gray_alpha.png")
    rgba = read_image(tmp_path / "gray_alpha.png")
    np.testing.assert_array_equal(rgba, pixels[..., [0, 0, 0, 1]])


def test_exif_orientation_is_not_applied(tmp_path, pixels):
    exif = Image.Exif()
    exif[0x0112] = 6  # turn by 90 degrees to show it
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), pixels)


def test_mask_is_white_and_opaque(tmp_path):
    rgba = np.zeros((1, 4, 4), np.uint8)
    rgba[0, :, :3] = [[255, 255, 255], [255, 0, 0], [127, 127, 127], [255, 255, 255]]
    rgba[0, :, 3] = [255, 255, 255, 127]
    write_image(tmp_path / "m.png", rgba)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), [[True, True, False, False]])
    write_image(tmp_path / "b.png", np.array([[True, False]]))
    np.testing.assert_array_equal(read_mask(tmp_path / "b.png"), [[True, False]])


def test_compositing_by_hand():
    image = np.array([[[200, 100, 0, 0], [200, 100, 0, 255], [200, 100, 0, 51]]], np.uint8)  # alpha 0, 1, 0.2
    result = composite_alpha(image, np.array([1.0, 0.0, 0.5]))
    np.testing.assert_array_equal(result, [[[255, 0, 128], [200, 100, 0], [244, 20, 102]]])


# Resizing


@pytest.mark.parametrize(
    ("size", "factor", "expected"),
    [((8, 6), 2, (4, 3)), ((9, 7), 4, (2, 2)), ((11, 5), 4, (3, 1)), ((1, 1), 8, (1, 1))],
)
def test_downscaled_size(size, factor, expected):
    assert downscaled_size(*size, factor) == expected


def test_resizing_keeps_flat_colour_and_place():
    flat = np.full((9, 15, 3), (10, 200, 77), np.uint8)
    np.testing.assert_array_equal(resize_image(flat, 7, 4), np.full((4, 7, 3), (10, 200, 77)))
    ramp = np.repeat(np.arange(0.0, 160.0, 10.0)[None, :, None], 8, axis=0).repeat(3, axis=2)  # 16 wide
    small = resize_image(ramp.astype(np.uint8), 8, 4)[:, 2:-2]  # away from the border
    np.testing.assert_array_equal(small, np.broadcast_to(np.arange(45, 125, 20)[None, :, None], small.shape))


def test_mask_resizing_counts_area():
    mask = np.zeros((4, 6), bool)
    mask[:2, :2] = True  # whole, half and a quarter of an output pixel
    mask[0, 2:4] = True
    mask[0, 4] = True
    np.testing.assert_array_equal(resize_mask(mask, 3, 2), [[True, True, False], [False] * 3])


# Bad input


def test_truncated_image(tmp_path, rng):
    for name in ("a.png", "a.jpg"):
        write_image(tmp_path / name, rng.integers(0, 256, (32, 32, 3), dtype=np.uint8))
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[: len(content) // 2])
        with pytest.raises(InputError, match=rf"{name}: cannot be decoded \(.*truncated.*\); copy or export"):
            read_image(tmp_path / name)


def test_not_an_image(tmp_path):
    (tmp_path / "a.png").write_text("no image")
    with pytest.raises(InputError, match=r"a\.png: not an image .*; convert it to PNG or JPEG"):
        read_image(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"b\.png: no such image"):
        image_size(tmp_path / "b.png")


def test_nothing_bad_is_written(tmp_path):
    with pytest.raises(InputError, match=r"a\.png: the image has 1 NaN values"):
        write_image(tmp_path / "a.png", np.array([[np.nan, 1.0]]))
    with pytest.raises(InputError, match=r"a\.xyz: no image format has this suffix; use \.png or \.jpg"):
        write_image(tmp_path / "a.xyz", np.zeros((2, 2)))
    with pytest.raises(InputError, match=r"the folder .*nowhere does not exist"):
        write_image(tmp_path / "nowhere" / "a.png", np.zeros((2, 2)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("index", [0, 1])
def test_a_test_view_whose_mask_is_empty_is_set_aside(index, tmp_path):
    """The first of two as the second; training views stay as they are."""
    scene = write_colmap(tmp_path, n=6)
    names = ("0000", "0003")
    (scene / "masks").mkdir()
    write_image(scene / "masks" / f"{names[index]}.png", np.zeros((HEIGHT, WIDTH), bool))
    with pytest.warns(InputWarning, match="the masks of 1 of 6 views leave no pixel"):
        loaded = load_scene(scene, test_every=3)
    assert [view.name for view in loaded.test_views] == [names[1 - index]]
    assert [view.name for view in loaded.train_views] == ["0001", "0002", "0004", "0005"]


def with_black_masks(folder, names):
    """Six photographs, of which every third is held out; the masks of some leave no pixel."""
    scene = write_colmap(folder, n=6)
    (scene / "masks").mkdir()
    for name in names:
        write_image(scene / "masks" / f"{name}.png", np.zeros((HEIGHT, WIDTH), bool))
    return scene


@pytest.mark.parametrize("names", [("0000", "0001", "0002"), ("0000", "0003", "0001", "0002")])
def test_test_views_do_not_count_among_those_that_training_needs(names, tmp_path):
    """Two training views of four are left, which is enough, however many test views are set aside."""
    with pytest.warns(InputWarning, match=f"the masks of {len(names)} of 6 views leave no pixel"):
        loaded = load_scene(with_black_masks(tmp_path, names), test_every=3)
    assert [view.name for view in loaded.train_views] == ["0004", "0005"]


def test_fewer_than_two_training_views_are_refused(tmp_path):
    with pytest.raises(InputError, match="training needs at least 2 views"):
        load_scene(with_black_masks(tmp_path, ("0001", "0002", "0004")), test_every=3)
