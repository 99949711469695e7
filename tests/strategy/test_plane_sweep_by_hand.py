"""Rules and constants of the plane sweep, each by a value that was worked out by hand.

Stripes of period 5 are as wide as a window, so that each whole window holds each stripe once: of ``P`` and ``Q`` all
windows have the mean 0 and the variance 2/5, and they do not correlate. So ``c P + sqrt(1 - c^2) Q`` correlates with P
by c.
"""

import numpy as np
import pytest

from minisplat_ref.strategy import plane_sweep
from minisplat_ref.strategy.plane_sweep import (
    DepthMap,
    GrayView,
    are_confirmed,
    choose_planes,
    relative_rays,
    sweep_planes,
)
from minisplat_ref.types import Camera
from scenes import make_camera

CAMERA = make_camera(15, 10)
P, Q = np.tile([[[1.0, -1, 0, 0, 0]], [[0, 0, 1, -1, 0]]], (1, 10, 3))
VIEW = GrayView(CAMERA, P.astype(np.float32))
INVERSE = np.array([0.3, 0.4, 0.5, 0.6, 0.7])
WHOLE = np.zeros((10, 15), bool)
WHOLE[2:-2, 2:-2] = True  # whole windows
OUTSIDE = None


@pytest.fixture
def sweep_with(monkeypatch):
    """Sweep P with neighbours, given by the correlation of each at each plane."""

    def warp(rays, other, inverse_depth):
        c = other[list(INVERSE).index(inverse_depth)]
        gray = P if c is OUTSIDE else c * P + np.sqrt(1 - c * c) * Q
        return gray.astype(np.float32), np.full((10, 15), c is not OUTSIDE)

    monkeypatch.setattr(plane_sweep, "relative_rays", lambda *_: None)
    monkeypatch.setattr(plane_sweep, "warp", warp)

    class Other(tuple):
        camera = CAMERA

    return lambda *others, view=VIEW: sweep_planes(view, [Other(other) for other in others], INVERSE)


def peak(c, at=2):
    """Correlations of a neighbour that are c at one plane, and 0 beside it."""
    return [c if i == at else 0.0 for i in range(5)]


@pytest.mark.parametrize(
    ("correlations", "score"),
    [
        ([0.8], 0.8),
        ([1.0, 0.8], 1.0),
        ([-1.0, 1.0, 0.8], 0.9),
        ([0.8, -1.0, 1.0, 0.0], 0.9),
        ([1.0, 0.9, 0.0, 0.8, -1.0], 0.9),
        ([1.0, OUTSIDE, OUTSIDE], None),
    ],
)
def test_the_better_half_of_the_neighbours_is_rounded_up(sweep_with, correlations, score):
    """One of one and of two, two of three and of four, three of five; one that does not show the plane counts -1."""
    found = sweep_with(*map(peak, correlations))
    np.testing.assert_allclose(found.correlations, np.where(WHOLE, score or 0.0, 0.0), atol=1e-4)
    np.testing.assert_array_equal(found.depths > 0, WHOLE & (score is not None))


def test_each_plane_has_its_own_better_half(sweep_with):
    """Best at plane 1 are the first and the second (0.85 on the mean), at plane 2 the first and the third (0.9)."""
    found = sweep_with([0, 0.8, 0.8, 0, 0], [0, 0.9, -1, 0, 0], [0, -1, 1, 0, 0])
    np.testing.assert_allclose(found.correlations[WHOLE], 0.9, atol=1e-4)


def test_the_peak_of_the_parabola(sweep_with):
    """Through 0.5, 1 and 0.8 it is 0.15 / 0.7 of a plane beyond the middle: 1 / d = 0.5 + 0.1 * 3 / 14."""
    found = sweep_with([0.0, 0.5, 1.0, 0.8, 0.0])
    np.testing.assert_allclose(found.depths[WHOLE], 1 / (0.5 + 0.3 / 14), rtol=1e-4)


@pytest.mark.parametrize(("at", "counts"), [(0, False), (1, True), (3, True), (4, False)])
def test_the_first_and_the_last_plane_have_no_depth(sweep_with, at, counts):
    found = sweep_with(peak(1.0, at))
    np.testing.assert_allclose(found.depths, np.where(WHOLE & counts, 1 / INVERSE[at], 0.0), rtol=1e-4)


@pytest.mark.parametrize(("correlation", "counts"), [(0.69, False), (0.71, True)])
def test_seven_tenths_of_correlation(sweep_with, correlation, counts):
    assert (sweep_with(peak(correlation)).depths > 0).any() == counts


@pytest.mark.parametrize(("deviation", "counts"), [(0.0098, False), (0.0102, True)])
def test_a_hundredth_of_contrast(sweep_with, deviation, counts):
    """Of stripes of height h the variance is 2/5 h^2."""
    flat = GrayView(CAMERA, (deviation / np.sqrt(0.4) * P).astype(np.float32))
    assert (sweep_with(peak(1.0), view=flat).depths > 0).any() == counts


@pytest.mark.parametrize(("factor", "is_confirmed"), [(0.9798, False), (0.9802, True), (1.0198, True), (1.0202, False)])
def test_two_per_cent_of_the_depth_confirm(factor, is_confirmed):
    """Of the depth of the point: 0.0202 are 0.0198 of what the neighbour has, and do not confirm."""
    own, there = (DepthMap(d, d) for d in (np.full((10, 15), 4.0), np.full((10, 15), 4.0 * factor)))
    assert are_confirmed(VIEW, own, [(VIEW, there)]).all() == is_confirmed


def test_rays_in_the_frame_of_another_by_hand():
    """The ray (3/4, -1/2, 1) of pixel (3, 0) is first turned back by the camera's own rotation.

    The camera looks along world x: (a, b, c) of its frame is (c, a, b) of the world, for the other, which looks back,
    (-c, a, -b). So the ray becomes (-1, 3/4, 1/2), and t = (1, 2, 3) becomes (-3, 1, -2), taken from (0, 0, 4).
    """
    along_x, back = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), np.diag([-1.0, 1, -1])
    camera = Camera(along_x, np.array([1.0, 2, 3]), 2.0, 1.0, 2.0, 1.0, 4, 2)
    rays = relative_rays(camera, Camera(back, np.array([0.0, 0, 4]), 9.0, 9.0, 1.0, 1.0, 2, 2))
    assert rays.directions.shape == (3, 2, 4) and rays.directions.dtype == rays.t.dtype == np.float32
    np.testing.assert_allclose(rays.directions[:, 0, 3], [-1, 0.75, 0.5], atol=1e-7)
    np.testing.assert_allclose(rays.t, [3, -1, 6], atol=1e-7)


# How many planes ------------------------------------------------------------------------------------------------------


def at(x=0.0, y=0.0, z=0.0):
    """The camera at another place, looking the same way."""
    return CAMERA._replace(cam_from_world_t=-np.array([x, y, z]))


@pytest.mark.parametrize(
    ("others", "n"),
    [
        ([at(x=4)], 73),  # 30 x 4 x (1 - 1 / 10) = 108 pixels, 72 steps
        ([at(y=4)], 69),  # 28 x 4 x 0.9 = 100.8, 68 steps
        ([at(x=4), at(x=1), at(x=40)], 73),  # the middle one of three
        ([at(x=4), at(z=20)], 73),  # one that has the scene behind it does not count
        ([at(x=0.1)], 48),
        ([at(x=40)], 192),
        ([at(z=20)], 192),
    ],
)
def test_a_pixel_and_a_half_from_plane_to_plane(others, n):
    planes = choose_planes(CAMERA, others, 1.0, 10.0)
    np.testing.assert_allclose(planes, np.linspace(0.1, 1.0, n), rtol=1e-12)


def test_a_step_forward_moves_what_is_not_in_the_middle():
    """From 0.5 nearer, a pixel r from the middle is at r d / (d - 0.5): for r = 7, 14.0 and 7.4 at depths 1 and 10."""
    wide = make_camera(1201, 1)._replace(fx=300.0, fy=300.0)
    ahead = wide._replace(cam_from_world_t=np.array([0, 0, -0.5]))
    moves = np.abs(np.arange(1201) - 600) * (2 - 10 / 9.5)
    assert len(choose_planes(wide, [ahead], 1.0, 10.0)) == np.ceil(np.median(moves) / 1.5) + 1
