"""Photographs on their way into structure from motion: which files count, copies, masks, and who shares a camera."""

import numpy as np
import pytest
from PIL import ExifTags, Image

from minisplat_ref.datasets.photo_files import list_images
from minisplat_ref.datasets.sfm.level import upright_by_sensor
from minisplat_ref.datasets.sfm.photographs import Group, find_mask, order, prepare_photos
from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io.images import read_image, read_mask, write_image
from minisplat_ref.io.lens import import_pycolmap
from photo_scenes import colored_image


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    return folder


def save(path, image, *, orientation=None, focal=None, focal_35=None, model=None, **options):
    """Write an image with EXIF data."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if orientation is not None:
        exif[ExifTags.Base.Orientation] = orientation
    if model is not None:
        exif.update({ExifTags.Base.Make: "Maker", ExifTags.Base.Model: model})
    lens = exif.get_ifd(ExifTags.IFD.Exif)
    lens.update({ExifTags.Base.FocalLength: focal} if focal is not None else {})
    lens.update({ExifTags.Base.FocalLengthIn35mmFilm: focal_35} if focal_35 is not None else {})
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] = "N"
    Image.fromarray(image).save(path, exif=exif, **options)


# their order


def test_photographs_are_in_the_order_of_their_times():
    times = {"b.jpg": "2026:01:02 10:00:00.5", "a.jpg": "2026:01:02 10:00:00.51", "c.jpg": "2025:12:31 23:59:59."}
    assert order(times) == ["c.jpg", "b.jpg", "a.jpg"]
    assert order({**times, "d.jpg": ""}) == ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]  # as long as one has none
    assert order(dict.fromkeys("ba", "2026:01:02 10:00:00.")) == ["a", "b"]


def test_times_are_read_from_exif_data_and_left_out_of_the_copies(photos, tmp_path):
    for name, time in (("a.jpg", "2026:01:02 10:00:01"), ("b.jpg", "2026:01:02 10:00:00")):
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] = time
        Image.fromarray(colored_image(1)).save(photos / name, exif=exif)
    found = prepare_photos(photos, tmp_path / "work", 40)
    assert found.ordered == ["b.jpg", "a.jpg"] and list(found.originals) == ["a.jpg", "b.jpg"]
    assert b"10:00:01" not in (found.images / "a.jpg").read_bytes()
    save(photos / "c.jpg", colored_image(2))
    assert prepare_photos(photos, tmp_path / "again", 40).ordered == ["a.jpg", "b.jpg", "c.jpg"]


# which files count


def test_hidden_files_and_by_products_are_no_photographs(photos):
    names = ("a.jpg", "b/c.PNG", "b/thumbs.png", "images/d.jpg", "images_e/f.jpg")
    by_products = (
        *("._a.jpg", ".thumbnails/a.jpg", "b/@eaDir/c.PNG/SYNO.jpg", "Thumbnails/a.jpg", "images_2/d.jpg"),
        *("masks/a.jpg.png", "b/masks/c.png", ".DS_Store", ".picasa.ini"),
    )
    for name in (*names, *by_products):
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        (photos / name).write_bytes(b"")
    (photos / "images_2" / "e.jpg").write_bytes(b"")
    with pytest.warns(InputWarning) as caught:
        assert list_images(photos) == sorted(photos / name for name in names)
    (warning,) = caught
    named = "._a.jpg, .thumbnails/, Thumbnails/, b/@eaDir/, images_2/ with 2 images"
    assert str(warning.message) == f"{photos}: leaving out what is hidden or a by-product of other programs ({named})"


def test_numbered_folders_without_images_are_photographs(photos):
    for name in ("images_1/a.jpg", "images_2/b.jpg"):
        (photos / name).parent.mkdir()
        (photos / name).write_bytes(b"")
    assert list_images(photos) == [photos / "images_1" / "a.jpg", photos / "images_2" / "b.jpg"]


def test_nothing_but_by_products(photos):
    (photos / "._a.jpg").write_bytes(b"")
    with pytest.raises(InputError, match=r"no images in it .*, but what is hidden or .* \(\._a\.jpg\)"):
        list_images(photos)


# copies


def test_photographs_are_turned_upright_and_shrunk(photos, tmp_path, rng):
    image = rng.integers(0, 256, (20, 40, 3), dtype=np.uint8)
    save(photos / "a.PNG", image, orientation=6, focal_35=50)  # to be turned clockwise
    save(photos / "b c.JPEG", image, orientation=6, focal_35=50)
    found = prepare_photos(photos, tmp_path / "work", 40)
    assert {name: str(original) for name, original in found.originals.items()} == {
        "a.png": "a.PNG",
        "b_c.jpg": "b c.JPEG",
    }
    assert found.groups == {Group(20, 40, "", None, 50.0): ["a.png", "b_c.jpg"]}
    np.testing.assert_array_equal(read_image(found.images / "a.png"), np.rot90(image, -1))
    with Image.open(found.images / "b_c.jpg") as copy:
        assert ExifTags.Base.Orientation not in copy.getexif()
        assert not copy.getexif().get_ifd(ExifTags.IFD.GPSInfo)
    assert import_pycolmap().infer_camera_from_image(found.images / "b_c.jpg").has_prior_focal_length
    small = prepare_photos(photos, tmp_path / "small", 10)
    assert [group[:2] for group in small.groups] == [(5, 10)]


def test_sixteen_bits_keep_the_upper_byte_and_the_orientation(photos, tmp_path):
    gray = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    save(photos / "gray.png", gray, orientation=3)  # upside down
    (copy,) = prepare_photos(photos, tmp_path / "work", 40).originals
    expected = np.rot90(gray >> 8, 2).astype(np.uint8)
    np.testing.assert_array_equal(read_image(tmp_path / "work" / "images" / copy), np.dstack([expected] * 3))


def test_photographs_of_one_name(photos, tmp_path):
    for name in ("a b.png", "a_b.png"):
        save(photos / name, colored_image(1))
    with pytest.raises(InputError, match=r"a_b\.png: another photograph is called a_b\.png; give each its own name"):
        prepare_photos(photos, tmp_path / "work", 40)


# groups


def test_who_shares_a_camera(photos, tmp_path):
    wide = colored_image(1)
    save(photos / "0.jpg", wide, model="A", focal=24.0)
    save(photos / "1.jpg", wide, model="A", focal=35.0)
    save(photos / "2.jpg", wide, model="A", focal=24.001)  # the same, rounded otherwise
    save(photos / "3.jpg", wide, model="B", focal=24.0)
    save(photos / "4.jpg", wide, model="A", focal=24.0, focal_35=36)
    save(photos / "5.jpg", np.rot90(wide).copy(), model="A", focal=24.0)
    save(photos / "6.jpg", wide)
    save(photos / "7.jpg", wide, focal=0.0, focal_35=0)  # unknown
    assert prepare_photos(photos, tmp_path / "work", 40).groups == {
        Group(32, 24, "Maker A", 24.0, None): ["0.jpg", "2.jpg"],
        Group(32, 24, "Maker A", 35.0, None): ["1.jpg"],
        Group(32, 24, "Maker B", 24.0, None): ["3.jpg"],
        Group(32, 24, "Maker A", 24.0, 36.0): ["4.jpg"],
        Group(24, 32, "Maker A", 24.0, None): ["5.jpg"],
        Group(32, 24, "", None, None): ["6.jpg", "7.jpg"],
    }


# masks


def half(width=32, height=24):
    """True in the left half."""
    return np.tile(np.arange(width) < width // 2, (height, 1))


def test_alpha_and_mask_files_are_one_mask(photos, tmp_path):
    alpha = np.where(half(), 255, 0).astype(np.uint8)
    save(photos / "a.png", np.dstack([colored_image(1), alpha]))
    save(photos / "b.jpg", colored_image(2))
    save(photos / "c.jpg", colored_image(3))
    save(photos / "d.png", np.dstack([colored_image(1), alpha]), orientation=3)
    (photos / "masks").mkdir()
    upper = half(24, 32).T
    write_image(photos / "masks" / "a.png.png", upper)
    (tmp_path / "masks").mkdir()
    write_image(tmp_path / "masks" / "b.png", upper)
    found = prepare_photos(photos, tmp_path / "work", 16)
    assert found.masked == {"a.png", "b.jpg", "d.png"}
    small = half(16, 12), half(12, 16).T
    np.testing.assert_array_equal(read_mask(found.masks / "a.png.png"), small[0] & small[1])
    np.testing.assert_array_equal(read_mask(found.masks / "b.jpg.png"), small[1])
    np.testing.assert_array_equal(read_mask(found.masks / "d.png.png"), np.rot90(small[0], 2))
    assert sorted(path.name for path in found.masks.iterdir()) == ["a.png.png", "b.jpg.png", "d.png.png"]
    assert read_image(found.images / "a.png").shape == (12, 16, 3)


def test_masks_that_fit_no_photograph(photos, tmp_path):
    save(photos / "a.jpg", colored_image(1))
    (photos / "masks").mkdir()
    write_image(photos / "masks" / "b.png", half())
    with pytest.warns(InputWarning, match=r"masks: no photograph belongs to b\.png; the mask of 0001\.jpg is called"):
        assert not prepare_photos(photos, tmp_path / "work", 40).masked
    assert find_mask(photos, photos.relative_to(photos) / "a.jpg") is None
    write_image(photos / "masks" / "a.png", half(16, 24))
    with pytest.raises(InputError, match=r"a\.png: the mask is 16x24 but its photograph a\.jpg, upright, is 32x24"):
        prepare_photos(photos, tmp_path / "again", 40)


# what is up


def test_only_a_camera_that_once_said_otherwise_is_known_to_be_upright(photos, tmp_path):
    """One phone turned a photograph; another camera writes 1 however it is held, and a third writes nothing."""
    image = colored_image(1)
    for name, model, orientation in (
        ("a.jpg", "phone", 1),
        ("b.jpg", "phone", 6),
        ("c.jpg", "camera", 1),
        ("d.jpg", None, None),
    ):
        save(photos / name, image, model=model, orientation=orientation)
    assert upright_by_sensor(prepare_photos(photos, tmp_path, 100)) == {"a.jpg", "b.jpg"}
