from itertools import pairwise

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Projection, TileGrid
from scenes import activated, make_camera, make_gaussians
from tolerances import PARITY_FLOAT32_IMAGE


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


def pairs(bins):
    """Set of (tile, Gaussian)."""
    return {(t, n) for t, ids in enumerate(lists(bins)) for n in ids}


def assert_in_order(bins, depths):
    """Lists are ordered by depth, then index; slots number the pairs Gaussian by Gaussian."""
    tiles = np.repeat(np.arange(len(bins.tile_offsets) - 1), np.diff(bins.tile_offsets))
    order = np.lexsort((bins.gaussian_ids, depths[bins.gaussian_ids], tiles))
    assert_array_equal(order, np.arange(len(order)))
    owners = np.full_like(bins.gaussian_ids, -1)
    owners[bins.slots] = bins.gaussian_ids
    assert_array_equal(owners, np.repeat(np.arange(len(depths)), np.diff(bins.gaussian_offsets)))


def random_footprints(rng, n, dtype, size=(300, 200), depths=None):
    """Projection of ellipses from dots to needles over the whole image, each in its smallest box, some culled."""
    angles, opacities = rng.uniform(0, np.pi, n), rng.uniform(0.004, 1, n)
    sigmas = np.exp(rng.uniform(np.log(0.3), np.log(80), (n, 2)))
    axes = np.stack([np.cos(angles), np.sin(angles)], axis=1)  # [n, 2]
    across = axes[:, ::-1] * [-1, 1]
    outer = [np.einsum("ni,nj->nij", v, v) for v in (axes, across)]
    covariances = sum(o * s[:, None, None] ** 2 for o, s in zip(outer, sigmas.T, strict=True))
    inverse = sum(o / s[:, None, None] ** 2 for o, s in zip(outer, sigmas.T, strict=True))
    means2d = rng.uniform(-20, 20, (n, 2)) + rng.uniform(0, 1, (n, 2)) * size
    reach = np.sqrt(2 * np.log(opacities / GSPLAT_MAIN.alpha_min)[:, None] * np.diagonal(covariances, axis1=1, axis2=2))
    boxes = np.concatenate([np.floor(means2d - reach), np.ceil(means2d + reach)], axis=1)
    boxes = np.clip(boxes, 0, np.tile(size, 2)).astype(np.int32)
    is_visible = (boxes[:, :2] < boxes[:, 2:]).all(axis=1) & (rng.uniform(size=n) < 0.9)
    return Projection(
        means2d=means2d.astype(dtype),
        depths=(rng.uniform(1, 9, n) if depths is None else depths).astype(dtype) * is_visible,
        conics=np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=1),
        opacities=opacities.astype(dtype),
        radii=np.ceil(reach).astype(np.int32) * is_visible[:, None],
        boxes=boxes * is_visible[:, None],
    )


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


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_negative_depths_are_nearer_than_positive_ones(backend, dtype):
    """As altitudes are, which a camera above takes for depths; zeros of both signs are the same depth."""
    depths = [0.5, -2.0, 1e30, -0.0, -1e30, 0.0, -1e-30, 1e-30, -1.0, 3.0]
    grid = TileGrid(4, 4, backend.tile_width, backend.tile_height)
    p = footprints([[0, 0, 4, 4]] * 10, depths)
    projection = Projection(*(f.astype(dtype) for f in p[:2]), p.conics, p.opacities.astype(dtype), *p[4:])
    bins = backend.bin_gaussians(projection, grid, GSPLAT_MAIN)
    assert lists(bins) == [[4, 1, 8, 6, 3, 5, 7, 0, 9, 2]]


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


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_fast_lists_over_many_tiles(fast_backend, dtype, rng):
    size = (300, 200)
    projection = random_footprints(rng, 600, dtype, size)
    grid = TileGrid(*size, fast_backend.tile_width, fast_backend.tile_height)
    bins, every = (b.bin_gaussians(projection, grid, GSPLAT_MAIN) for b in (fast_backend, REFERENCE))
    listed = pairs(bins)
    assert listed <= pairs(every)
    ys, xs = np.mgrid[: size[1], : size[0]]
    tiles = ys // grid.tile_height * grid.n_tiles_x + xs // grid.tile_width  # [H, W]
    n_seen = 0
    for n in np.flatnonzero(projection.radii[:, 0]):
        a, b, c = projection.conics[n]
        dx, dy = xs + 0.5 - float(projection.means2d[n, 0]), ys + 0.5 - float(projection.means2d[n, 1])
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        x0, y0, x1, y1 = projection.boxes[n]
        is_seen = projection.opacities[n] * np.exp(-sigma) >= GSPLAT_MAIN.alpha_min
        is_seen &= (x0 <= xs) & (xs < x1) & (y0 <= ys) & (ys < y1)
        seen = {(tile, n) for tile in np.unique(tiles[is_seen])}
        assert seen <= listed
        n_seen += len(seen)
    assert 3000 < n_seen and len(listed) < 1.05 * n_seen < 0.8 * len(pairs(every))
    assert_in_order(bins, projection.depths)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("spread", ["three", "one", "neighbours", "wide", "altitudes", "signs"])
def test_order_of_any_depths(fast_backend, dtype, spread, rng):
    n = 400
    depths = {
        "three": rng.choice([0.5, 2.0, 7.0], n),
        "one": np.full(n, 3.0),
        "neighbours": dtype(3) + np.spacing(dtype(3)) * rng.integers(0, 50, n),  # float64: alike as float32
        "wide": 10.0 ** rng.uniform(-30, 30, n),
        "altitudes": -rng.uniform(1, 40, n),
        "signs": 10.0 ** rng.uniform(-30, 30, n) * rng.choice([-1, 1], n),
    }[spread]
    projection = random_footprints(rng, n, dtype, depths=depths)
    grid = TileGrid(300, 200, fast_backend.tile_width, fast_backend.tile_height)
    bins = fast_backend.bin_gaussians(projection, grid, GSPLAT_MAIN)
    assert len(bins.gaussian_ids) > 1500
    assert_in_order(bins, projection.depths)


def test_a_gaussian_over_all_tiles(fast_backend):
    projection = footprints([[0, 0, 1000, 700]] * 3, [2, 3, 1])._replace(conics=np.tile([1e-9, 0, 1e-9], (3, 1)))
    grid = TileGrid(1000, 700, fast_backend.tile_width, fast_backend.tile_height)
    bins = fast_backend.bin_gaussians(projection, grid, GSPLAT_MAIN)
    assert lists(bins) == [[2, 0, 1]] * (grid.n_tiles_x * grid.n_tiles_y)
    assert_array_equal(np.diff(bins.gaussian_offsets), [grid.n_tiles_x * grid.n_tiles_y] * 3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("reach", [1e14, 1e17])
def test_the_flattest_conics_reach_the_image_from_far_away(fast_backend, reach, dtype):
    """One standard deviation beside the image, which is alpha 0.9 exp(-1/2) in every pixel."""
    p = footprints([[0, 0, 64, 32]], [2.0])
    p = p._replace(means2d=np.array([[reach, 16.0]]), conics=np.array([[reach**-2.0, 0, reach**-2.0]]))
    p = Projection(*(field.astype(dtype) for field in p[:2]), p.conics, p.opacities.astype(dtype), *p[4:])
    grid = TileGrid(64, 32, fast_backend.tile_width, fast_backend.tile_height)
    bins = fast_backend.bin_gaussians(p, grid, GSPLAT_MAIN)
    assert_array_equal(np.diff(bins.tile_offsets), 1)
    alpha = fast_backend.composite(p, np.ones((1, 3), dtype), np.zeros(3, dtype), bins, GSPLAT_MAIN).alpha
    assert_allclose(alpha, 0.9 * np.exp(-0.5), rtol=PARITY_FLOAT32_IMAGE)


def test_a_row_under_the_box_that_the_ellipse_does_not_reach(fast_backend):
    width, height = fast_backend.tile_width, fast_backend.tile_height
    circle = footprints([[0, 0, 2 * width, 2 * height]], [1])._replace(  # of radius 3.3
        means2d=np.array([[width - 1.0, height - 4.0]]), conics=np.array([[1.0, 0.0, 1.0]])
    )
    bins = fast_backend.bin_gaussians(circle, TileGrid(2 * width, 2 * height, width, height), GSPLAT_MAIN)
    assert lists(bins) == [[0], [0], [], []]


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
@pytest.mark.parametrize("n", [7, 900])  # fewer Gaussians than parts, and more
def test_same_lists_at_any_number_of_threads(n, rng):
    projection = random_footprints(rng, n, np.float32)
    grid = TileGrid(300, 200, CPU.tile_width, CPU.tile_height)
    n_threads = numba.get_num_threads()
    try:
        results = []
        for count in (1, 2):
            numba.set_num_threads(count)
            results.append(CPU.bin_gaussians(projection, grid, GSPLAT_MAIN))
    finally:
        numba.set_num_threads(n_threads)
    one, two = results
    assert len(one.gaussian_ids) > n and one.grid == two.grid
    assert all(a.tobytes() == b.tobytes() for a, b in zip(one[:4], two[:4], strict=True))
