"""Photographs of a scene as text and numbers: all comes back, of COLMAP scenes and of transforms.json."""

import json
import shutil

import numpy as np
import pytest

from minisplat_ref.app.listing_file import ARRAYS, read_listing, select, to_arrays, to_json
from minisplat_ref.errors import InputError
from minisplat_ref.io import list_scene, load_scene
from minisplat_ref.io.lens import Lens
from minisplat_ref.io.scene import Listing, Photo, build_reading, build_scene, make_listing
from run_commands import write_room
from scenes import make_camera

SETTINGS = {"n_views": 6, "width": 16, "height": 12, "n_points": 30, "test_every": 4}


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("listed") / "room", **SETTINGS)


def through_files(listing, source):
    content = json.loads(json.dumps(to_json(listing)))
    return read_listing(source, content, to_arrays(listing))


def photo_of(folder, file, point_ids=None, **fields):
    photo = Photo(folder / "images", file, None, make_camera(3, 2), None, point_ids)
    return photo._replace(**fields)


def listing_of(folder, *photos):
    names = [photo.file.removesuffix(".png") for photo in photos]
    colors = np.arange(12, dtype=np.uint8).reshape(4, 3)
    return Listing(folder, photos, (), names, np.arange(12.0).reshape(4, 3), colors, True)


def test_a_part_is_read_without_the_model(scene_folder, tmp_path):
    """The views of some photographs, with the points that they show, of a folder that has no others and no model."""
    whole = load_scene(scene_folder, test_every=4)
    listing = list_scene(scene_folder, 4)
    names = {whole.train_views[k].name for k in (1, 3)}
    part = select(listing, names)
    moved = tmp_path / "moved"
    (moved / "images").mkdir(parents=True)
    for name in names:
        shutil.copy(scene_folder / "images" / f"{name}.png", moved / "images")
    again = read_listing(moved, json.loads(json.dumps(to_json(part))), to_arrays(part))
    scene = build_scene(again, build_reading(1, None, False, again.alpha_is_mask))
    assert [view.name for view in scene.train_views] == sorted(names) and not scene.test_views
    for view, expected in zip(scene.train_views, (whole.train_views[1], whole.train_views[3]), strict=True):
        np.testing.assert_array_equal(view.image, expected.image)
        assert repr(view.camera) == repr(expected.camera)
        np.testing.assert_array_equal(view.camera.cam_from_world_R, expected.camera.cam_from_world_R)
        np.testing.assert_array_equal(view.camera.cam_from_world_t, expected.camera.cam_from_world_t)
        np.testing.assert_array_equal(scene.points[view.point_ids], whole.points[expected.point_ids])
        np.testing.assert_array_equal(scene.point_colors[view.point_ids], whole.point_colors[expected.point_ids])
    seen = np.unique(np.concatenate([whole.train_views[k].point_ids for k in (1, 3)]))
    assert len(scene.points) == len(seen) < len(whole.points)


def test_points_are_those_that_the_photographs_show(tmp_path):
    photos = [photo_of(tmp_path, f"{name}.png", np.array(ids)) for name, ids in (("b", [1]), ("c", [0]), ("a", [1, 3]))]
    part = select(listing_of(tmp_path, *photos), {"a", "b"})
    assert part.names == ["b", "a"] and through_files(part._replace(names=["2_b", "1_a"]), tmp_path).names[0] == "2_b"
    np.testing.assert_array_equal(part.points, [[3, 4, 5], [9, 10, 11]])
    np.testing.assert_array_equal(part.point_colors, [[3, 4, 5], [9, 10, 11]])
    again = through_files(part, tmp_path)
    assert [photo.point_ids.tolist() for photo in again.train_photos] == [[0], [0, 1]]
    assert again.train_photos[0].point_ids.dtype == np.int64 and again.points.dtype == np.float64


def test_all_points_remain_where_a_photograph_does_not_know_its_own(tmp_path):
    part = select(
        listing_of(tmp_path, photo_of(tmp_path, "b.png", np.array([1])), photo_of(tmp_path, "a.png")), {"a", "b"}
    )
    again = through_files(part, tmp_path)
    assert len(again.points) == 4
    assert again.train_photos[0].point_ids.tolist() == [1] and again.train_photos[1].point_ids is None


def test_files_lens_and_time_come_back(tmp_path):
    """Paths inside of the scene move with it, others stay; a scene may be named by its file."""
    lens = Lens("OPENCV", (3.25, 3.5, 1.5, 1.0, 0.1, -0.2, 1e-3, 1e-4))
    beside = tmp_path.parent / "elsewhere"
    file = tmp_path / "transforms.json"
    file.write_text("{}")
    first = photo_of(tmp_path, "b.png", lens=lens, time=0.1, mask_path=tmp_path / "masks" / "b.png")
    listing = listing_of(file, first, photo_of(beside, "sub/a.png"))._replace(alpha_is_mask=False)
    content = to_json(listing)
    assert content["photographs"][0]["folder"] == "images" and content["photographs"][0]["mask"] == "masks/b.png"
    b, a = through_files(listing, file).train_photos
    assert (b.folder, b.file, b.mask_path, b.time, b.lens) == (tmp_path / "images", "b.png", first.mask_path, 0.1, lens)
    assert (a.folder, a.file, a.mask_path, a.lens) == (beside / "images", "sub/a.png", None, None)
    assert not through_files(listing, file).alpha_is_mask and set(to_arrays(listing)) == set(ARRAYS)
    moved = tmp_path / "moved"
    moved.mkdir()
    assert read_listing(moved, content, to_arrays(listing)).train_photos[0].path == moved / "images" / "b.png"


def test_a_scene_without_photographs_has_no_views(tmp_path):
    listing = make_listing(tmp_path, [], [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), alpha_is_mask=True)
    with pytest.raises(InputError, match="0 training and 0 test view"):
        build_scene(listing, build_reading(1, None, False, True))
