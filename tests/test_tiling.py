from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scenes import activated, make_camera, make_gaussians

from minisplat_ref.backends import REFERENCE
from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.types import Projection, TileGrid


def footprints(boxes, depths):
    """Projection of opaque, wide Gaussians with these boxes, each centred in its own."""
    boxes = np.array(boxes, dtype=np.int32).reshape(-1, 4)
    n = len(boxes)
    return Projection(
        means2d=(boxes[:, :2] + boxes[:, 2:]) / 2,
        depths=np.array(depths, dtype=float),
        conics=np.tile([1e-4, 0, 1e-4], (n, 1)),
        opacities=np.full(n, 0.9),
        radii=np.where(boxes[:, :2] < boxes[:, 2:], 1, 0).astype(np.int32),
        boxes=boxes,
    )


def lists(bins):
    """Python lists of Gaussians, tile by tile."""
    ids, offsets = bins.gaussian_ids.tolist(), bins.tile_offsets.tolist()
    return [ids[start:end] for start, end in pairwise(offsets)]


# --- closed form ---


def test_lists_by_hand():
    # 3 x 2 tiles of 8 x 8 over 20 x 12 pixels: the last column and row hang over the edge.
    boxes = [[0, 0, 20, 12], [7, 7, 9, 9], [8, 0, 16, 8], [0, 0, 0, 0], [19, 11, 20, 12]]
    bins = REFERENCE.bin_gaussians(footprints(boxes, [3, 2, 1, 0, 4]), TileGrid(20, 12, 8, 8), GSPLAT_MAIN)
    assert lists(bins) == [[1, 0], [2, 1, 0], [0], [1, 0], [1, 0], [0, 4]]
    assert bins.gaussian_ids.dtype == np.int32 and bins.tile_offsets.dtype == np.int64
    assert bins.grid == TileGrid(20, 12, 8, 8)
    assert_array_equal(np.diff(bins.gaussian_offsets), [6, 4, 1, 0, 1])


def test_box_that_ends_on_a_tile_border_stays_on_its_side():
    bins = REFERENCE.bin_gaussians(footprints([[4, 0, 8, 4]], [1]), TileGrid(12, 4, 4, 4), GSPLAT_MAIN)
    assert lists(bins) == [[], [0], []]


def test_equal_depths_keep_the_order_of_the_rows(backend):
    grid = TileGrid(4, 4, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(footprints([[0, 0, 4, 4]] * 4, [2, 1, 2, 1]), grid, GSPLAT_MAIN)
    assert lists(bins) == [[1, 3, 0, 2]]


def test_pairs_are_findable_from_their_gaussian(backend, rng):
    projection = REFERENCE.project(*activated(make_gaussians(rng, 60)), make_camera(50, 40, fx=50, fy=60), GSPLAT_MAIN)
    bins = backend.bin_gaussians(projection, TileGrid(50, 40, backend.tile_width, backend.tile_height), GSPLAT_MAIN)
    assert_array_equal(np.sort(bins.slots), np.arange(len(bins.gaussian_ids)))
    owners = np.empty_like(bins.gaussian_ids)
    owners[bins.slots] = bins.gaussian_ids
    assert len(owners) > 100
    assert_array_equal(owners, np.repeat(np.arange(60), np.diff(bins.gaussian_offsets)))


@pytest.mark.parametrize("boxes", [[], [[0, 0, 0, 0]]])
def test_nothing_to_bin(backend, boxes):
    grid = TileGrid(20, 12, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(footprints(boxes, [0] * len(boxes)), grid, GSPLAT_MAIN)
    assert lists(bins) == [[]] * (grid.n_tiles_x * grid.n_tiles_y)
    assert_array_equal(bins.gaussian_offsets, [0] * (len(boxes) + 1))


# --- a definition without cleverness ---


@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, INRIA], ids=lambda c: c.name)
@pytest.mark.parametrize("tile", [(16, 16), (5, 7), (64, 1)])
def test_lists_are_all_boxes_that_overlap(rng, tile, conventions):
    camera = make_camera(50, 40, fx=50, fy=60)
    projection = REFERENCE.project(*activated(make_gaussians(rng, 60)), camera, conventions)
    grid = TileGrid(50, 40, *tile)
    expected = []
    for y in range(0, 40, tile[1]):
        for x in range(0, 50, tile[0]):
            overlaps = [
                n
                for n, (x0, y0, x1, y1) in enumerate(projection.boxes)
                if x0 < x + tile[0] and x < x1 and y0 < y + tile[1] and y < y1
            ]
            expected.append(sorted(overlaps, key=lambda n: projection.depths[n]))
    assert sum(map(len, expected)) > 60
    assert lists(REFERENCE.bin_gaussians(projection, grid, conventions)) == expected


# --- parity ---


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_fast_lists_leave_out_only_what_no_pixel_sees(fast_backend, dtype, rng):
    camera = make_camera(50, 40, fx=50, fy=60)
    inputs = (array.astype(dtype) for array in activated(make_gaussians(rng, 60)))
    projection = REFERENCE.project(*inputs, camera, GSPLAT_MAIN)
    grid = TileGrid(50, 40, fast_backend.tile_width, fast_backend.tile_height)
    every, kept = (lists(b.bin_gaussians(projection, grid, GSPLAT_MAIN)) for b in (REFERENCE, fast_backend))
    ys, xs = np.mgrid[:40, :50]
    for t, (ids, kept_ids) in enumerate(zip(every, kept, strict=True)):
        y, x = divmod(t, grid.n_tiles_x)
        is_tile = (ys // grid.tile_height == y) & (xs // grid.tile_width == x)
        seen = []
        for n in ids:
            a, b, c = projection.conics[n]
            dx, dy = xs[is_tile] + 0.5 - projection.means2d[n, 0], ys[is_tile] + 0.5 - projection.means2d[n, 1]
            alpha = projection.opacities[n] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            if (alpha >= GSPLAT_MAIN.alpha_min).any():
                seen.append(n)
        assert [n for n in ids if n in kept_ids] == kept_ids  # a part of the list, in its order
        assert set(seen) <= set(kept_ids)
