import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products, check_jacobian
from minisplat_ref.constants import SH_C0, SH_C1, SH_C2, SH_C3
from minisplat_ref.reference.spherical_harmonics import sh_basis, sh_basis_jacobian
from minisplat_ref.rendering.backends import REFERENCE
from scenes import make_camera, make_gaussians
from tolerances import (
    CLOSED_FORM,
    GRADIENT_FLOOR,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
    SH_CONSTANTS,
)

NAMES = ["means", "sh_dc", "sh_rest", "R", "t"]
VISIBLE = np.array([[1, 1]], dtype=np.int32)

# --- closed form ---


def sphere_quadrature():
    """Directions and weights that integrate polynomials of degree 7 over the sphere exactly."""
    z, z_weights = np.polynomial.legendre.leggauss(8)
    azimuths = np.arange(16) * 2 * np.pi / 16
    ring = np.sqrt(1 - z**2)
    directions = np.stack(
        [np.outer(ring, np.cos(azimuths)), np.outer(ring, np.sin(azimuths)), np.outer(z, np.ones(16))], axis=-1
    )
    return directions.reshape(-1, 3), np.repeat(z_weights, 16) * 2 * np.pi / 16


def test_basis_is_orthonormal_over_the_sphere():
    directions, weights = sphere_quadrature()
    basis = sh_basis(directions, 3)
    assert_allclose(basis.T @ (weights[:, None] * basis), np.eye(16), atol=SH_CONSTANTS)


def test_basis_spans_each_degree(rng):
    # Addition theorem: the squares of the 2l + 1 functions of a degree sum to (2l + 1) / (4 pi) everywhere.
    directions = rng.normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    squares = sh_basis(directions, 3) ** 2
    for degree in range(4):
        total = squares[:, degree**2 : (degree + 1) ** 2].sum(axis=1)
        assert_allclose(total, (2 * degree + 1) / (4 * np.pi), rtol=SH_CONSTANTS)


def test_order_and_signs_by_hand():
    h = np.sqrt(0.5)
    x, y, z, xy, yz, xz = np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], [h, h, 0], [0, h, h], [h, 0, h]
    expected = {  # coefficient: (direction, value)
        0: (x, SH_C0), 1: (y, -SH_C1), 2: (z, SH_C1), 3: (x, -SH_C1),
        4: (xy, SH_C2[0] / 2), 5: (yz, -SH_C2[0] / 2), 6: (z, 2 * SH_C2[1]), 7: (xz, -SH_C2[0] / 2), 8: (x, SH_C2[2]),
        9: (y, SH_C3[0]), 11: (yz, -3 * h / 2 * SH_C3[2]), 12: (z, 2 * SH_C3[3]), 13: (xz, -3 * h / 2 * SH_C3[2]),
        14: (xz, h / 2 * SH_C3[4]), 15: (x, -SH_C3[0]),
    }  # fmt: skip
    for k, (direction, value) in expected.items():
        assert_allclose(sh_basis(np.array([direction]), 3)[0, k], value, rtol=CLOSED_FORM)
    diagonal = np.full((1, 3), np.sqrt(1 / 3))
    assert_allclose(sh_basis(diagonal, 3)[0, 10], SH_C3[1] / np.sqrt(27), rtol=CLOSED_FORM)


def test_color_by_hand(backend):
    # Camera centre (0, 0, -1), mean (0, 3, 3): direction (0, 0.6, 0.8).
    camera = make_camera()._replace(cam_from_world_t=np.array([0.0, 0, 1]))
    sh_dc, sh_rest = np.array([[1.0, -2, 0]]), np.zeros((1, 3, 3))
    sh_rest[0, 0, 0], sh_rest[0, 1, 2] = 0.5, 0.25
    colors = backend.sh_colors(np.array([[0.0, 3, 3]]), sh_dc, sh_rest, camera, 1, VISIBLE)
    expected = [0.5 + SH_C0 - 0.5 * SH_C1 * 0.6, 0, 0.5 + 0.25 * SH_C1 * 0.8]  # green would be 0.5 - 0.56: clamped
    assert_allclose(colors, [expected], rtol=CLOSED_FORM)


def test_camera_centre_uses_the_rotation(backend, rng):
    camera = make_camera(rng=rng)
    centre = -camera.cam_from_world_R.T @ camera.cam_from_world_t
    sh_rest = np.zeros((1, 3, 3))
    sh_rest[0, 1] = 1
    colors = backend.sh_colors(centre[None] + [[0, 0, 5.0]], np.zeros((1, 3)), sh_rest, camera, 1, VISIBLE)
    assert_allclose(colors, 0.5 + SH_C1, rtol=CLOSED_FORM)


def test_higher_degrees_wait_until_they_are_active(backend, rng):
    gaussians, camera = make_gaussians(rng, 5), make_camera()
    radii = np.ones((5, 2), dtype=np.int32)
    for degree in range(4):
        k = (degree + 1) ** 2 - 1
        cut = backend.sh_colors(
            gaussians.means, gaussians.sh_dc, np.ascontiguousarray(gaussians.sh_rest[:, :k]), camera, degree, radii
        )
        full = backend.sh_colors(gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera, degree, radii)
        assert_array_equal(cut, full)


def coefficients_of(gaussians, degrees):
    """The coefficients without those above each Gaussian's degree."""
    is_present = np.arange(gaussians.sh_rest.shape[1]) < ((degrees.astype(int) + 1) ** 2 - 1)[:, None]
    return np.where(is_present[:, :, None], gaussians.sh_rest, 0), is_present


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_absent_bands_are_bands_of_zeros(backend, dtype, rng):
    """Colours, and their gradients with respect to all that is there, are the same to the last bit."""
    gaussians = make_gaussians(rng, 300)
    gaussians = gaussians._make(field.astype(dtype) for field in gaussians)
    camera, v = make_camera(rng=rng), rng.normal(size=(300, 3)).astype(dtype)
    radii = rng.integers(0, 2, size=300)[:, None].repeat(2, axis=1).astype(np.int32)
    degrees = rng.integers(0, 4, size=300).astype(np.uint8)
    present, is_present = coefficients_of(gaussians, degrees)
    gaussians.sh_rest[~is_present] = np.nan  # nobody looks
    own = (gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera, degrees, radii)
    full = (gaussians.means, gaussians.sh_dc, present, camera, 3, radii)
    colors, expected = backend.sh_colors(*own), backend.sh_colors(*full)
    assert_array_equal(colors, expected)
    assert (colors > 0).any()
    gradient, expected = backend.sh_colors_vjp(*own, v), backend.sh_colors_vjp(*full, v)
    assert_array_equal(gradient.means, expected.means)
    assert_array_equal(gradient.sh_dc, expected.sh_dc)
    assert_array_equal(gradient.sh_rest, np.where(is_present[:, :, None], expected.sh_rest, 0))
    assert (expected.sh_rest[~is_present] != 0).any()
    tolerance = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_GRADIENT  # sums in another order
    for name in ("cam_from_world_R", "cam_from_world_t"):
        e = getattr(expected, name)
        assert_allclose(getattr(gradient, name), e, rtol=0, atol=tolerance * np.abs(e).max())


def test_equal_degrees_are_one_degree(backend, rng):
    gaussians, camera, radii = make_gaussians(rng, 40), make_camera(rng=rng), np.ones((40, 2), np.int32)
    arrays, v = (gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera), rng.normal(size=(40, 3))
    each = np.full(40, 2, np.uint8)
    assert_array_equal(backend.sh_colors(*arrays, each, radii), backend.sh_colors(*arrays, 2, radii))
    both = (backend.sh_colors_vjp(*arrays, degree, radii, v) for degree in (each, 2))
    for own, one in zip(*both, strict=True):
        assert_array_equal(own, one)


def test_culled_gaussians_are_black(backend, rng):
    gaussians, camera = make_gaussians(rng, 4), make_camera()
    gaussians.means[1] = np.nan
    radii = np.array([[1, 1], [0, 0], [3, 2], [0, 0]], dtype=np.int32)
    arguments = (gaussians.means, gaussians.sh_dc + 2, gaussians.sh_rest, camera, 3, radii)
    colors = backend.sh_colors(*arguments)
    assert colors[[0, 2]].any(axis=1).all() and not colors[[1, 3]].any()
    gradient = backend.sh_colors_vjp(*arguments, np.ones((4, 3)))
    for field in gradient[:3]:
        assert field[[0, 2]].any() and not field[[1, 3]].any()
    assert all(np.isfinite(field).all() for field in gradient)


# --- gradient ---


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_basis_jacobian(rng, degree):
    directions = rng.normal(size=(3, 3))
    check_jacobian(
        lambda d: (sh_basis(d, degree),),
        lambda v: (np.einsum("nk,nki->ni", v, sh_basis_jacobian(directions, degree)),),
        (directions,),
        names=["directions"],
    )


def functions_of_arrays(backend, camera, degree, inputs):
    """`sh_colors` and `sh_colors_vjp` over the arrays that have a gradient, pose included."""
    radii = np.ones((len(inputs[0]), 2), dtype=np.int32)

    def function(means, sh_dc, sh_rest, R, t):
        view = camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        return (backend.sh_colors(means, sh_dc, sh_rest, view, degree, radii),)

    def vjp(v_colors):
        return backend.sh_colors_vjp(*inputs[:3], camera, degree, radii, v_colors)

    colors = function(*inputs)[0]
    assert (colors == 0).any() and (colors > 0).any()  # both sides of the clamp
    return function, vjp


def inputs_of(rng, n, camera):
    gaussians = make_gaussians(rng, n)
    pose = camera.cam_from_world_R, camera.cam_from_world_t
    return gaussians.means, 3 * gaussians.sh_dc, gaussians.sh_rest, *pose


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_color_jacobian(rng, degree):
    camera = make_camera(rng=rng)
    inputs = inputs_of(rng, 4, camera)
    check_jacobian(*functions_of_arrays(REFERENCE, camera, degree, inputs), inputs, names=NAMES)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_color_gradient_of_many(backend, rng, degree):
    camera = make_camera(rng=rng)
    inputs = inputs_of(rng, 50, camera)
    function, vjp = functions_of_arrays(backend, camera, degree, inputs)
    cotangents = (rng.normal(size=(50, 3)),)
    check_inner_products(function, vjp(*cotangents), inputs, cotangents, rng, names=NAMES)


def test_constant_color_has_no_gradient_but_its_own(backend, rng):
    camera = make_camera(rng=rng)
    inputs = inputs_of(rng, 50, camera)
    function, vjp = functions_of_arrays(backend, camera, 0, inputs)
    v_colors = rng.normal(size=(50, 3))
    gradient = vjp(v_colors)
    assert_allclose(gradient.sh_dc, np.where(function(*inputs)[0] > 0, SH_C0 * v_colors, 0), rtol=CLOSED_FORM)
    assert not any(gradient[k].any() for k in (0, 2, 3, 4))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_colour_of_exactly_zero_has_no_gradient(backend, dtype):
    """The clamp's derivative at zero is that of the clamped side.

    A coefficient so near to zero hits any number near 0.5: here C1, from which the basis function along z takes C1.
    """
    camera, means = make_camera(), np.array([[0.0, 0, 4]], dtype)
    c0, c1 = dtype(SH_C0), dtype(SH_C1)
    sh_dc, sh_rest = np.full((1, 3), (c1 - dtype(0.5)) / c0, dtype), np.zeros((1, 3, 3), dtype)
    sh_rest[0, 1] = -1
    inputs = means, sh_dc, sh_rest
    above = backend.sh_colors(means, sh_dc + dtype(1e-3), sh_rest, camera, 1, VISIBLE)
    assert_allclose(above, 1e-3 * SH_C0, rtol=1e-3)  # float32: a difference of two numbers near 0.5
    assert_array_equal(backend.sh_colors(*inputs, camera, 1, VISIBLE), 0)
    assert not any(v.any() for v in backend.sh_colors_vjp(*inputs, camera, 1, VISIBLE, np.ones((1, 3), dtype)))


# --- parity ---


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, "each"])
def test_backends_agree(fast_backend, degree, dtype, rng):
    gaussians, camera = make_gaussians(rng, 100), make_camera(rng=rng)
    radii = rng.integers(0, 2, size=100)[:, None].repeat(2, axis=1).astype(np.int32)
    v = rng.normal(size=(100, 3))
    degree = rng.integers(0, 4, size=100).astype(np.uint8) if degree == "each" else degree
    arrays = (gaussians.means, gaussians.sh_dc, gaussians.sh_rest)
    expected = REFERENCE.sh_colors(*arrays, camera, degree, radii)
    v_expected = REFERENCE.sh_colors_vjp(*arrays, camera, degree, radii, v)
    cast = tuple(array.astype(dtype) for array in arrays)
    actual = fast_backend.sh_colors(*cast, camera, degree, radii)
    v_actual = fast_backend.sh_colors_vjp(*cast, camera, degree, radii, v.astype(dtype))
    assert actual.dtype == dtype and expected.max() > GRADIENT_FLOOR
    assert_allclose(actual, expected, rtol=0, atol=PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_IMAGE)
    tolerance = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_GRADIENT
    for a, e in zip(v_actual, v_expected, strict=True):
        assert a.dtype == dtype
        assert_allclose(a, e, rtol=0, atol=tolerance * max(np.abs(e).max(), GRADIENT_FLOOR))
