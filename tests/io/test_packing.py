"""Morton order, and integers as planes of bytes."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_array_equal

from minisplat_ref.io.packing.morton import morton_cells, morton_codes, morton_order
from minisplat_ref.io.packing.planes import from_planes, to_planes, unzigzag, zigzag

# Morton order and planes of bytes


def test_morton_codes_interleave_bits(rng):
    cells = rng.integers(0, 2**21, size=(50, 3), dtype=np.uint64)
    cells[:4] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [2**21 - 1] * 3]
    expected = [sum((int(x[a]) >> b & 1) << (3 * b + a) for b in range(21) for a in range(3)) for x in cells]
    assert expected[:4] == [1, 2, 4, 2**63 - 1]
    assert morton_codes(cells).tolist() == expected


def test_morton_order_walks_an_octree(rng):
    """The eight corners of a cube come with x fastest; equal points keep their order."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float64)
    shuffled = rng.permutation(8)
    assert_array_equal(corners[shuffled][morton_order(corners[shuffled])], corners)
    assert_array_equal(morton_order(np.ones((5, 3))), np.arange(5))
    assert morton_order(np.zeros((0, 3))).shape == (0,)


def test_cells_are_cubes_or_have_the_proportions_of_the_box():
    """Of points in a box of 8 x 2 x 0, the third has half of the longest side, and all of the second axis."""
    points = np.array([[-1.0, 5, 3], [7, 5, 3], [3, 7, 3]])
    last = 2**21 - 1
    assert_array_equal(morton_cells(points), [[0, 0, 0], [last, 0, 0], [2**20, 2**19, 0]])
    assert_array_equal(morton_cells(points, is_cubic=False), [[0, 0, 0], [last, 0, 0], [2**20, last, 0]])


def test_morton_neighbours_are_near(rng):
    points = rng.uniform(size=(2000, 3))

    def step(p):
        return np.linalg.norm(np.diff(p, axis=0), axis=1).mean()

    assert step(points[morton_order(points)]) < 0.2 * step(points)


@given(hnp.arrays(np.int64, st.tuples(st.integers(0, 5), st.integers(0, 4)), elements=st.integers(-(2**63), 2**63 - 1)))
def test_planes_round_trip(values):
    raw, n_planes = to_planes(zigzag(values))
    assert_array_equal(unzigzag(from_planes(raw, n_planes, values.shape[1], len(values))), values)
    assert len(raw) == n_planes * values.size


def test_zigzag_keeps_small_numbers_small():
    assert zigzag(np.array([0, -1, 1, -2, 2])).tolist() == [0, 1, 2, 3, 4]
    assert to_planes(zigzag(np.array([[-128, 127]])))[1] == 1
    assert to_planes(zigzag(np.array([[-129, 0]])))[1] == 2
