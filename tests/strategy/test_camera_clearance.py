"""The free balls of cameras: their radii, and Gaussians of known axes that are just in them or just not."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.strategy import camera_clearance
from minisplat_ref.strategy.camera_clearance import FreeBalls, are_in_free_balls, find_free_balls
from minisplat_ref.types import Optics, Primitives, view_from
from scenes import make_camera, turned_camera
from tolerances import CLOSED_FORM

TURN = np.array([np.cos(np.pi / 6), 0.0, 0.0, np.sin(np.pi / 6)])  # by 60 degrees about z
SOME = np.array([0])  # point_ids


def view_at(center, point_ids=SOME, optics=None):
    camera = make_camera()._replace(cam_from_world_t=-np.asarray(center, float), optics=optics)
    return view_from(camera)._replace(point_ids=point_ids)


def at_distances(*distances):
    """Points around the origin, none of them in the direction of another."""
    directions = np.random.default_rng(0).normal(size=(len(distances), 3))
    return np.array(distances)[:, None] * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def one(mean, scales, quat=(1.0, 0.0, 0.0, 0.0)):
    return Primitives(np.array([mean], float), np.array([quat]), np.array([scales], float), np.ones(1))


def is_in(primitives, radius, n_sigmas=1.0, center=(0, 0, 0)):
    return are_in_free_balls(primitives, FreeBalls(np.array([center], float), np.array([radius])), n_sigmas)[0]


# --- balls ---


def test_a_radius_is_a_share_of_the_distance_of_the_third_nearest_point():
    """Two mistakes before the lens change nothing, and the distance is not the depth: most of these are beside it."""
    balls = find_free_balls([view_at([0, 0, 0])], at_distances(9.0, 0.2, 4.0, 0.1, 7.0), 0.5)
    assert_array_equal(balls.centers, [[0, 0, 0]])
    assert_allclose(balls.radii, [2.0], rtol=CLOSED_FORM)


def test_centers_are_those_of_turned_cameras():
    """A point at the camera's origin is at the centre; the three nearest are at 1, 2 and 3 along its axes."""
    camera = turned_camera()
    points = (np.diag([1.0, 2.0, 3.0]) - camera.cam_from_world_t) @ camera.cam_from_world_R
    balls = find_free_balls([view_from(camera)._replace(point_ids=SOME)], points, 1.0)
    assert_allclose(balls.centers, [camera.center], rtol=CLOSED_FORM)
    assert_allclose(balls.radii, [3.0], rtol=CLOSED_FORM)


def test_each_camera_has_its_own_ball():
    balls = find_free_balls([view_at([0, 0, 0]), view_at([2, 0, 0])], np.array([[6.0, 0, 0]] * 3), 0.5)
    assert_allclose(balls.radii, [3.0, 2.0], rtol=CLOSED_FORM)


def test_points_of_other_photographs_shrink_a_ball():
    """A macro photograph has found a flower at 2, beside the camera that shows a wall at 10."""
    wall = np.array([[0, 0, 10.0], [1, 0, 10.0], [0, 1, 10.0]])
    flower = np.array([[2.0, 0, 0], [2.0, 0.1, 0], [2.0, 0, -0.1]])
    far, macro = view_at([0, 0, 0], np.arange(3)), view_at([2.5, 0, 0], np.arange(3, 6))
    with_flower = find_free_balls([far, macro], np.concatenate([wall, flower]), 0.5)
    assert_allclose(with_flower.radii, 0.5 * np.sqrt([4.01, 0.26]), rtol=CLOSED_FORM)
    assert find_free_balls([far], wall, 0.5).radii[0] > 5
    petals = Primitives(flower, np.tile([1.0, 0, 0, 0], (3, 1)), np.full((3, 3), 0.1), np.ones(3))
    assert not are_in_free_balls(petals, with_flower, 1.0).any()
    assert are_in_free_balls(petals, find_free_balls([far], wall, 0.5), 1.0).all()


@pytest.mark.parametrize(
    "view",
    [
        view_at([0, 0, 0], None),
        view_at([0, 0, 0], np.zeros(0, int)),
        view_at([0, 0, 0], SOME, Optics("orthographic")),
        view_at([0, 0, 0], SOME, Optics("affine", (0.0, 1.0, 0.0, 0.0, 0.0))),
    ],
)
def test_views_without_tracks_or_a_center_have_no_ball(view):
    assert find_free_balls([view], at_distances(1.0, 1.0, 1.0), 0.5).radii.shape == (0,)
    both = find_free_balls([view, view_at([0, 0, 0.5])], np.array([[0, 0, 2.5]] * 3), 0.5)
    assert_array_equal(both.centers, [[0, 0, 0.5]])
    assert_allclose(both.radii, [1.0], rtol=CLOSED_FORM)


@pytest.mark.parametrize("model", ["brown", "fisheye"])
def test_other_lenses_have_a_center(model):
    assert len(find_free_balls([view_at([0, 0, 0], SOME, Optics(model))], at_distances(1.0, 1.0, 1.0), 0.5).radii) == 1


@pytest.mark.parametrize("distances", [(), (1.0,), (1.0, 1.0)])
def test_two_points_are_no_surface(distances):
    assert find_free_balls([view_at([0, 0, 0])], at_distances(*distances).reshape(-1, 3), 0.5).radii.shape == (0,)


def test_no_ball_without_a_share_views_or_distance():
    points = at_distances(1.0, 1.0, 1.0)
    assert find_free_balls([view_at([0, 0, 0])], points, 0.0).centers.shape == (0, 3)
    assert find_free_balls([], points, 0.5).centers.shape == (0, 3)
    assert len(find_free_balls([view_at([0, 0, 0])], np.zeros((3, 3)), 0.5).radii) == 0


# --- Gaussians ---


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_widths_add_as_squares_along_the_direction_to_the_camera(axis):
    """At 5 along an axis of standard deviation 3 a ball of 4 just does not count; the other axes do not matter."""
    mean, scales = np.zeros(3), np.full(3, 7.0)
    mean[axis], scales[axis] = 5.0, 3.0
    assert not is_in(one(mean, scales), 4.0 - 1e-9)
    assert is_in(one(mean, scales), 4.0 + 1e-9)
    assert is_in(one(-mean, scales), 4.0 + 1e-9)


def test_axes_are_those_of_the_rotation():
    """Turned by 60 degrees about z, its x axis points to (1/2, sqrt(3)/2, 0)."""
    along = 5 * np.array([0.5, np.sqrt(0.75), 0.0])
    across = 5 * np.array([-np.sqrt(0.75), 0.5, 0.0])
    long = (3.0, 0.1, 0.1)
    assert is_in(one(along, long, TURN), 4.01)
    assert not is_in(one(along, long, TURN), 3.99)
    assert not is_in(one(across, long, TURN), 4.99)
    assert not is_in(one(along, long, TURN * [1, 1, 1, -1]), 4.5)
    assert is_in(one(along, long, 7 * TURN), 4.01)  # quaternions are not normalised


def test_an_oblique_direction():
    """16 / (7 + 9) + ... : with r^2 = 7, offsets (3, 2, 1) and axes (3, 2, 1): 9/16 + 4/11 + 1/8 > 1 > with r^2 = 8."""
    gaussian = one([3.0, 2.0, 1.0], [3.0, 2.0, 1.0])
    assert 9 / 16 + 4 / 11 + 1 / 8 > 1 > 9 / 17 + 4 / 12 + 1 / 9
    assert not is_in(gaussian, np.sqrt(7))
    assert is_in(gaussian, np.sqrt(8))


@pytest.mark.parametrize(("n_sigmas", "edge"), [(0.0, 5.0), (1.0, np.sqrt(24.0)), (2.0, np.sqrt(21.0))])
def test_standard_deviations_that_count(n_sigmas, edge):
    gaussian = one([0, 3.0, 4.0], [1.0, 1.0, 1.0])
    assert not is_in(gaussian, edge - 1e-9, n_sigmas)
    assert is_in(gaussian, edge + 1e-9, n_sigmas)


def test_a_wall_beside_a_camera_stays_however_long_it_is():
    """At 1.1, a hundredth thick and 100 long, with its mean anywhere along it. One that is 0.5 thick is fog."""
    for along in (0.0, 3.0, 15.0):
        assert not is_in(one([1.1, along, 0], [0.01, 100.0, 100.0]), 1.0)
        assert is_in(one([1.1, along, 0], [0.5, 100.0, 100.0]), 1.0)


def test_a_camera_inside_a_large_gaussian():
    """The mean is ten balls away, but the camera stands in it."""
    assert is_in(one([10.0, 0, 0], [11.0, 1.0, 1.0]), 1.0)
    assert not is_in(one([10.0, 0, 0], [9.0, 1.0, 1.0]), 1.0)


def test_a_gaussian_without_size_is_its_mean():
    assert is_in(one([0, 0, 0.999], [0.0, 0.0, 0.0]), 1.0)
    assert not is_in(one([0, 0, 1.001], [0.0, 0.0, 0.0]), 1.0)
    assert is_in(one([0, 0, 0], [0.0, 0.0, 0.0]), 1.0)


def test_the_largest_scales_of_float32():
    gaussian = one([5.0, 0, 0], [1.0, 1.0, 1.0])
    huge = Primitives(*(field.astype(np.float32) for field in gaussian))._replace(
        scales=np.full((1, 3), np.finfo(np.float32).max)
    )
    assert is_in(huge, 1.0)


def test_nothing_without_gaussians_or_balls():
    nobody = Primitives(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0))
    no_balls = FreeBalls(np.zeros((0, 3)), np.zeros(0))
    assert are_in_free_balls(nobody, FreeBalls(np.zeros((1, 3)), np.ones(1)), 1.0).shape == (0,)
    assert list(are_in_free_balls(one([0, 0, 0], [1, 1, 1]), no_balls, 1.0)) == [False]


@pytest.mark.parametrize("rows", [1, 7, 1024])
def test_many_at_a_time_are_each_alone(rng, monkeypatch, rows):
    """Against the formula of the docstring, pair by pair, with inverses of matrices and nothing left out."""
    monkeypatch.setattr(camera_clearance, "ROWS", rows)
    n, n_balls = 200, 9
    quats = rng.normal(size=(n, 4))
    primitives = Primitives(rng.normal(size=(n, 3)), quats, np.exp(rng.normal(-1.5, 1, (n, 3))), np.ones(n))
    balls = FreeBalls(rng.normal(size=(n_balls, 3)), rng.uniform(0.05, 0.8, n_balls))
    found = are_in_free_balls(primitives, balls, 1.5)
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    covariances = np.einsum("nij,nj,nkj->nik", R, primitives.scales**2, R)
    expected = np.zeros(n, bool)
    for c, r in zip(*balls, strict=True):
        offsets = c - primitives.means
        blurred = 1.5**2 * covariances + r * r * np.eye(3)
        expected |= np.einsum("ni,nij,nj->n", offsets, np.linalg.inv(blurred), offsets) < 1
    assert 20 < expected.sum() < 180
    assert_array_equal(found, expected)
