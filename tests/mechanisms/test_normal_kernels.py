"""Kernels of normals from depths: against their NumPy statement, and against planes by hand."""

import inspect

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.mechanisms.depth_maps import normal_kernels, normals
from minisplat_ref.types import Camera
from tolerances import CLOSED_FORM, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64


def camera_of(width, height):
    return Camera(np.eye(3), np.zeros(3), 20.0, 22.0, 11.3, 8.2, width, height)


@pytest.mark.parametrize(("width", "height"), [(24, 18), (3, 3), (2, 5), (5, 1), (1, 1), (9, 3)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_normals_and_their_gradient_are_those_of_the_reference(width, height, dtype, rng):
    """Also without an inner pixel; beside a hole there are normals, and a pixel amid holes has none."""
    camera, depth = camera_of(width, height), rng.uniform(1, 3, (height, width))
    if width > 20:
        depth[4, 5] = 0
        depth[9:12, 9:12] = 0
        depth[10, 10] = 2
    v = rng.normal(size=(height, width, 3))
    found = normal_kernels.central_normals(depth.astype(dtype), camera)
    v_found = normal_kernels.central_normals_vjp(depth.astype(dtype), camera, v.astype(dtype))
    assert found.dtype == v_found.dtype == dtype and v_found.shape == depth.shape
    rel = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_IMAGE
    expected = normals.central_normals(depth, camera)
    assert_allclose(found, expected, atol=rel)
    v_expected = normals.central_normals_vjp(depth, camera, v)
    v_expected, v_found = np.clip(v_expected, -1e3, 1e3), np.clip(v_found, -1e3, 1e3)  # 1e12 where N is 0
    assert_allclose(v_found, v_expected, atol=rel * np.abs(v_expected).max(initial=0))
    if width > 20:
        assert not found[10, 10].any() and found[4, 6].any() and not found[0].any() and not found[:, -1].any()


def test_a_plane_that_recedes_by_hand():
    """z = 2 / (1 - 0.5 s) is the plane z - 0.5 x = 2, whose normal towards the camera is (0.5, 0, -1) / sqrt(1.25)."""
    camera = camera_of(7, 5)
    s = (np.arange(7) + 0.5 - camera.cx) / camera.fx
    depth = np.tile(2 / (1 - 0.5 * s), (5, 1))
    found = normal_kernels.central_normals(depth, camera)[1:-1, 1:-1]
    assert_allclose(found, np.broadcast_to(np.array([0.5, 0, -1]) / np.sqrt(1.25), found.shape), atol=10 * CLOSED_FORM)


def test_strided_maps_are_read(rng):
    depth, v = rng.uniform(1, 3, (8, 10, 2)), rng.normal(size=(8, 10, 6))
    camera = camera_of(10, 8)
    found = normal_kernels.central_normals_vjp(depth[..., 0], camera, v[..., ::2])
    again = normal_kernels.central_normals_vjp(depth[..., 0].copy(), camera, v[..., ::2].copy())
    assert_array_equal(found, again)


def test_both_statements_take_the_same_arguments():
    for name in ("central_normals", "central_normals_vjp"):
        of_kernels, of_reference = (inspect.signature(getattr(m, name)) for m in (normal_kernels, normals))
        assert of_kernels == of_reference
