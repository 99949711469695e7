"""Planes through neighbours, and the normals of populations with their gradient."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_jacobian
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.oriented.planes import fit_planes
from minisplat_ref.mechanisms.oriented.thin_axis import angles_between, normals_of, normals_of_vjp, thin_axes
from minisplat_ref.types import Floats
from scenes import make_gaussians
from tolerances import CLOSED_FORM

FLAT = 1e-7  # the root of a rounded eigenvalue


def test_points_of_a_plane_give_the_plane(rng):
    normal = np.array([1.0, 2, 2]) / 3
    across = np.linalg.svd(normal[None])[2][1:]
    points = rng.uniform(-1, 1, (60, 2)) @ across + 0.7 * normal
    planes = fit_planes(points, towards=np.array([[5.0, 10, 10]]))
    assert_allclose(planes.normals, np.tile(normal, (60, 1)), atol=FLAT)
    assert planes.deviations[:, 2].max() < FLAT
    assert np.all(planes.deviations[:, 0] >= planes.deviations[:, 1])
    assert_allclose(np.linalg.det(planes.axes), 1, rtol=CLOSED_FORM)
    above = points + 0.3 * normal
    assert_allclose(planes.project(above), points, atol=FLAT)


def test_normals_turn_to_the_nearest_place_that_sees_them(rng):
    points = np.column_stack([rng.uniform(-1, 1, (40, 2)), np.zeros(40)])
    for z in (3.0, -3.0):
        normals = fit_planes(points, towards=np.array([[0, 0, z]])).normals
        assert_allclose(normals[:, 2], np.sign(z), atol=FLAT)


def test_deviations_by_hand():
    """A cross of four points around 0, 2 and 1 away: variances 8/5 and 2/5 of the five."""
    points = np.array([[0.0, 0, 0], [2, 0, 0], [-2, 0, 0], [0, 1, 0], [0, -1, 0]])
    planes = fit_planes(points)
    assert_allclose(planes.deviations[0], [np.sqrt(8 / 5), np.sqrt(2 / 5), 0], atol=FLAT)
    assert_allclose(np.abs(planes.axes[0]), np.eye(3), atol=FLAT)


def test_two_points_have_no_plane():
    with pytest.raises(InputError, match="2 rows, a plane needs 3"):
        fit_planes(np.zeros((2, 3)))


def test_the_normal_is_the_shortest_axis(rng):
    gaussians = make_gaussians(rng, 5)._replace(quats=np.tile([1.0, 0, 0, 0], (5, 1)))
    order = np.array([0, 2, 1, 1, 0])
    log_scales = np.zeros((5, 3))
    log_scales[np.arange(5), order] = -3
    gaussians = gaussians._replace(log_scales=log_scales)
    assert_array_equal(thin_axes(gaussians), order)
    assert_array_equal(normals_of(gaussians), np.eye(3)[order])


class Discs(NamedTuple):
    means: Floats
    quats: Floats
    log_scales: Floats


def test_the_normal_of_two_scales_is_the_third_axis(rng):
    discs = Discs(np.zeros((2, 3)), np.array([[1.0, 0, 0, 0], [1, 1, 0, 0]]), np.zeros((2, 2)))
    assert_allclose(normals_of(discs), [[0, 0, 1], [0, -1, 0]], atol=CLOSED_FORM)


def test_the_gradient_of_the_normal(rng):
    gaussians = make_gaussians(rng, 4)
    gaussians = gaussians._replace(log_scales=rng.permuted(np.tile([0.0, -1, -2], (4, 1)), axis=1))
    check_jacobian(
        lambda quats: (normals_of(gaussians._replace(quats=quats)),),
        lambda v: (normals_of_vjp(gaussians, v),),
        [gaussians.quats],
        names=["quats"],
    )


def test_angles_ignore_the_sign():
    a = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 1]])
    b = np.array([[0.0, 0, -1], [0, 1, 0], [0, np.sin(0.5), np.cos(0.5)]])
    assert_allclose(angles_between(a, b), [0, 90, np.degrees(0.5)], atol=1e-6)
