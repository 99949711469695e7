"""Fields over space and time by hand, the three forms of a velocity, and Runge-Kutta's orders."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_jacobian
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.velocity.model import move_means
from minisplat_ref.mechanisms.motion.field import (
    basis,
    choose_centers,
    field,
    field_jacobians,
    field_vjp,
    power_rates,
    powers,
)
from minisplat_ref.mechanisms.motion.velocity import (
    Warp,
    canonical_velocity,
    integrate,
    invert,
    power_steps,
    velocity_of_backward,
)
from tolerances import CLOSED_FORM, GRADIENT_REL

DIFFERENCE = 1e-5  # of central differences: their error is its square, 1e-10, times third derivatives of order 1


@pytest.fixture
def warp(rng):
    """A warp that moves places by up to 0.5 and folds nothing."""
    return Warp(rng.uniform(-1, 1, size=(6, 3)), 0.9, 0.15 * rng.normal(size=(6, 3, 3)))


# --- the field ---


def test_a_field_by_hand():
    """At the distance h sqrt(2 ln 2) a function is one half; the polynomial 3 t - 4 t^2 is 0.5 at 0.5, its slope -1."""
    width = 0.7
    places = np.array([[width * np.sqrt(2 * np.log(2)), 0, 0]])
    phi = basis(places, np.zeros((1, 3)), width)
    coefficients = np.array([[[3.0], [-4.0]]])
    assert_allclose(phi, [[0.5]], rtol=CLOSED_FORM)
    assert_allclose(field(phi, coefficients, powers(0.5, 2)), [[0.25]], rtol=CLOSED_FORM)
    assert_allclose(field(phi, coefficients, power_rates(0.5, 2)), [[-0.5]], rtol=CLOSED_FORM)
    assert_array_equal(field(phi, coefficients, powers(0.0, 2)), [[0.0]])


def test_gradient_of_a_field(rng):
    places, centers, width = rng.normal(size=(5, 3)), rng.normal(size=(4, 3)), 1.2
    coefficients, tau = rng.normal(size=(4, 3, 2)), powers(0.7, 3)

    def value(x, c, log_width, a):
        return (field(basis(x, c, np.exp(log_width[0])), a, tau),)

    def vjp(v):
        g = field_vjp(places, centers, width, basis(places, centers, width), coefficients, tau, v)
        return g.places, g.centers, np.array([g.log_width]), g.coefficients

    inputs = [places, centers, np.log([width]), coefficients]
    check_jacobian(value, vjp, inputs, names=["places", "centers", "log_width", "coefficients"])


def test_jacobians_of_a_field(rng, warp):
    places, tau = rng.normal(size=(5, 3)), powers(0.7, 3)
    found = field_jacobians(places, warp.centers, 0.9, basis(places, warp.centers, 0.9), warp.shifts, tau)
    for j, step in enumerate(DIFFERENCE * np.eye(3)):
        ahead, behind = (field(basis(places + s, warp.centers, 0.9), warp.shifts, tau) for s in (step, -step))
        assert_allclose(found[..., j], (ahead - behind) / (2 * DIFFERENCE), atol=1e-8)
    assert_array_equal(warp.jacobians(places, 0.7), np.eye(3) + found)


def test_degree_1_is_linear_motion(rng):
    """The extension velocity is this case, with the velocities of the field: the same numbers, bit for bit."""
    warp = Warp(rng.normal(size=(4, 3)), 1.0, rng.normal(size=(4, 1, 3)))
    places = rng.normal(size=(7, 3))
    velocities = warp.rate(places, 0.0)
    assert_array_equal(warp.rate(places, 0.9), velocities)
    assert_array_equal(warp.at(places, 0.5), move_means(places, velocities, 0.5))  # a half is exact


def test_centers_are_spread_and_leave_out_what_is_far(rng):
    points = np.concatenate([rng.uniform(-1, 1, size=(200, 3)), [[50.0, 0, 0]]])
    centers, width = choose_centers(points, 20, np.random.default_rng(3))
    distances = np.linalg.norm(centers[:, None] - centers, axis=2) + 9 * np.eye(20)
    assert np.abs(centers).max() <= 1 and distances.min() > 0.4
    assert width == pytest.approx(2 * distances.min(axis=1).mean())
    assert_array_equal(centers, choose_centers(points, 20, np.random.default_rng(3))[0])


def test_few_points_have_few_centers(rng):
    centers, width = choose_centers(np.array([[1.0, 2, 3]] * 4), 8, rng)
    assert_array_equal(centers, [[1.0, 2, 3]])
    assert width == 1.0
    assert len(choose_centers(rng.normal(size=(3, 3)), 8, rng)[0]) <= 3


# --- velocities ---


def test_three_forms_of_a_body_that_turns_and_grows(rng):
    """W(y, t) = s R y with s = 1 + t / 2 and R about z by 0.8 t has all derivatives in closed form."""
    t, y = 0.6, rng.normal(size=(5, 3))
    spin = np.array([[0, -0.8, 0], [0.8, 0, 0], [0, 0, 0]])
    R = np.array([[np.cos(0.8 * t), -np.sin(0.8 * t), 0], [np.sin(0.8 * t), np.cos(0.8 * t), 0], [0, 0, 1]])
    s, s_rate = 1 + t / 2, 0.5
    x = s * y @ R.T
    v = x @ (spin + s_rate / s * np.eye(3)).T  # (i)
    u = canonical_velocity(np.broadcast_to(s * R, (5, 3, 3)), v)
    assert_allclose(u, y @ (spin + s_rate / s * np.eye(3)).T, atol=CLOSED_FORM * 10)
    # w = R^T x / s: dw/dt = R^T (spin^T / s - s' / s^2) x
    w_rate = x @ (R.T @ (spin.T / s - s_rate / s**2 * np.eye(3))).T
    assert_allclose(velocity_of_backward(np.broadcast_to(R.T / s, (5, 3, 3)), w_rate), v, atol=CLOSED_FORM * 10)
    assert np.abs(u - v).max() > 0.1  # (ii) is not a velocity in the world


def test_three_forms_of_a_field(rng, warp):
    t, h, y = 0.6, DIFFERENCE, rng.uniform(-1, 1, size=(5, 3))
    x, v = warp.at(y, t), warp.rate(y, t)
    assert_allclose(invert(warp, x, t), y, atol=1e-12)
    J_w = np.stack([(invert(warp, x + e, t) - invert(warp, x - e, t)) / (2 * h) for e in h * np.eye(3)], axis=2)
    w_rate = (invert(warp, x, t + h) - invert(warp, x, t - h)) / (2 * h)
    assert_allclose(velocity_of_backward(J_w, w_rate), v, atol=1e-8)
    J = warp.jacobians(y, t)
    assert_allclose(np.einsum("nij,nj->ni", J, canonical_velocity(J, v)), v, atol=1e-12)
    assert np.abs(v).max() > 0.1


def test_a_canonical_step_does_what_time_does(rng, warp):
    """W(y + u dt, t) and W(y, t + dt) differ by a term of second order."""
    y = rng.uniform(-1, 1, size=(5, 3))
    u = canonical_velocity(warp.jacobians(y, 0.4), warp.rate(y, 0.4))
    errors = [np.abs(warp.at(y + u * dt, 0.4) - warp.at(y, 0.4 + dt)).max() for dt in (1e-2, 1e-3)]
    assert errors[0] / errors[1] == pytest.approx(100, rel=0.1)


def test_a_warp_that_folds_has_no_inverse():
    warp = Warp(np.zeros((1, 3)), 1.0, np.array([[[20.0, 0, 0]]]))
    with pytest.raises(InputError, match="folds space"):
        invert(warp, np.linspace(-1, 1, 9)[:, None] * [1, 0, 0], 1.0)


# --- integration ---


def test_a_step_of_runge_kutta_by_hand():
    """Of x' = x, a step of 0.4 multiplies by the exponential's first five terms."""
    x = integrate(lambda x, t: x, np.ones((1, 3)), 0.0, 0.4, 1)
    assert_allclose(x, 1 + 0.4 + 0.4**2 / 2 + 0.4**3 / 6 + 0.4**4 / 24, rtol=CLOSED_FORM)


def test_scene_flow_is_of_fourth_order(rng, warp):
    """The velocity at places of the world leads along the warp; half the step has a sixteenth of the error."""
    y = rng.uniform(-1, 1, size=(5, 3))
    errors = []
    for n in (2, 4):
        path = integrate(lambda x, t: warp.rate(invert(warp, x, t), t), warp.at(y, 0.2), 0.2, 0.8, n)
        errors.append(np.abs(path - warp.at(y, 1.0)).max())
    assert 10 < errors[0] / errors[1] < 24 and errors[1] < 1e-4


@pytest.mark.parametrize("degree", [1, 4])
def test_a_step_of_the_powers_is_exact_to_the_fourth(degree):
    expected = powers(0.9, degree) - powers(0.3, degree)
    assert_allclose(power_steps(0.3, 0.6, degree), expected, rtol=CLOSED_FORM)
    fifth = power_steps(0.3, 0.6, 5)[4]
    assert abs(fifth - (0.9**5 - 0.3**5)) > GRADIENT_REL
