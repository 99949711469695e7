"""The sort and the lists of the backend cuda beside NumPy's, in Numba's simulator, whose blocks are small."""

import numpy as np
import pytest

from cuda_simulator import run_in_simulator
from cuda_sorting import COUNTED, DEPTHS, GRID, SORTED, make_ellipses, make_keys, make_projection
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.rendering.backends import REFERENCE

pytest.importorskip("numba_cuda", reason="the extra minisplat_ref[cuda] is not installed")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    return run_in_simulator("cuda_sorting.py", tmp_path_factory.mktemp("sorting") / "results.pickle")


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
@pytest.mark.parametrize("n", SORTED)
def test_equal_keys_keep_their_order(dtype, n, simulated):
    keys, (found_keys, found_order) = make_keys(n, dtype), simulated[0][dtype.__name__, n]
    order = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(found_keys, keys[order])
    np.testing.assert_array_equal(found_order, order)
    assert (found_keys.dtype, found_order.dtype) == (dtype, np.int32)


@pytest.mark.parametrize("n", COUNTED)
def test_lists_of_many_blocks_are_those_of_the_reference(n, simulated):
    found, expected = simulated[1][n], REFERENCE.bin_gaussians(make_projection(n), GRID, GSPLAT_MAIN)
    for x, y in zip(found[:4], expected[:4], strict=True):
        assert (x.dtype, x.tobytes()) == (y.dtype, y.tobytes())


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_negative_depths_are_nearer_than_positive_ones(dtype, simulated):
    """As altitudes are, which a camera above takes for depths; zeros of both signs are the same depth."""
    assert simulated[2][dtype].tolist() == np.argsort(DEPTHS, kind="stable").tolist() == [4, 1, 8, 6, 3, 5, 7, 0, 9, 2]


def test_without_room_the_lists_are_empty_and_the_number_is_right(simulated):
    expected = simulated[1][70]
    (enough, (found, lists)), (less, (counted, empty)) = simulated[3].items()
    assert enough == less + 1 == found == counted == len(expected.gaussian_ids)
    assert lists.ids.tobytes() == expected.gaussian_ids.tobytes()
    assert lists.offsets[-1] == enough and not empty.offsets.any()


def test_a_block_adds_the_sums_of_those_before_until_one_knows_the_rest(simulated):
    before, published, is_sum_of_all = simulated[5]
    assert before == 5 + 20 + 300 and is_sum_of_all
    assert published == [0, 5, 0, 20, 0, 300, 0, 1325, 0]


def tiles_with_a_visible_pixel(box, center, conic, opacity):
    """Tiles under a box in which alpha reaches the threshold at some pixel's centre, as columns and rows of the box."""
    x, y = np.meshgrid(np.arange(box[0], box[2]), np.arange(box[1], box[3]))
    dx, dy = center[0] - (x + 0.5), center[1] - (y + 0.5)
    a, b, c = conic
    alpha = opacity * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
    seen = alpha >= GSPLAT_MAIN.alpha_min
    return set(zip(x[seen] // 16 - box[0] // 16, y[seen] // 16 - box[1] // 16, strict=True))


def test_tiles_that_an_ellipse_misses_are_left_out(simulated):
    """None with a visible pixel is, and nearly all others are."""
    n_needed, n_kept, n_under_boxes = 0, 0, 0
    for (tiles, count), *ellipse in zip(simulated[4].tolist(), *make_ellipses(), strict=True):
        x0, y0, x1, y1 = ellipse[0]
        n_columns, n_rows = -(-x1 // 16) - x0 // 16, -(-y1 // 16) - y0 // 16
        if min(n_columns, n_rows) < 2 or max(n_columns, n_rows) > 8:
            assert (tiles, count) == (-1, max(n_columns * n_rows, 0))
            continue
        kept = {(c, r) for c in range(n_columns) for r in range(n_rows) if tiles >> (8 * r + c) & 1}
        needed = tiles_with_a_visible_pixel(*ellipse)
        assert needed <= kept and len(kept) == count
        n_needed, n_kept, n_under_boxes = n_needed + len(needed), n_kept + count, n_under_boxes + n_columns * n_rows
    # 433 are kept where 432 are needed; with rows of tiles that are a pixel higher, it is 441.
    assert 100 < n_kept <= 1.01 * n_needed < 0.8 * n_under_boxes
