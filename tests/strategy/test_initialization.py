"""The first population."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.strategy import initialization
from minisplat_ref.strategy.initialization import (
    are_seen,
    box_around,
    gaussians_from_points,
    initial_gaussians,
    random_points,
)
from minisplat_ref.types import Optics, Scene, View
from scenes import make_camera
from tolerances import ROUNDED_TO_FLOAT32

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
GREY = np.full((4, 3), 128, np.uint8)


def make_scene(points, cameras):
    views = tuple(
        View(f"view{i}", camera, np.zeros((camera.height, camera.width, 3), np.uint8), None)
        for i, camera in enumerate(cameras)
    )
    return Scene("scene", views, (), points, np.full((len(points), 3), 128, np.uint8), np.zeros(3), 2.0)


def test_scale_is_the_root_mean_square_distance():
    """Corner of a unit square: distances 1, 1, sqrt 2, so sqrt(4 / 3) = 1.155; the mean distance would be 1.138."""
    gaussians = gaussians_from_points(SQUARE, GREY, 3)
    assert_allclose(np.exp(gaussians.log_scales), np.sqrt(4 / 3), rtol=ROUNDED_TO_FLOAT32)


def test_only_the_three_nearest_count():
    far = np.array([[100.0, 0, 0]])
    gaussians = gaussians_from_points(np.concatenate([SQUARE, far]), np.zeros((5, 3), np.uint8), 0)
    assert_allclose(np.exp(gaussians.log_scales[:4]), np.sqrt(4 / 3), rtol=ROUNDED_TO_FLOAT32)
    assert gaussians.log_scales[4, 0] > np.log(98)


def test_points_in_one_place_get_the_least_scale():
    gaussians = gaussians_from_points(np.ones((5, 3)), np.zeros((5, 3), np.uint8), 0)
    assert_allclose(gaussians.log_scales, 0.5 * np.log(1e-7), rtol=ROUNDED_TO_FLOAT32)


@pytest.mark.parametrize(("degree", "n_rest"), [(0, 0), (1, 3), (3, 15)])
def test_other_parameters(degree, n_rest):
    colors = np.arange(12, dtype=np.uint8).reshape(4, 3) * 20
    gaussians = gaussians_from_points(SQUARE, colors, degree)
    assert_array_equal(gaussians.means, SQUARE)
    assert_array_equal(gaussians.quats, [[1, 0, 0, 0]] * 4)
    assert_allclose(1 / (1 + np.exp(-gaussians.opacity_logits)), 0.1, rtol=ROUNDED_TO_FLOAT32)
    assert_allclose(0.5 + SH_C0 * gaussians.sh_dc, colors / 255, atol=ROUNDED_TO_FLOAT32)
    assert_array_equal(gaussians.sh_rest, np.zeros((4, n_rest, 3)))
    assert all(field.dtype == np.float32 and field.flags.c_contiguous for field in gaussians)


def test_too_few_points_are_refused():
    with pytest.raises(InputError, match="points has 3 rows"):
        gaussians_from_points(SQUARE[:3], GREY[:3], 3)


def test_random_points_are_inside_the_cube_and_seen(rng):
    cameras = [make_camera(), make_camera()._replace(cam_from_world_t=np.array([0.0, 0.0, -1.0]))]  # centres z = 0, 1
    points = random_points(cameras, box_around(cameras, 3.0), 4_000, rng)
    assert 100 < len(points) < 4_000  # the frusta fill part of the cube
    assert np.abs(points - [0, 0, 0.5]).max() <= 3.0
    x, y, z = points.T
    u, v = 30.0 * x / z + 12, 28.0 * y / z + 9
    in_first = (z > 0) & (u > 0) & (u < 24) & (v > 0) & (v < 18)
    u, v = 30.0 * x / (z - 1) + 12, 28.0 * y / (z - 1) + 9
    in_second = (z > 1) & (u > 0) & (u < 24) & (v > 0) & (v < 18)
    assert np.all(in_first | in_second)
    assert points[:, 2].max() > 3.0  # to the far side of the cube, 3.5


def test_a_camera_sees_up_to_the_edges_of_its_image():
    """Points a quarter of a pixel inside and outside each edge of 24 x 18 pixels, at a depth of 2; and one behind."""
    inside = np.array([[0.25, 9], [23.75, 9], [12, 0.25], [12, 17.75]])
    outside = np.array([[-0.25, 9], [24.25, 9], [12, -0.25], [12, 18.25]])
    pixels = np.concatenate([inside, outside, [[12, 9]]])
    points = 2.0 * np.column_stack([(pixels - [12, 9]) / [30, 28], np.ones(9)])
    points[8] *= -1
    assert_array_equal(are_seen(points, [make_camera()]), [True] * 4 + [False] * 5)


def test_a_lens_counts_as_seeing_what_its_kind_may():
    """Beside a pinhole's image, and behind the camera: a distorting lens may see the first, a fisheye both."""
    points = np.array([[0.0, 0.0, 2.0], [9.0, 0.0, 2.0], [0.0, 0.0, -2.0]])
    for optics, expected in (
        (None, [True, False, False]),
        (Optics("brown", (0.1,) + 7 * (0.0,)), [True, True, False]),
        (Optics("fisheye", (0.0,) * 4), [True, True, True]),
    ):
        assert are_seen(points, [make_camera()._replace(optics=optics)]).tolist() == expected


def test_scene_decides_where_points_come_from(rng, monkeypatch):
    monkeypatch.setattr(initialization, "N_RANDOM_POINTS", 500)
    from_sfm = initial_gaussians(make_scene(SQUARE, [make_camera()]), 1, rng)
    assert_array_equal(from_sfm.means, SQUARE)
    at_random = initial_gaussians(make_scene(SQUARE[:3], [make_camera()]), 1, rng)
    assert 3 < len(at_random.means) <= 500
    assert at_random.sh_rest.shape == (len(at_random.means), 3, 3)
    assert np.ptp(at_random.sh_dc) > 1  # colours are drawn, too
    box = np.array([[-1.0, -2.0, 1.0], [1.0, 2.0, 3.0]])
    boxed = initial_gaussians(make_scene(SQUARE[:3], [make_camera()])._replace(random_box=box), 1, rng)
    assert len(boxed.means) > 100 and (boxed.means > box[0]).all() and (boxed.means < box[1]).all()
    assert_allclose(np.abs(boxed.means[:, 2] - 2).max(), 1, atol=0.05)  # they fill it
    assert_allclose(0.5 + SH_C0 * boxed.sh_dc, 127 / 255, atol=ROUNDED_TO_FLOAT32)
