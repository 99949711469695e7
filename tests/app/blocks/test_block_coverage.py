"""Which photographs belong to which block: dominant Gaussians by hand, the least share, pixels that show nothing."""

import numpy as np
import pytest

from minisplat_ref.app.blocks import coverage as coverage_module
from minisplat_ref.app.blocks.coverage import Coarse, choose_blocks, cover, shows
from minisplat_ref.app.blocks.grid import Block
from minisplat_ref.app.runs.scene_part import Box, Plane
from minisplat_ref.errors import InputError
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.types import FILE_FRAME, Frame, Model, Scene, view_from
from scenes import balls, make_camera

PLANE = Plane(np.zeros(3), np.array([[1.0, 0, 0], [0, 0, 1.0]]))
LEFT = Block("0-0", Box((-np.inf, -np.inf), (0.0, np.inf)), Box((-np.inf, -np.inf), (0.1, np.inf)), 1)
RIGHT = Block("1-0", Box((0.0, -np.inf), (np.inf, np.inf)), Box((-0.1, -np.inf), (np.inf, np.inf)), 1)
# A screen of opaque balls at z = 2 fills the image of a camera at the origin, 20 pixels wide, 10 to a unit of x.
X = np.linspace(-2.0, 2.0, 21)
SCREEN = [[x, y, 2.0] for x in X for y in X]


def scene_of(*cameras):
    views = [view_from(camera, name=f"v{k}") for k, camera in enumerate(cameras)]
    return Scene("s", tuple(views), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)


def screen(centers=SCREEN, frame=FILE_FRAME):
    n = len(centers)
    return Coarse(Model(balls(centers, [0.12] * n, [0.99] * n)), RenderSettings(np.zeros(3)), frame)


def looking_at(x):
    """A camera at (x, 0, 0) that looks along z, whose image is 2 units wide at the screen."""
    return make_camera(20, 10, fx=20.0, fy=20.0)._replace(cam_from_world_t=np.array([-x, 0.0, 0.0]))


def test_shows_is_no_block_where_there_is_no_gaussian():
    ids = np.array([[0, 1], [2, -1]])
    assert shows(ids, np.array([True, False, True])).tolist() == [[True, False], [True, False]]


def test_a_photograph_belongs_to_the_blocks_that_it_shows():
    # From x = 1 the image is of x from 0 to 2: a twentieth shows the left region, which ends at 0.1, and the right one
    # shows that, too.
    coverage = cover(screen(), scene_of(looking_at(-1.0), looking_at(0.0), looking_at(1.0)), PLANE, [LEFT, RIGHT])
    assert list(coverage.masks[0]) == ["v0", "v1"] and list(coverage.masks[1]) == ["v1", "v2"]
    assert coverage.trained == 1.0
    columns = coverage.masks[0]["v1"].all(axis=0)  # of 20, each a tenth of a unit wide
    assert columns[:10].all() and not coverage.masks[0]["v1"][:, 13:].any()


def columns(*spans, n=100):
    """One row of pixels for each block, shown in these columns."""
    shown = np.zeros((len(spans), 1, n), bool)
    for row, span in zip(shown, spans, strict=True):
        row[0, slice(*span)] = True
    return shown


@pytest.mark.parametrize(
    ("spans", "blocks"),
    [
        ([(0, 25), (25, 100)], [0, 1]),  # a quarter
        ([(0, 24), (24, 100)], [1, 0]),  # less, and nothing else shows it
        ([(0, 24), (2, 100)], [1]),  # all but 2 of 100 pixels
        ([(0, 24), (3, 100)], [1, 0]),
        ([(0, 20), (15, 37), (80, 100), (30, 50)], [1, 2, 0, 3]),  # 22 pixels, 20, then 15 and 13 of 20 that are left
        ([(0, 50), (50, 51)], [0]),  # of the pixels that show anything, not of all
        ([(0, 40), (40, 41)], [0, 1]),
        ([(0, 0), (0, 0)], []),
    ],
)
def test_a_photograph_belongs_to_blocks_that_fill_a_quarter_and_to_those_that_all_but_a_fiftieth_needs(spans, blocks):
    assert choose_blocks(columns(*spans)) == blocks


def test_photographs_go_to_small_blocks_too(monkeypatch):
    """Of 20 columns four show the left region, and all others the right one."""
    ids = np.zeros((10, 20), int)
    ids[:, 4:] = 1
    monkeypatch.setattr(coverage_module, "_dominant", lambda coarse, view: ids)
    two = screen([[-1.0, 0, 2], [1.0, 0, 2]])
    masks, trained = cover(two, scene_of(looking_at(0), looking_at(0)), PLANE, [LEFT, RIGHT])
    assert list(masks[0]) == list(masks[1]) == ["v0", "v1"] and trained == 1.0
    assert masks[0]["v0"][0].tolist() == [True] * 4 + [False] * 16


def test_pixels_without_gaussians_belong_to_all_blocks_of_the_photograph():
    below = [center for center in SCREEN if center[1] > 0.0]
    masks, trained = cover(screen(below), scene_of(looking_at(-0.4), looking_at(-0.5)), PLANE, [LEFT])
    assert masks[0]["v0"][:3].all(), "above the screen"
    assert not masks[0]["v0"][-1, 18:].any(), "the right of the screen is of another block"
    assert 0.5 < trained < 1.0


def test_places_are_those_of_the_files():
    # The same screen in a frame of half the unit, moved by 3: its x of the files is 3 + 0.5 x.
    moved = Plane(np.array([3.0, 0.0, 0.0]), PLANE.axes)
    frame = Frame((3.0, 0.0, 0.0), 0.5)
    views = scene_of(looking_at(0.0), looking_at(-0.2))
    masks, _ = cover(screen(frame=frame), views, moved, [LEFT])
    np.testing.assert_array_equal(masks[0]["v0"], cover(screen(), views, PLANE, [LEFT]).masks[0]["v0"])


def test_a_block_without_photographs_is_refused():
    with pytest.raises(InputError, match="block 1-0 has 0 photographs that show it, and training needs 2: give fewer"):
        cover(screen(), scene_of(looking_at(-0.9), looking_at(-0.8)), PLANE, [LEFT, RIGHT])
