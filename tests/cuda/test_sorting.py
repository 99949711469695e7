"""The scan and the sort of the backend cuda beside NumPy's, in Numba's simulator, with blocks of a few numbers."""

import numpy as np
import pytest

from cuda_simulator import run_in_simulator
from cuda_sorting import DEPTHS, SCANNED, SORTED, make_counts, make_keys

pytest.importorskip("numba_cuda", reason="the extra minisplat_ref[cuda] is not installed")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    return run_in_simulator("cuda_sorting.py", tmp_path_factory.mktemp("sorting") / "results.pickle")


@pytest.mark.parametrize("n", SCANNED)
def test_sums_before_each_number(n, simulated):
    assert simulated[0][n].tolist() == [0, *np.cumsum(make_counts(n))]


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
@pytest.mark.parametrize("n", SORTED)
def test_equal_keys_keep_their_order(dtype, n, simulated):
    keys, (found_keys, found_order) = make_keys(n, dtype), simulated[1][dtype.__name__, n]
    order = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(found_keys, keys[order])
    np.testing.assert_array_equal(found_order, order)
    assert (found_keys.dtype, found_order.dtype) == (dtype, np.int32)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_negative_depths_are_nearer_than_positive_ones(dtype, simulated):
    """As altitudes are, which a camera above takes for depths; zeros of both signs are the same depth."""
    assert simulated[2][dtype].tolist() == np.argsort(DEPTHS, kind="stable").tolist() == [4, 1, 8, 6, 3, 5, 7, 0, 9, 2]
