"""Rules and constants of the dense start, each by a value that was worked out by hand; what sweeps find is given."""

import numpy as np
import pytest

from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.strategy.plane_sweep import DepthMap
from minisplat_ref.training import dense_start
from minisplat_ref.training.dense_start import choose_neighbours, densify_points, is_before_sparse
from minisplat_ref.types import Scene, View, view_from
from scenes import make_camera

AT_TEN = np.tile([0.0, 0.0, 10.0], (16, 1))  # sparse points, all in one place on the axis


def moved(camera, x):
    """The camera, x to the right of the origin."""
    return camera._replace(cam_from_world_t=np.array([-x, 0.0, 0.0]))


def photographed(camera, ids=range(16), image=None):
    image = np.zeros((camera.height, camera.width, 3), np.uint8) if image is None else image
    return View("", camera, image, None, point_ids=np.array(ids, int))


def scene_of(views, points=AT_TEN, extent=1.0):
    return Scene("hand", tuple(views), (), points, np.zeros((len(points), 3), np.uint8), np.zeros(3), extent)


@pytest.fixture
def sweeps(monkeypatch):
    """Arguments of all sweeps. The first finds what is in ``given``, (row, column, depth, correlation); all counts."""
    calls, given = [], []

    def sweep(view, others, inverse_depths):
        depths, correlations = np.zeros((2, *view.gray.shape))
        for row, column, depth, correlation in given if not calls else ():
            depths[row, column], correlations[row, column] = depth, correlation
        calls.append((view, others, inverse_depths))
        return DepthMap(depths, correlations)

    monkeypatch.setattr(dense_start, "sweep_planes", sweep)
    monkeypatch.setattr(dense_start, "are_confirmed", lambda view, own, others: own.depths > 0)
    return calls, given


# What is swept --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "small"),
    [
        ((288, 96), (144, 48)),
        ((96, 288), (48, 144)),
        ((146, 101), (144, 100)),  # 99.6
        ((100, 50), (100, 50)),  # never enlarged
        ((1000, 2), (144, 1)),  # not 0.3
    ],
)
def test_the_longer_side_becomes_144_pixels(sweeps, size, small):
    camera = make_camera(*size, fx=60.0, fy=90.0)
    image = np.full((size[1], size[0], 3), (30, 60, 120), np.uint8)  # 70 on the mean
    densify_points(scene_of([photographed(moved(camera, x), image=image) for x in (0, 1)]))
    view = sweeps[0][0][0]
    assert (view.camera.width, view.camera.height) == small and view.gray.shape == small[::-1]
    np.testing.assert_allclose(view.camera.fx, 60 * small[0] / size[0])
    np.testing.assert_allclose(view.camera.cy, small[1] / 2)
    np.testing.assert_allclose(view.gray, 70 / 255, rtol=1e-6)


def test_depths_between_half_of_the_nearest_and_twice_the_farthest_hundredth(sweeps):
    """Of the depths 1 to 101 the first percentile is 2, the last 100: planes from 1 / 200 to 1.

    The neighbour is 3 to the side: 30 x 3 x (1 - 1 / 200) = 89.55 pixels, 60 steps of a pixel and a half.
    """
    points = np.column_stack([np.zeros((101, 2)), np.arange(1.0, 102)])
    densify_points(scene_of([photographed(moved(make_camera(), x), range(101)) for x in (0, 3)], points))
    found = sweeps[0][0][2]
    assert len(found) == 61
    np.testing.assert_allclose(found, 1 / 200 + np.arange(61) / 60 * (1 - 1 / 200), rtol=1e-12)


@pytest.mark.parametrize(("n_track", "far"), [(8, 20.0), (7, 75.2)])
def test_of_less_than_eight_points_all_in_the_image_count(sweeps, n_track, far):
    """Eight at depth 10 and one at 40, whose last percentile is 10 + 0.92 x 30 = 37.6: the 8.92th of nine."""
    points = np.concatenate([AT_TEN[:8], [[0.0, 0, 40]]])
    densify_points(scene_of([photographed(moved(make_camera(), x), range(n_track)) for x in (0, 1)], points))
    np.testing.assert_allclose(1 / sweeps[0][0][2][[-1, 0]], [5.0, far], rtol=1e-12)


def test_without_points_three_tenths_to_twenty_extents(sweeps):
    views = [photographed(moved(make_camera(), x), []) for x in (0, 1)]
    densify_points(scene_of(views, np.zeros((0, 3)), extent=3.0))
    np.testing.assert_allclose(1 / sweeps[0][0][2][[-1, 0]], [0.9, 60.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("n", "chosen"), [(32, range(32)), (33, [*range(16), *range(17, 33)]), (63, range(0, 63, 2)), (94, range(0, 94, 3))]
)
def test_at_most_32_photographs_evenly_spread(sweeps, n, chosen):
    """Of 33 all but the middle one, of 63 every second."""
    densify_points(scene_of([photographed(moved(make_camera(8, 8), 0.1 * i)) for i in range(n)]))
    centers = [view.camera.center[0] for view, _, _ in sweeps[0]]
    np.testing.assert_allclose(centers, 0.1 * np.array(chosen), atol=1e-12)


def test_a_photograph_alone_finds_nothing(sweeps):
    points, _ = densify_points(scene_of([photographed(make_camera())]))
    np.testing.assert_array_equal(points, AT_TEN)
    assert not sweeps[0]


# Neighbours -----------------------------------------------------------------------------------------------------------


def seen_under(*degrees):
    """Views of 16 points at depth 10, whose rays make these angles with those of the first."""
    return [photographed(moved(make_camera(), 10 * np.tan(np.radians(angle)))) for angle in (0.0, *degrees)]


def test_from_six_degrees_on_angles_are_equally_good():
    """6.2 and 7 degrees count 1 for each point, and 5.8 less: 0.97."""
    assert choose_neighbours(seen_under(5.8, 6.2, 7.0), AT_TEN)[0] == [2, 3, 1]


def test_beyond_forty_degrees_no_point_counts():
    assert choose_neighbours(seen_under(39.0, 41.0), AT_TEN)[0] == [1]


@pytest.mark.parametrize(("angle", "expected"), [(3.6, [1, 2]), (3.0, [2, 1])])
def test_points_count_in_proportion_to_their_angle(angle, expected):
    """All 16 under 3.6 degrees are worth 9.6, under 3 they are worth 8; 9 under 7 degrees are worth 9."""
    views = seen_under(angle, 7.0)
    views[2] = views[2]._replace(point_ids=np.arange(9))
    assert choose_neighbours(views, AT_TEN)[0] == expected


def test_four_neighbours_at_most():
    assert choose_neighbours(seen_under(1, 2, 3, 4, 5, 5.9), AT_TEN)[0] == [6, 5, 4, 3]


def test_without_points_directions_may_differ_by_forty_degrees():
    views = [view_from(make_camera())]
    for angle in np.radians([39.0, 41.0]):
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        views.append(view_from(make_camera()._replace(cam_from_world_R=R, cam_from_world_t=np.array([1.0, 0, 0]))))
    assert choose_neighbours(views, np.zeros((0, 3)))[0] == [1]


# Before sparse points -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "radius"), [((288, 96), 2.0), ((96, 288), 2.0), ((144, 144), 1.0), ((72, 48), 1.0), ((720, 9), 5.0)]
)
def test_near_a_ray_is_a_pixel_of_the_small_photograph(size, radius):
    """A photograph of twice 144 pixels is made half as large: 1 pixel was 2. One of 72 pixels stays as it is.

    With f = 100, a point at depth 1 that is 1 / 100 to the right is 1 pixel from the axis.
    """
    view = photographed(make_camera(*size, fx=100.0, fy=100.0), [0])
    x = np.array([0.95, 1.05]) * radius / 100
    points = np.column_stack([x, np.zeros(2), np.ones(2)])
    assert list(is_before_sparse(points, [view], AT_TEN)) == [True, False]


def test_the_nearest_ray_decides():
    """Sparse points at depth 4 on the axis and at depth 2, 0.8 pixels beside it: what is between at depth 3?"""
    view = photographed(make_camera(144, 144, fx=144.0, fy=144.0), [0, 1])
    sparse = np.array([[0.0, 0, 4], [2 * 0.8 / 144, 0, 2]])
    points = np.array([[3 * 0.3 / 144, 0, 3], [3 * 0.5 / 144, 0, 3]])
    assert list(is_before_sparse(points, [view], sparse)) == [True, False]


def test_one_view_suffices():
    """From the other end, at z = 8, the point at 2 is behind the sparse one at 4."""
    camera = make_camera(144, 144, fx=144.0, fy=144.0)
    opposite = camera._replace(cam_from_world_R=np.diag([-1.0, 1, -1]), cam_from_world_t=np.array([0.0, 0, 8]))
    views = [photographed(camera, [0]), photographed(opposite, [0])]
    sparse, points = np.array([[0.0, 0, 4]]), np.array([[0.0, 0, 2]])
    assert is_before_sparse(points, views, sparse).all() and is_before_sparse(points, views[::-1], sparse).all()
    assert not is_before_sparse(points, views[1:], sparse).any()


# What becomes a point -------------------------------------------------------------------------------------------------


def at_pixels(camera, pixels, depth):
    """Points at the centres of pixels (row, column), before a camera at the origin."""
    rows, columns = np.array(pixels, float).T
    return depth * pinhole_rays(columns + 0.5, rows + 0.5, camera)


def test_of_two_too_near_the_one_of_higher_correlation_stays(sweeps):
    """Columns 100 and 101 are one pixel apart, 105 and 107 two; the better of each pair stays, the best comes first."""
    camera = make_camera(144, 72, fx=100.0, fy=100.0)
    rows, columns = np.mgrid[:72, :144]
    image = np.stack([rows, columns, 0 * rows], axis=2).astype(np.uint8)
    found = {(10, 100): 0.8, (10, 101): 0.9, (10, 105): 0.75, (10, 107): 0.85, (14, 101): 0.73, (14, 106): 0.74}
    sweeps[1].extend((*pixel, 2.0, correlation) for pixel, correlation in found.items())
    views = [photographed(camera, image=image), photographed(moved(camera, 1))]
    points, colors = densify_points(scene_of(views))
    expected = [(10, 101), (10, 107), (14, 106), (14, 101)]
    np.testing.assert_allclose(points[16:], at_pixels(camera, expected, 2.0), atol=1e-12)
    np.testing.assert_array_equal(colors[16:, :2], expected)


def test_three_pixels_of_the_small_photograph_lie_between_points(sweeps):
    """The small one has f = 100: at depth 2 a pixel is 0.02. 2 right and 2 down are 2.83, 3 and 1 are 3.16."""
    camera = make_camera(288, 144, fx=200.0, fy=200.0)
    stay = [(10, 100), (11, 103), (15, 100), (15, 104)]
    sweeps[1].extend((*pixel, 2.0, 0.95 - 0.01 * i) for i, pixel in enumerate(stay))
    sweeps[1].append((12, 102, 2.0, 0.75))
    sweeps[1].append((13, 98, 2.0, 0.74))  # 2.83 from (15, 100), 3.61 from (10, 100)
    points, _ = densify_points(scene_of([photographed(moved(camera, x)) for x in (0, 1)]))
    small = make_camera(144, 72, fx=100.0, fy=100.0)
    np.testing.assert_allclose(points[16:], at_pixels(small, stay, 2.0), atol=1e-12)


def test_sparse_points_stay_wherever_they_are_and_others_do_not(sweeps):
    """Before the sparse points at depth 10 are one at 5 and a new one at 2, 0.7 pixels from their ray.

    Another sparse one is as alone as a new one; four new ones, four pixels from each other, have company.
    """
    camera = make_camera(144, 72, fx=100.0, fy=100.0)
    stay = [(36, 76), (36, 80), (40, 76), (40, 80)]
    sweeps[1].extend((*pixel, 2.0, 0.9) for pixel in [(36, 72), *stay, (5, 140)])
    sparse = np.concatenate([AT_TEN, [[0.0, 0, 5], [-3.0, 0, 8]]])
    points, colors = densify_points(scene_of([photographed(moved(camera, x)) for x in (0, 1)], sparse))
    np.testing.assert_array_equal(points[:18], sparse)
    np.testing.assert_allclose(points[18:], at_pixels(camera, stay, 2.0), atol=1e-12)
    assert len(colors) == 22
