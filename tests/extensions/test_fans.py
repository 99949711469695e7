"""Fans: the polygon of a flat Gaussian, and the Gaussian of an edited polygon."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.mechanisms.meshes.fans import (
    N_SIDES,
    by_gram_schmidt,
    fan_faces,
    fan_vertices,
    fit_flat_gaussians,
    flatten,
    min_widths,
    opacity_radii,
    plane_axes,
    rims,
    turn_balls,
)
from scenes import make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT64


def flat_of(g):
    return flatten(g.means, g.quats, g.log_scales)


def polygons(rng, n=40, n_sides=N_SIDES):
    """Flat Gaussians of every shape, also discs and needles, with their radii and corners."""
    g = make_gaussians(rng, n)
    g.log_scales[::5, 1] = g.log_scales[::5, 0]
    g.log_scales[1::5] = g.log_scales[1::5, :1]
    g.log_scales[2::5, 2] = g.log_scales[2::5, 0] - 12
    flat, radii = flat_of(g), opacity_radii(g.opacity_logits)
    return flat, radii, rims(flat.means, flat.spans, radii, n_sides)


def planar_covariances(flat):
    return flat.spans @ np.swapaxes(flat.spans, 1, 2)


def test_a_polygon_by_hand():
    """An octagon in the plane x = 1, whose axis x is the thinnest; its corners are as far out as the opacity says."""
    flat = flatten(np.array([[1.0, 2, 3]]), np.array([[1.0, 0, 0, 0]]), np.log([[1e-3, 2.0, 0.5]]))
    radius = np.sqrt(11.3449 + 2 * np.log(0.25))
    assert_allclose(opacity_radii(np.array([np.log(1 / 3)])), [radius], rtol=CLOSED_FORM)
    phi = np.pi / 4 * np.arange(8)
    expected = np.array([1.0, 2, 3]) + radius * np.column_stack([0 * phi, 2 * np.cos(phi), 0.5 * np.sin(phi)])
    corners = rims(flat.means, flat.spans, np.array([radius]))
    assert_allclose(corners[0], expected, rtol=CLOSED_FORM, atol=CLOSED_FORM)
    assert_allclose(flat.axes[0, :, 2], [1, 0, 0], atol=CLOSED_FORM)


def test_balls_become_flat_in_all_directions(rng):
    """The mean of n n^T over directions n that spread evenly is a third of the identity; others stay."""
    g = make_gaussians(rng, 3000)
    shaped = g.log_scales[:1000].copy()
    g.log_scales[1000:] = -2.0
    g.quats[1000:] = [1.0, 0, 0, 0]
    turned = turn_balls(g, rng)
    normals = flat_of(turned).axes[1000:, :, 2]
    assert_allclose(normals.T @ normals / 2000, np.eye(3) / 3, atol=0.05)  # seven standard deviations
    assert_array_equal(turned.quats[:1000], g.quats[:1000])
    assert_array_equal(turned.log_scales[:1000], shaped)
    assert (g.quats[1000:] == [1, 0, 0, 0]).all()  # what was given is not changed


def test_alpha_is_the_same_at_every_corner(rng):
    logits = np.array([-4.0, -1, 0, 3, 20])
    alphas = 1 / (1 + np.exp(-logits)) * np.exp(-0.5 * opacity_radii(logits) ** 2)
    assert_allclose(alphas, np.exp(-11.3449 / 2), rtol=CLOSED_FORM)


def test_a_faint_gaussian_has_no_polygon():
    with np.errstate(divide="raise", over="raise", invalid="raise"):
        assert_array_equal(opacity_radii(np.array([-6.0, -1e4, -5.6])) > 0, [False, False, True])


def test_the_plane_is_that_of_the_larger_axes():
    columns = plane_axes(np.array([[0.0, 1, 2], [1.0, 0, 2], [2.0, 1, 0], [1.0, 1, 1]]))
    assert_array_equal(columns, [[1, 2, 0], [2, 0, 1], [0, 1, 2], [1, 2, 0]])


def test_faces_of_fans_cover_the_polygons(rng):
    flat, _, corners = polygons(rng, 3, 5)
    vertices, faces = fan_vertices(flat.means, corners), fan_faces(3, 5)
    assert vertices.shape == (18, 3) and faces.shape == (15, 3)
    assert_array_equal(vertices[faces[:, 0]], np.repeat(flat.means, 5, axis=0))
    p0, p1, p2 = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(p1 - p0, p2 - p0).reshape(3, 5, 3)
    assert (np.sum(normals * flat.axes[:, None, :, 2], axis=2) > 0).all()


@pytest.mark.parametrize("n_sides", [3, 4, 5, 8, 12])
@pytest.mark.parametrize("inverse", [fit_flat_gaussians, by_gram_schmidt])
def test_polygons_come_back(inverse, n_sides, rng):
    flat, radii, corners = polygons(rng, n_sides=n_sides)
    back = inverse(corners, radii)
    assert_allclose(back.means, flat.means, rtol=PARITY_FLOAT64)
    assert_allclose(rims(back.means, back.spans, radii, n_sides), corners, atol=PARITY_FLOAT64)
    assert_allclose(planar_covariances(back), planar_covariances(flat), atol=PARITY_FLOAT64)
    assert_allclose(np.swapaxes(back.axes, 1, 2) @ back.axes, np.tile(np.eye(3), (len(radii), 1, 1)), atol=CLOSED_FORM)


@pytest.mark.parametrize("n_sides", [3, 8])
def test_affine_edits_are_carried_exactly(n_sides, rng):
    """Also a shear and a mirror; the paper's way follows turns and scalings, but loses the shear."""
    flat, radii, corners = polygons(rng, n_sides=n_sides)
    for A in (rng.normal(size=(3, 3)), np.diag([1.0, -1, 1]) + np.eye(3, k=1)):
        expected = A @ planar_covariances(flat) @ A.T
        edited = corners @ A.T + [1.0, 2, 3]
        back, paper = fit_flat_gaussians(edited, radii), by_gram_schmidt(edited, radii)
        assert_allclose(back.means, flat.means @ A.T + [1.0, 2, 3], atol=PARITY_FLOAT64)
        assert_allclose(planar_covariances(back), expected, atol=PARITY_FLOAT64)
        assert_allclose(paper.means, back.means, atol=PARITY_FLOAT64)
        assert np.abs(planar_covariances(paper) - expected).max() > 0.1 * np.abs(expected).max()
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    paper = by_gram_schmidt(1.7 * corners @ Q.T, radii)
    assert_allclose(planar_covariances(paper), 1.7**2 * Q @ planar_covariances(flat) @ Q.T, atol=PARITY_FLOAT64)


def test_degenerate_polygons_have_no_width():
    line = np.linspace(0, 1, 8)[:, None] * [[1.0, 2, 3]]
    square = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])[[0, 0, 1, 1, 2, 2, 3, 3]]
    widths = min_widths(np.stack([line, np.ones((8, 3)), square]))
    assert widths[0] < CLOSED_FORM and widths[1] == 0 and widths[2] > 0.5
