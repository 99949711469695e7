"""Footprints on tangent planes by hand, for a camera that is turned and has two focal lengths."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.mechanisms.tangent.planes import FootprintGradient, TangentFootprints, hit, project, project_vjp
from minisplat_ref.rendering import activate
from minisplat_ref.types import Gaussians
from scenes import balls, in_front_of, make_camera, turned_camera
from tolerances import CLOSED_FORM, PARITY_FLOAT64

N = np.array([0.6, 0.0, 0.8])  # a direction in the camera's frame


def footprint_of_a_ball():
    """The ball of deviation 0.3 at 5 N in front of the camera with the focal lengths 40 and 25."""
    camera = turned_camera(80, 28, fx=40.0, fy=25.0)
    primitives = activate(balls(in_front_of(camera, 5 * N), [0.3], [0.9]))
    return primitives, camera, project(primitives, camera, GSPLAT_MAIN)


def test_the_low_pass_is_that_of_the_mean_focal_length():
    """K is ``1 / (0.06^2 + 0.3 / (40 * 25))``, which is 1 / 0.0039, in all directions but N."""
    _, _, footprints = footprint_of_a_ball()
    assert_allclose(footprints.normals, [N], atol=CLOSED_FORM)
    assert_allclose(footprints.conics[0], (np.eye(3) - np.outer(N, N)) / 0.0039, rtol=1e-10, atol=1e-10)
    assert_allclose([footprints.distances[0], footprints.depths[0]], [5, 4], rtol=PARITY_FLOAT64)


def test_the_gradient_of_a_direction_as_one_of_a_pixel():
    """Of (1, 2, 3), the part along N is 3; (-0.8, 2, 0.6) is left. Times n_z = 0.8 over the focal lengths 40 and 25."""
    primitives, camera, footprints = footprint_of_a_ball()
    v = FootprintGradient(np.array([[1.0, 2.0, 3.0]]), np.zeros((1, 3, 3)), np.zeros(1), np.zeros(1))
    v_primitives, v_means2d = project_vjp(primitives, camera, GSPLAT_MAIN, footprints, v)
    assert_allclose(v_means2d, [[-0.016, 0.064]], rtol=1e-12)
    # A mean at the distance 5 turns the direction by a fifth of its step.
    assert_allclose(v_primitives.means, [np.array([-0.8, 2.0, 0.6]) / 5 @ camera.cam_from_world_R], rtol=1e-12)


def test_a_direction_behind_the_image_has_no_pixel():
    camera = turned_camera()
    primitives = activate(balls(in_front_of(camera, 5 * N * [1, 1, -1]), [9.0], [0.9]))
    v = FootprintGradient(np.array([[1.0, 2.0, 3.0]]), np.zeros((1, 3, 3)), np.zeros(1), np.zeros(1))
    footprints = project(primitives, camera, GSPLAT_MAIN)
    v_primitives, v_means2d = project_vjp(primitives, camera, GSPLAT_MAIN, footprints, v)
    assert_array_equal(v_means2d, 0)
    assert np.abs(v_primitives.means).min() > 0.01


@pytest.mark.parametrize(("thickness", "counts_as"), [(1e-5, 1e-3), (1e-3, 1e-3), (2e-3, 2e-3)])
def test_depths_of_flat_gaussians_are_those_of_a_thousandth_of_their_length(thickness, counts_as):
    """A disc of radius 0.5 at (0.4, 0, 4), normal to n = (0.6, 0, 0.8), and the ray along the axis.

    It is densest at ``t = (d^T W x) / (d^T W d)`` with ``W = I / 0.25 + (1 / (0.5 k)^2 - 1 / 0.25) n n^T``.
    """
    camera, n, x = turned_camera(), N, np.array([0.4, 0.0, 4.0])
    half = camera.cam_from_world_R.T @ n + [0, 0, 1]  # a half turn about it takes z to n, in the world
    disc = Gaussians(
        in_front_of(camera, x),
        np.array([[0.0, *half]]),
        np.log([[0.5, 0.5, 0.5 * thickness]]),
        np.array([2.0]),
        np.zeros((1, 3)),
        np.zeros((1, 0, 3)),
    )
    footprints = project(activate(disc), camera, GSPLAT_MAIN)
    d = np.array([0.0, 0.0, 1.0])
    W = np.eye(3) / 0.25 + (1 / (0.5 * counts_as) ** 2 - 1 / 0.25) * np.outer(n, n)
    found = hit(footprints, np.zeros(1, int), np.array([[camera.cx, camera.cy]])).depths
    assert_allclose(found, [[(d @ W @ x) / (d @ W @ d)]], rtol=1e-9)
    assert abs(found[0, 0] - (n @ x) / (n @ d)) > 1e-7  # not quite where the plane is


def test_a_ray_meets_the_plane_up_to_a_millionth_of_a_right_angle():
    """Rays at 90 degrees less 2e-6 and less 0.5e-6 radians, and beyond 90 degrees, of an enormous Gaussian.

    The first meets its tangent plane at the distance 5e5, where ``exp(-1e-12 (5e5)^2 / 2)`` is 0.8825 of it left.
    """
    one = np.ones(1)
    footprints = TangentFootprints(
        normals=np.array([[1.0, 0.0, 0.0]]),
        conics=1e-12 * np.diag([0.0, 1.0, 1.0])[None],
        opacities=one,
        distances=one,
        depths=one,
        whitenings=np.eye(3)[None],
        centers=np.array([[1.0, 0.0, 0.0]]),
        radii=np.ones((1, 2), np.int32),
        boxes=np.array([[0, 0, 24, 18]], np.int32),
        camera=make_camera(fx=1.0, fy=1.0, cx=0.0, cy=0.0),
    )
    pixels = np.array([[2e-6, 0.0], [0.5e-6, 0.0], [0.0, 0.0], [-2e-6, 0.0]])
    found = hit(footprints, np.zeros(1, int), pixels)
    assert_allclose(found.unclamped, [[np.exp(-0.125), 0, 0, 0]], rtol=1e-9)
