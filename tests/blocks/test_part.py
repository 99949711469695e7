"""A part of a scene: its files, its masks on photographs in memory and on disk, its points, its first Gaussians."""

import numpy as np
import pytest

from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene
from minisplat_ref.io.stored_views import Photograph, Pixels, Shelf, StoredView
from minisplat_ref.runs.part import Box, Part, Plane, read_part
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Frame, Scene, View
from scenes import balls, make_camera

PLANE = Plane(np.array([1.0, 0.0, 0.0]), np.array([[1.0, 0, 0], [0, 0, 1.0]]))
REGION = Box((-np.inf, 0.0), (2.0, 5.0))
MASK = np.array([[1, 0, 1], [0, 1, 1]], bool)  # 6 pixels, which do not fill a byte
CAMERA = make_camera(3, 2)
IMAGE = np.zeros((2, 3, 3), np.uint8)


@pytest.fixture
def part():
    return Part(PLANE, REGION, {"b": MASK, "a/1": ~MASK})


def scene_of(*views):
    colors = np.arange(12, dtype=np.uint8).reshape(4, 3)
    return Scene("s", views, (), np.arange(12.0).reshape(4, 3), colors, np.zeros(3), 1.0)


def test_files_give_it_back(part, tmp_path):
    part.write(tmp_path / "0-0.json")
    again = read_part(tmp_path / "0-0.json")
    assert again.region == REGION and list(again.masks) == ["b", "a/1"]
    np.testing.assert_array_equal(again.plane.axes, PLANE.axes)
    np.testing.assert_array_equal(again.masks["b"], MASK)
    np.testing.assert_array_equal(again.masks["a/1"], ~MASK)


@pytest.mark.parametrize("text", ['{"region": [[0, 0], [1]]}', "[]", '{"region": [[0,0],[1,1]], "photographs": [1]}'])
def test_damaged_files_are_refused(part, tmp_path, text):
    part.write(tmp_path / "p.json")
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(InputError, match=r"p\.json"):
        read_part(tmp_path / "p.json")


def test_masks_are_those_of_the_photographs_and_of_the_part(part):
    own = np.array([[1, 1, 0], [1, 1, 1]], bool)
    pixels = Photograph(lambda: Pixels(IMAGE, own), 6, Shelf(1e6))
    stored = StoredView("a/1", CAMERA, pixels, None)
    narrowed = part.narrow(scene_of(View("b", CAMERA, IMAGE, None), stored))
    np.testing.assert_array_equal(narrowed.train_views[0].mask, MASK)
    np.testing.assert_array_equal(narrowed.train_views[1].mask, ~MASK & own)
    assert isinstance(narrowed.train_views[1], StoredView)
    assert [view.view_id for view in narrowed.train_views] == [0, 1]
    assert len(narrowed.points) == 4, "nobody knows which points they show"


def test_points_are_those_that_its_photographs_show(part):
    seen = (np.array([1]), np.array([1, 3]))
    views = [View(name, CAMERA, IMAGE, None, ids) for name, ids in zip(("b", "a/1"), seen, strict=True)]
    narrowed = part.narrow(scene_of(*views))
    np.testing.assert_array_equal(narrowed.points, [[3, 4, 5], [9, 10, 11]])
    np.testing.assert_array_equal(narrowed.point_colors, [[3, 4, 5], [9, 10, 11]])
    assert [view.point_ids.tolist() for view in narrowed.train_views] == [[0], [0, 1]]


def test_photographs_of_another_size_are_refused(part):
    with pytest.raises(InputError, match="photograph b is 4x2 and was 3x2 when the blocks were planned"):
        part.narrow(scene_of(View("b", make_camera(4, 2), IMAGE, None)))


def test_first_gaussians_are_those_of_the_region(part):
    # In a frame of unit 2 with its origin at x = 1: on the plane (2 x, 2 z), of which x < 2 and 0 <= z < 5 is inside.
    means = [[0.9, 7.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -0.1], [-50.0, 0.0, 2.4], [0.0, 0.0, 2.5]]
    population = balls(means, [0.1] * 5, [0.5] * 5, [[0.1, 0.2, 0.3]] * 5)
    state = TrainState(population, zero_moments(population), 0, [], np.random.default_rng(0), {})
    state.frame = Frame((1.0, 0.0, 0.0), 2.0)
    cropped = part.crop(state)
    assert cropped.gaussians.means[:, 0].tolist() == [0.9, -50.0]
    assert len(cropped.adam.first.means) == 2


def test_only_the_photographs_of_a_part_are_read(tmp_path):
    settings = {"n_views": 6, "width": 16, "height": 12, "n_points": 30, "test_every": 4, "supersampling": 1}
    write_scene(make_scene("room", **settings), tmp_path / "room", settings)
    views = load_scene(tmp_path / "room", test_every=4).train_views
    names = {views[1].name, views[3].name}
    for path in (tmp_path / "room" / "images").iterdir():
        if path.stem not in names:
            path.write_bytes(b"not an image")
    narrowed = load_scene(tmp_path / "room", test_every=4, only=names)
    assert {view.name for view in narrowed.train_views} == names and not narrowed.test_views
    np.testing.assert_array_equal(narrowed.train_views[0].image, views[1].image)
    with pytest.raises(InputError, match="photograph nowhere is not there any more"):
        load_scene(tmp_path / "room", test_every=4, only={"nowhere"})
