"""Sampling intervals of cameras: which centres a camera sees, and how finely."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.mechanisms.sampling import sampling_intervals
from scenes import in_front_of, turned_camera
from tolerances import PARITY_FLOAT64

CAMERA = turned_camera()  # 40 x 28 pixels; fx = 40 is the larger focal length, the principal point is (17, 12)


def at_pixel(x, y, z):
    """The world point that the camera sees at an image position and a depth."""
    return in_front_of(CAMERA, [(x - 17) / 40 * z, (y - 12) / 25 * z, z])[0]


@pytest.mark.parametrize(
    ("x", "y", "is_seen"),
    [
        (-5.9, 14, True),  # 0.15 of 40 pixels beyond the left edge are 6
        (-6.1, 14, False),
        (45.9, 14, True),
        (46.1, 14, False),
        (20, -4.1, True),  # of 28 pixels 4.2
        (20, -4.3, False),
        (20, 32.1, True),
        (20, 32.3, False),
    ],
)
def test_a_margin_around_the_image_counts_as_seen(x, y, is_seen):
    """The interval is z / 40; one that is not seen has the largest of the others, 4 / 40 here."""
    found = sampling_intervals(np.array([at_pixel(20, 14, 4.0), at_pixel(x, y, 2.0)]), [CAMERA])
    assert_allclose(found, [0.1, 0.05 if is_seen else 0.1], rtol=PARITY_FLOAT64)


@pytest.mark.parametrize(("z", "interval"), [(0.21, 0.00525), (0.19, 0.1), (-2.0, 0.1)])
def test_what_is_nearer_than_a_fifth_is_not_seen(z, interval):
    found = sampling_intervals(np.array([at_pixel(20, 14, 4.0), at_pixel(20, 14, z)]), [CAMERA])
    assert_allclose(found, [0.1, interval], rtol=PARITY_FLOAT64)
