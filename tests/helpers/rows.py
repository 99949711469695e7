"""Tables with a row for each Gaussian, compared between two statements of a projection."""

import numpy as np
from numpy.testing import assert_array_equal

from tolerances import PARITY_FLOAT64


def assert_same_rows(found, expected, names):
    """Compare the fields of these names: floats by the largest of each row, whole numbers exactly."""
    for name in names:
        got, want = getattr(found, name), getattr(expected, name)
        assert got.dtype == want.dtype and got.shape == want.shape, name
        if want.dtype == np.int32:
            assert_array_equal(got, want, err_msg=name)
        else:
            per_row = tuple(range(1, want.ndim))
            size = np.abs(want).max(axis=per_row, initial=0)
            error = np.abs(got - want).max(axis=per_row, initial=0)
            assert (error <= PARITY_FLOAT64 * size).all(), (name, error / np.where(size > 0, size, 1))
