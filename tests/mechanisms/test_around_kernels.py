"""Kernels of the light from around against :mod:`minisplat_ref.mechanisms.gbuffer.around`, forward and backward."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products
from minisplat_ref.mechanisms.gbuffer import around, around_kernels
from minisplat_ref.mechanisms.gbuffer.around import Coefficients, Sight, sight_of
from minisplat_ref.reference.covariance import rotation_matrices
from tolerances import PARITY_FLOAT32_GRADIENT, PARITY_FLOAT64, ROUNDED_TO_FLOAT32


def seen_surfels(rng, degree, m=70):
    """Surfels in all directions, straight, grazing and far away among them; two of every three are seen."""
    n = 3 * m // 2
    means, normals = rng.normal(size=(m, 3)), rng.normal(size=(m, 3))
    means[3] *= 1e6
    normals[4], normals[5] = -means[4], np.cross(means[5], [0.0, 0, 1])
    normals[6] = means[6]
    R = rotation_matrices(rng.normal(size=(1, 4)))[0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sight = sight_of(means, normals, (R, np.zeros(3)))
    sight.normals[4:7] = sight.normals[4:7] @ R.T  # of the camera's frame, as the centres are
    rows = np.sort(rng.permutation(n)[:m])
    coefficients = Coefficients(rng.normal(size=(n, 3)), rng.normal(size=(n, 3 * (degree + 1) ** 2 - 3)), rows)
    coefficients.dc[rows[7]], coefficients.rest[rows[7]] = 0, 0  # as at the start
    return sight, coefficients


def as_dtype(fields, dtype):
    return [field if field.dtype.kind == "i" else field.astype(dtype) for field in fields]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_kernels_are_the_reference(dtype, degree, rng):
    sight, coefficients = seen_surfels(rng, degree)
    single = Sight(*as_dtype(sight, dtype)), Coefficients(*as_dtype(coefficients, dtype))
    x, _, normals, R = as_dtype(single[0], np.float64)
    wide = Sight(x, x / np.linalg.norm(x, axis=1, keepdims=True), normals, R)
    wide = wide, Coefficients(*as_dtype(single[1], np.float64))
    expected, found = around.light_around(*wide), around_kernels.light_around(*single)
    assert found.dtype == dtype and (expected == 0).any() and (expected > 0).any()
    exact, of_gradient = PARITY_FLOAT64, PARITY_FLOAT64
    if dtype == np.float32:
        exact, of_gradient = ROUNDED_TO_FLOAT32, PARITY_FLOAT32_GRADIENT
    assert_allclose(found, expected, atol=exact * expected.max(), rtol=0)
    v_light = rng.normal(size=found.shape).astype(dtype)
    v = around.light_around_vjp(*wide, v_light.astype(np.float64))
    ours = around_kernels.light_around_vjp(*single, v_light)
    for name, array in v._asdict().items():
        scale = np.abs(array).max(initial=0)
        assert_allclose(getattr(ours, name), array, atol=of_gradient * scale, rtol=0, err_msg=name)
    assert v.dc[coefficients.rows[7]].any()  # where the sum is 0, the gradient is that of the sum
    is_hidden = ~np.isin(np.arange(len(v.dc)), coefficients.rows)
    assert_array_equal(ours.dc[is_hidden], 0)
    assert_array_equal(ours.rest[is_hidden], 0)
    assert degree == 0 or v.x.any()


@pytest.mark.parametrize("module", [around, around_kernels])
def test_the_light_from_around_has_its_gradient(module, rng):
    sight, coefficients = seen_surfels(rng, 3)

    def function(x, normals, R, dc, rest):
        d = x / np.linalg.norm(x, axis=1, keepdims=True)
        return (module.light_around(Sight(x, d, normals, R), Coefficients(dc, rest, coefficients.rows)),)

    inputs = sight.x.copy(), sight.normals, sight.R, coefficients.dc + 5, coefficients.rest
    inputs[0][3] /= 1e6
    (light,) = function(*inputs)
    assert (light > 0.01).any()
    v_light = np.where(light > 0.01, rng.normal(size=light.shape), 0)  # no step from a clamped value to another
    d = inputs[0] / np.linalg.norm(inputs[0], axis=1, keepdims=True)
    v = module.light_around_vjp(
        Sight(inputs[0], d, *inputs[1:3]), Coefficients(*inputs[3:], coefficients.rows), v_light
    )
    names = "x", "normals", "R", "dc", "rest"
    check_inner_products(function, (v.x, v.normals, v.R, v.dc, v.rest), inputs, (v_light,), rng, names=names)


def test_no_surfel_is_seen(rng):
    sight, coefficients = seen_surfels(rng, 3)
    nothing = Sight(sight.x[:0], sight.d[:0], sight.normals[:0], sight.R), coefficients._replace(rows=np.zeros(0, int))
    assert around_kernels.light_around(*nothing).shape == (0, 3)
    v = around_kernels.light_around_vjp(*nothing, np.zeros((0, 3)))
    assert not v.dc.any() and not v.rest.any() and not v.R.any()
