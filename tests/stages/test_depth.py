import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products, check_jacobian
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.reference.depth import expected_depth, expected_depth_vjp, surface_points, surface_points_vjp
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import REFERENCE
from scenes import activated, make_camera, make_gaussians
from tolerances import CLOSED_FORM, COVERAGE_MIN, GRADIENT_FLOOR, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

IDENTITY = np.array([[1.0, 0, 0, 0]])


def rays(camera):
    """Camera centre and directions [H, W, 3] of camera depth 1, by hand."""
    ys, xs = np.mgrid[: camera.height, : camera.width]
    slopes = np.stack(
        [(xs + 0.5 - camera.cx) / camera.fx, (ys + 0.5 - camera.cy) / camera.fy, np.ones_like(xs)], axis=-1
    )
    return -camera.cam_from_world_R.T @ camera.cam_from_world_t, slopes @ camera.cam_from_world_R


# --- closed form ---


def test_ball_is_met_at_the_foot_of_its_perpendicular(backend):
    camera = make_camera(4, 2, fx=2.0, fy=2.0)
    mean = np.array([[0.5, -0.3, 4.0]])
    result = backend.surface_points(mean, IDENTITY, np.full((1, 3), 0.2), camera, np.zeros((2, 4), dtype=np.int32))
    direction = np.array([0.75, -0.25, 1.0])  # pixel (3, 0): (3.5 - 2) / 2, (0.5 - 1) / 2
    depth = (mean[0] @ direction) / (direction @ direction)
    assert_allclose(result.depths[0, 3], depth, rtol=CLOSED_FORM)
    assert_allclose(result.points[0, 3], depth * direction, rtol=CLOSED_FORM)


def test_disc_is_met_on_its_plane(backend, rng):
    # A Gaussian flat in z, seen by a turned camera: every ray meets it where world z is that of its mean.
    camera = make_camera(6, 5, rng=rng)
    scales = np.array([[1.0, 1, 1e-7]])
    ids = np.zeros((5, 6), dtype=np.int32)
    result = backend.surface_points(np.array([[0.1, 0.2, 3.0]]), IDENTITY, scales, camera, ids)
    assert_allclose(result.points[:, :, 2], 3, rtol=1e2 * CLOSED_FORM)
    origin, directions = rays(camera)
    assert_allclose(result.depths, (3 - origin[2]) / directions[:, :, 2], rtol=1e2 * CLOSED_FORM)


def test_depth_is_camera_z(backend, rng):
    camera, (means, quats, scales, _) = make_camera(6, 5, cx=2.0, rng=rng), activated(make_gaussians(rng, 30))
    ids = np.arange(30, dtype=np.int32).reshape(5, 6)
    result = backend.surface_points(means, quats, scales, camera, ids)
    points_cam = result.points @ camera.cam_from_world_R.T + camera.cam_from_world_t
    assert_allclose(result.depths, points_cam[:, :, 2], rtol=1e2 * CLOSED_FORM)
    assert_allclose(camera.fx * points_cam[:, :, 0] / result.depths + camera.cx, np.tile(np.arange(6) + 0.5, (5, 1)))


def test_point_is_the_densest_of_its_ray(backend, rng):
    camera, (means, quats, scales, _) = make_camera(6, 5, rng=rng), activated(make_gaussians(rng, 30))
    ids = np.arange(30, dtype=np.int32).reshape(5, 6)
    result = backend.surface_points(means, quats, scales, camera, ids)
    precisions = np.linalg.inv(covariances(quats, scales)).reshape(5, 6, 3, 3)
    origin, directions = rays(camera)

    def mahalanobis(depths):
        offsets = origin + depths[:, :, None] * directions - means.reshape(5, 6, 3)
        return np.einsum("hwi,hwij,hwj->hw", offsets, precisions, offsets)

    here = mahalanobis(result.depths)
    assert (here < mahalanobis(result.depths * 1.001)).all() and (here < mahalanobis(result.depths * 0.999)).all()


def test_no_gaussian_and_behind_give_zeros(backend):
    means = np.array([[0.0, 0, 2], [0, 0, -2]])
    ids = np.array([[0, -1], [1, 0]], dtype=np.int32)
    camera = make_camera(2, 2)
    result = backend.surface_points(means, np.repeat(IDENTITY, 2, axis=0), np.full((2, 3), 0.1), camera, ids)
    assert_array_equal(result.depths > 0, ids == 0)
    assert_array_equal(result.points.any(axis=2), ids == 0)


def test_no_gaussians_at_all(backend):
    empty = (np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)))
    result = backend.surface_points(*empty, make_camera(3, 2), np.full((2, 3), -1, dtype=np.int32))
    assert result.points.shape == (2, 3, 3) and not result.points.any() and not result.depths.any()


def test_dominant_gaussians_of_a_render(backend, rng):
    gaussians, camera = make_gaussians(rng, 40, size=0.25, opacity_logit=2), make_camera(rng=rng)
    output, _ = render(gaussians, camera, backend=backend, with_stats=True)
    means, quats, scales, _ = activated(gaussians)
    result = backend.surface_points(means, quats, scales, camera, output.stats.dominant_ids)
    assert (result.depths > 0).mean() > COVERAGE_MIN
    assert_array_equal(result.depths > 0, output.alpha > 0)
    assert 1.5 < result.depths[result.depths > 0].min() and result.depths.max() < 5


def test_expected_depth_by_hand():
    alpha = np.array([[0.5, 1.0, 0.0]])
    assert_array_equal(expected_depth(np.array([[1.0, 3.0, 0.0]]), alpha), [[2, 3, 0]])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_expected_depth_of_an_empty_pixel_is_0_and_has_no_gradient(dtype):
    accumulated, alpha = np.array([[0, 2e-12, 3]], dtype), np.array([[0, 1e-12, 0.5]], dtype)
    v_depth = np.ones((1, 3), dtype)
    depth, v = expected_depth(accumulated, alpha), expected_depth_vjp(accumulated, alpha, v_depth)
    assert_array_equal(depth, np.array([[0, 0, 6]], dtype), strict=True)
    assert_array_equal(v[0], np.array([[0, 0, 2]], dtype), strict=True)
    assert_array_equal(v[1], np.array([[0, 0, -12]], dtype), strict=True)


# --- gradient ---


def test_expected_depth_jacobian(rng):
    alpha, accumulated = rng.uniform(0.1, 1, size=(3, 4)), rng.uniform(1, 2, size=(3, 4))
    check_jacobian(
        lambda *x: (expected_depth(*x),),
        lambda v: expected_depth_vjp(accumulated, alpha, v),
        (accumulated, alpha),
        names=["accumulated_depth", "alpha"],
    )


def test_surface_point_gradients(rng):
    camera, (means, quats, scales, _) = make_camera(4, 3, rng=rng), activated(make_gaussians(rng, 3))
    ids = np.array([[0, 0, 1, -1], [0, 1, 1, 2], [2, 2, -1, 1]])

    def function(means, quats, scales):
        return tuple(surface_points(means, quats, scales, camera, ids))

    def vjp(*cotangents):
        return surface_points_vjp(means, quats, scales, camera, ids, *cotangents)

    inputs = (means, quats, scales)
    check_jacobian(function, vjp, inputs, names=["means", "quats", "scales"])
    cotangents = tuple(rng.normal(size=output.shape) for output in function(*inputs))
    check_inner_products(function, vjp(*cotangents), inputs, cotangents, rng, names=["means", "quats", "scales"])


def test_points_do_not_depend_on_the_size(rng):
    # t is the same at any number of sigmas, so the gradient with respect to the scales has no component along them.
    camera, (means, quats, scales, _) = make_camera(4, 3), activated(make_gaussians(rng, 12))
    ids = np.arange(12).reshape(3, 4)
    v = rng.normal(size=(3, 4, 3)), rng.normal(size=(3, 4))
    _, _, v_scales = surface_points_vjp(means, quats, scales, camera, ids, *v)
    assert np.abs(v_scales).max() > GRADIENT_FLOOR
    assert_allclose(np.sum(v_scales * scales, axis=1), 0, atol=1e2 * CLOSED_FORM)


def test_behind_has_no_gradient(rng):
    arguments = (
        np.array([[0.0, 0, -2]]),
        IDENTITY,
        np.array([[0.1, 0.2, 0.3]]),
        make_camera(2, 2),
        np.zeros((2, 2), int),
    )
    for gradient in surface_points_vjp(*arguments, np.ones((2, 2, 3)), np.ones((2, 2))):
        assert not gradient.any()


# --- parity ---


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_backends_agree(fast_backend, dtype, rng):
    camera, (means, quats, scales, _) = make_camera(24, 18, rng=rng), activated(make_gaussians(rng, 50))
    ids = rng.integers(-1, 50, size=(18, 24)).astype(np.int32)
    expected = REFERENCE.surface_points(means, quats, scales, camera, ids)
    actual = fast_backend.surface_points(means.astype(dtype), quats.astype(dtype), scales.astype(dtype), camera, ids)
    tolerance = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_IMAGE
    for a, e in zip(actual, expected, strict=True):
        assert a.dtype == dtype
        assert_allclose(a, e, rtol=0, atol=tolerance * np.abs(e).max())
