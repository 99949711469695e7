"""A part of a scene: its files, its masks on photographs in memory and on disk, its first Gaussians."""

from pathlib import Path

import numpy as np
import pytest

from minisplat_ref.app.runs.scene_part import Box, Part, Plane, Region, keep_rows, read_part, read_region
from minisplat_ref.errors import InputError
from minisplat_ref.io.scene import Listing, Photo
from minisplat_ref.io.stored_views import Photograph, Pixels, Shelf, StoredView
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Frame, Scene, View
from scenes import balls, make_camera

PLANE = Plane(np.array([1.0, 0.0, 0.0]), np.array([[1.0, 0, 0], [0, 0, 1.0]]))
REGION = Region(PLANE, Box((-np.inf, 0.0), (2.0, 5.0)))
MASK = np.array([[1, 0, 1], [0, 1, 1]], bool)  # 6 pixels, which do not fill a byte
CAMERA = make_camera(3, 2)
IMAGE = np.zeros((2, 3, 3), np.uint8)


@pytest.fixture
def part():
    photos = [Photo(Path("s/images"), f"{name}.png", None, CAMERA, None) for name in ("b", "a/1")]
    listing = Listing(Path("s"), photos, (), ["b", "a/1"], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), True)
    return Part(REGION, listing, {"b": MASK, "a/1": ~MASK})


def scene_of(*views):
    return Scene("s", views, (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)


def test_files_give_it_back(part, tmp_path):
    part.write(tmp_path / "0-0.json")
    again = read_part(tmp_path / "0-0.json", Path("s"))
    assert again.region.box == REGION.box and list(again.masks) == again.listing.names == ["b", "a/1"]
    np.testing.assert_array_equal(again.region.plane.axes, PLANE.axes)
    np.testing.assert_array_equal(read_region(tmp_path / "0-0.json").plane.origin, PLANE.origin)
    np.testing.assert_array_equal(again.masks["b"], MASK)
    np.testing.assert_array_equal(again.masks["a/1"], ~MASK)


PLACED = (
    '{"origin": [0, 0, 0], "axes": [[1, 0, 0], [0, 1, 0]], "region": [[0, 0], [1, 1]], "extent": null,'
    ' "alpha_is_mask": true, '
)


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        '{"region": [[0, 0], [1, 1]]}',
        PLACED.replace("[1, 1]]", "[1]]") + '"masks": [], "photographs": []}',
        PLACED + '"masks": [], "photographs": [1]}',
        PLACED + '"masks": [1], "photographs": []}',
        PLACED + '"masks": []}',
    ],
)
def test_damaged_files_are_refused(part, tmp_path, text):
    part.write(tmp_path / "p.json")
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(InputError, match=r"p\.json"):
        read_part(tmp_path / "p.json", Path("s"))


def test_masks_are_those_of_the_photographs_and_of_the_part(part):
    own = np.array([[1, 1, 0], [1, 1, 1]], bool)
    pixels = Photograph(lambda: Pixels(IMAGE, own), 6, Shelf(1e6))
    stored = StoredView("a/1", CAMERA, pixels, None)
    hidden = part.hide(scene_of(View("b", CAMERA, IMAGE, None), stored))
    np.testing.assert_array_equal(hidden.train_views[0].mask, MASK)
    np.testing.assert_array_equal(hidden.train_views[1].mask, ~MASK & own)
    assert isinstance(hidden.train_views[1], StoredView)


def test_a_part_that_continues_has_the_extent_of_the_whole(part, tmp_path):
    view = View("b", CAMERA, IMAGE, None)
    assert part.hide(scene_of(view)).extent == 1.0
    part._replace(extent=7.5).write(tmp_path / "0-0.json")
    assert read_part(tmp_path / "0-0.json", Path("s")).hide(scene_of(view)).extent == 7.5


def test_photographs_of_another_size_are_refused(part):
    with pytest.raises(InputError, match="photograph b is 4x2 and was 3x2 when the blocks were planned"):
        part.hide(scene_of(View("b", make_camera(4, 2), IMAGE, None)))


def test_first_gaussians_are_those_of_the_region(part):
    # In a frame of unit 2 with its origin at x = 1: on the plane (2 x, 2 z), of which x < 2 and 0 <= z < 5 is inside.
    means = [[0.9, 7.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -0.1], [-50.0, 0.0, 2.4], [0.0, 0.0, 2.5]]
    population = balls(means, [0.1] * 5, [0.5] * 5, [[0.1, 0.2, 0.3]] * 5)
    state = TrainState(population, zero_moments(population), 0, [], np.random.default_rng(0), {})
    state.frame = Frame((1.0, 0.0, 0.0), 2.0)
    state.adam.first.means[:, 0], state.stats["seen"] = range(5), np.arange(5)
    cropped = keep_rows(state, part.region.find_rows(state))
    assert cropped.gaussians.means[:, 0].tolist() == [0.9, -50.0]
    assert cropped.adam.first.means[:, 0].tolist() == cropped.stats["seen"].tolist() == [0, 3]
    assert len(cropped.adam.second.means) == 2
