import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from gradcheck import check_jacobian
from minisplat_ref.reference.covariance import (
    covariances,
    covariances_vjp,
    rotation_matrices,
    rotation_matrices_vjp,
)
from tolerances import CLOSED_FORM

# --- closed form ---


@pytest.mark.parametrize(
    ("quat", "rotation"),
    [
        ([1, 0, 0, 0], np.eye(3)),
        ([1, 0, 0, 1], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),  # 90 degrees about z, not normalised
        ([1, 1, 0, 0], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),  # 90 degrees about x
        ([0, 0, 3, 0], np.diag([-1, 1, -1])),  # 180 degrees about y
        ([0, 0, 0, 0], np.eye(3)),  # no direction at all
    ],
)
def test_rotation_by_hand(quat, rotation):
    assert_allclose(rotation_matrices(np.array([quat], dtype=float))[0], rotation, atol=CLOSED_FORM)


def test_rotations_are_scipys(rng):
    quats = rng.normal(size=(50, 4))
    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()  # scipy's order is xyzw
    assert_allclose(rotation_matrices(quats), expected, atol=CLOSED_FORM)
    assert_allclose(rotation_matrices(-7 * quats), expected, atol=CLOSED_FORM)


def test_covariance_by_hand():
    quats = np.array([[1.0, 0, 0, 0], [1, 0, 0, 1]])
    scales = np.array([[1.0, 2, 3], [1, 2, 3]])
    expected = [np.diag([1, 4, 9]), np.diag([4, 1, 9])]  # turned by 90 degrees about z, the x and y axes change places
    assert_allclose(covariances(quats, scales), expected, atol=CLOSED_FORM)


def test_covariance_eigenvalues_are_squared_scales(rng):
    scales = np.sort(rng.uniform(0.1, 2, size=(20, 3)), axis=1)
    eigenvalues = np.linalg.eigvalsh(covariances(rng.normal(size=(20, 4)), scales))
    assert_allclose(eigenvalues, scales**2, rtol=CLOSED_FORM, atol=CLOSED_FORM)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_dtype_is_kept(dtype):
    quats, scales, v = np.ones((2, 4), dtype), np.ones((2, 3), dtype), np.ones((2, 3, 3), dtype)
    results = [rotation_matrices(quats), covariances(quats, scales), *covariances_vjp(quats, scales, v)]
    assert [result.dtype for result in results] == [dtype] * 4


LENGTHS = {
    np.float32: (1e-30, 1e-21, 1e19, 1e37),
    np.float64: (1e-200, 1e-160, 1e155, 1e300),
}  # squares leave the range


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_quaternions_have_any_length(dtype, rng):
    quats, v = rng.normal(size=(20, 4)).astype(dtype), rng.normal(size=(20, 3, 3)).astype(dtype)
    rotations, v_quats = rotation_matrices(quats), rotation_matrices_vjp(quats, v)
    tolerance = 50 * np.finfo(dtype).eps  # a few roundings of entries up to 10
    for length in LENGTHS[dtype]:
        scaled = quats * dtype(length)
        assert_allclose(rotation_matrices(scaled), rotations, rtol=0, atol=tolerance)
        by_length = rotation_matrices_vjp(scaled, v) * dtype(length)  # the gradient is that much smaller, or larger
        assert_allclose(by_length, v_quats, rtol=0, atol=tolerance * np.abs(v_quats).max())


# --- gradient ---


def test_rotation_gradient(rng):
    quats = rng.normal(size=(3, 4))
    check_jacobian(
        lambda q: (rotation_matrices(q),), lambda v: (rotation_matrices_vjp(quats, v),), (quats,), names=["quats"]
    )


def test_covariance_gradient(rng):
    quats, scales = rng.normal(size=(2, 4)), rng.uniform(0.3, 2, size=(2, 3))
    check_jacobian(
        lambda q, s: (covariances(q, s),),
        lambda v: covariances_vjp(quats, scales, v),
        (quats, scales),
        names=["quats", "scales"],
    )


def test_quaternion_gradient_is_orthogonal_to_the_quaternion(rng):
    quats = 5 * rng.normal(size=(20, 4))
    v_quats = rotation_matrices_vjp(quats, rng.normal(size=(20, 3, 3)))
    assert np.linalg.norm(v_quats) > 0.1
    assert_allclose(np.sum(quats * v_quats, axis=1), 0, atol=CLOSED_FORM)


def test_zero_quaternion_has_no_gradient(rng):
    v_quats = rotation_matrices_vjp(np.zeros((1, 4)), rng.normal(size=(1, 3, 3)))
    assert_allclose(v_quats, 0, atol=0)
