"""MP-GS: hulls against closed forms and the paper's tangents, gradients, kinds."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from actions import act, scene_of, state_of
from gradcheck import check_jacobian
from minisplat_ref import load_ply
from minisplat_ref.app.cli import main
from minisplat_ref.bench.extension_times import extension_cases
from minisplat_ref.bench.workloads import synth5k
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.cpu.compositing.hits import composite_hits as composite_by_kernels
from minisplat_ref.cpu.compositing.plain_conic import composite as composite_conics
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.extension import find_recipe, load_extension
from minisplat_ref.extensions.mixed.kernels import make_response
from minisplat_ref.extensions.mixed.model import MIXED_GAUSSIANS, promote, simplify_hulls
from minisplat_ref.extensions.mixed.population import (
    MixedGaussians,
    convert_to_lab,
    counts,
    coverage,
    group_gaussians,
    groups,
    make_ellipses,
    promote_kinds,
    simplify_kinds,
    whiten_vertices,
)
from minisplat_ref.extensions.mixed.projection import Hulls, footprints_vjp, place_vertices, project_hulls
from minisplat_ref.extensions.mixed.response import INSIDE, RESPONSE, HullFootprints, nearest
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.reference.hits import CONIC
from minisplat_ref.reference.tiling import bin_gaussians
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Model, Primitives, Projection, TileGrid, view_from
from payloads import drawn
from scenes import as_dtype, balls, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import CLOSED_FORM, HULL_COVERAGE, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64, TANGENT_LEVEL

Q = np.array([[[0.31, 0.12], [0.12, 0.2]]])  # px^-2
WHITENER = np.linalg.cholesky(Q[0]).T  # |W d|^2 = d^T Q d
TRIANGLE = np.array([[[2.0, 1.0], [14.0, 4.0], [6.0, 12.0]]])  # px
RENDERER = MIXED_GAUSSIANS.renderer


def footprints(vertices, n_vertices, opacity=0.9, conics=Q[:, [0, 0, 1], [0, 1, 1]]):
    """One hull with vertices [1, 3, 2] px, in a large image."""
    centres, n = vertices.mean(axis=1), len(vertices)
    box = np.tile([0, 0, 64, 64], (n, 1))
    projection = Projection(centres, np.ones(n), conics, np.full(n, opacity), np.full((n, 2), 9), box)
    return HullFootprints(projection, vertices - centres[:, None], np.full(n, n_vertices))


def of_first(n_vertices):
    """The triangle's first vertices; the first once more for the others."""
    return TRIANGLE[:, np.where(np.arange(3) < n_vertices, np.arange(3), 0)]


def alphas(vertices, n_vertices, centers, **named):
    return RESPONSE.hit(footprints(vertices, n_vertices, **named), np.zeros(1, int), centers).unclamped[0]


# --- the response ---


def test_a_line_is_a_capsule(rng):
    """Beside the segment alpha is a Gaussian of the distance to it, beyond its ends of that to the end."""
    unit, line = np.array([[1.0, 0.0, 1.0]]), np.array([[[10.0, 10.0], [20.0, 10.0], [10.0, 10.0]]])
    centers = np.array([[15.0, 10.0], [15.0, 11.5], [19.9, 8.0], [23.0, 14.0], [9.0, 9.0]])
    distances = np.array([0.0, 1.5, 2.0, 5.0, np.sqrt(2)])
    found = alphas(line, 2, centers, conics=unit)
    assert_allclose(found, 0.9 * np.exp(-(distances**2) / 2), rtol=CLOSED_FORM)


def test_inside_a_triangle_alpha_is_the_opacity():
    weights = np.array([[1, 1, 1], [6, 1, 1], [1, 8, 1], [0.98, 0.01, 0.01]])
    centers = weights / weights.sum(axis=1, keepdims=True) @ TRIANGLE[0]
    assert_allclose(alphas(TRIANGLE, 3, centers), 0.9, rtol=CLOSED_FORM)
    assert (alphas(TRIANGLE, 2, centers[:1]) < 0.8).all()  # of a line the inside is outside


@pytest.mark.parametrize("n_vertices", [1, 2, 3])
def test_the_distance_is_the_least_over_all_points_of_the_hull(n_vertices, rng):
    """By brute force: many weights, each a point."""
    weights = rng.dirichlet(np.full(n_vertices, 0.4), size=40_000)
    vertices = of_first(n_vertices)
    points = weights @ vertices[0, :n_vertices]
    centers = rng.uniform(-8, 24, size=(40, 2))
    least = np.linalg.norm((points[:, None] - centers) @ WHITENER.T, axis=2).min(axis=0)
    found = nearest(vertices, np.array([n_vertices]), Q, centers)
    distances = np.linalg.norm(found.offsets[0] @ WHITENER.T, axis=1)
    assert (distances <= least + CLOSED_FORM).all() and np.abs(distances - least).max() < 0.05
    outside = found.edges[0] != INSIDE
    assert_allclose(found.weights[0].sum(axis=1), outside)
    on_hull = np.where(outside[:, None], found.weights[0] @ vertices[0], centers)
    assert_allclose(on_hull - centers, found.offsets[0], atol=CLOSED_FORM)


@pytest.mark.parametrize("n_vertices", [1, 2, 3])
def test_what_a_hull_covers_is_steiners_formula(n_vertices):
    """A + P sqrt(pi / 2) + 2 pi, in deviations: a sum over a fine grid."""
    step, vertices = 0.1, of_first(n_vertices)
    xs = np.arange(-20, 36, step) + step / 2
    centers = np.stack(np.meshgrid(xs, xs), axis=-1).reshape(-1, 2)
    total = alphas(vertices, n_vertices, centers).sum() * step**2
    expected = coverage(vertices @ WHITENER.T, np.array([n_vertices]))[0] * 0.9 / np.linalg.det(WHITENER)
    assert total == pytest.approx(expected, rel=HULL_COVERAGE)


def test_the_tangents_of_the_paper_give_the_same(rng):
    """The level sets of the paper's construction are those of the distance.

    Around each vertex is the ellipse on which a Gaussian has a value; two of them have common outer tangents. In the
    quadrilateral between the ellipses' contact points and the vertices, the value is constant along the line that joins
    points of equal value on its two sides.
    """
    o, (p, q) = 0.9, TRIANGLE[0, :2]
    Sigma = np.linalg.inv(Q[0])
    for value in (0.6, 0.2, 1 / 255):
        k = -2 * np.log(value / o)  # the ellipse d^T Q d = k
        # A line n . x = h touches it if (n . p - h)^2 = k n^T Sigma n; both ellipses, if n is normal to q - p.
        normal = np.array([q[1] - p[1], p[0] - q[0]])
        for side in (-1, 1):
            contact = side * np.sqrt(k / (normal @ Sigma @ normal)) * Sigma @ normal  # from either centre
            assert contact @ Q[0] @ contact == pytest.approx(k)
            assert abs((q - p) @ Q[0] @ contact) < CLOSED_FORM * k * 100  # there the ellipse runs along the tangent
            between = p + contact + rng.uniform(0, 1, size=(20, 1)) * (q - p)
            assert_allclose(alphas(TRIANGLE, 2, between), value, rtol=TANGENT_LEVEL)


def test_one_vertex_is_the_conic_of_3dgs_to_the_last_byte(rng):
    """Forward and backward, through the formula of hulls."""
    camera, n = make_camera(rng=rng), 25
    g = make_gaussians(rng, n)
    primitives = Primitives(g.means, g.quats, np.exp(g.log_scales), 1 / (1 + np.exp(-g.opacity_logits)))
    projection = REFERENCE.project(*primitives, camera, GSPLAT_MAIN)
    hulls = project_hulls(Hulls(primitives, rng.normal(size=(n, 4)), np.ones(n, int)), projection, camera, GSPLAT_MAIN)
    ids, centers = np.flatnonzero(projection.radii[:, 0]), rng.uniform(0, 20, size=(50, 2))
    ours, theirs = RESPONSE.hit(hulls, ids, centers), CONIC.hit(projection, ids, centers)
    assert theirs.unclamped.max() > 0.1 and ours.unclamped.tobytes() == theirs.unclamped.tobytes()
    v = rng.normal(size=(2, len(ids), 50))
    v_ours, v_theirs = RESPONSE.hit_vjp(hulls, ids, ours, *v, None), CONIC.hit_vjp(projection, ids, theirs, *v, None)
    for found, expected in zip(v_ours[:3], v_theirs, strict=True):
        assert_allclose(found, expected, rtol=CLOSED_FORM)
    bins = bin_gaussians(projection, TileGrid(camera.width, camera.height, 32, 16), GSPLAT_MAIN)
    scene = rng.uniform(size=(n, 3)), np.zeros(3), bins, GSPLAT_MAIN
    by_kernels = composite_by_kernels(make_response(np.dtype(float)), hulls, *scene)
    assert by_kernels.image.tobytes() == composite_conics(projection, *scene).image.tobytes()


def test_the_gradient_of_the_response(rng):
    """Pixels beside all edges and vertices, and inside."""
    hulls, centers = footprints(TRIANGLE, 3), rng.uniform(-4, 20, size=(12, 2))
    edges = nearest(TRIANGLE, np.array([3]), Q, centers).edges
    assert {INSIDE, 0, 1, 2} <= set(edges.ravel().tolist())

    def moved(means2d, conics, opacities, vertices):
        projection = hulls.projection._replace(means2d=means2d, conics=conics, opacities=opacities)
        return HullFootprints(projection, vertices, hulls.n_vertices)

    inputs = [getattr(hulls, name) for name in RESPONSE.fields]
    one = np.zeros(1, int)
    check_jacobian(
        lambda *args: (RESPONSE.hit(moved(*args), one, centers).unclamped,),
        lambda v: RESPONSE.hit_vjp(hulls, one, RESPONSE.hit(hulls, one, centers), v, v, None),
        inputs,
        names=list(RESPONSE.fields),
    )


def test_the_gradient_of_the_vertices(rng):
    camera, n_vertices = make_camera(rng=rng), np.array([3, 2])
    vertices, means = rng.normal(size=(2, 4)), rng.normal(size=(2, 3)) + np.array([0, 0, 6])
    quats, scales = rng.normal(size=(2, 4)), rng.uniform(0.1, 0.4, size=(2, 3))

    def hulls_of(vertices, means, quats):
        return Hulls(Primitives(means, quats, scales, np.ones(2)), vertices, n_vertices)

    def function(vertices, means, quats, R, t):
        moved, hulls = camera._replace(cam_from_world_R=R, cam_from_world_t=t), hulls_of(vertices, means, quats)
        return (
            project_hulls(hulls, REFERENCE.project(*hulls.primitives, moved, GSPLAT_MAIN), moved, GSPLAT_MAIN).vertices,
        )

    inputs = [vertices, means, quats, camera.cam_from_world_R, camera.cam_from_world_t]
    assert np.abs(function(*inputs)[0]).max(axis=(1, 2)).min() > 1
    check_jacobian(
        function,
        lambda v: footprints_vjp(hulls_of(vertices, means, quats), camera, GSPLAT_MAIN, v),
        inputs,
        names=["vertices", "means", "quats", "R", "t"],
    )


# --- hard cases ---


def hard_hulls():
    """Empty, on a line, edge on, a needle, behind the camera in part, around a pixel, off the image but for an end."""
    n = 7
    population = make_ellipses(make_gaussians(np.random.default_rng(4), n, sh_degree=0, opacity_logit=0.0))
    turned = np.array([[np.sqrt(0.5), 0, np.sqrt(0.5), 0]])  # its plane holds the line of sight
    quats = np.repeat(np.eye(4)[:1], n, axis=0)
    quats[2] = turned
    in_deviations = [[0, 0, 0, 0], [0.2, 0.1, 0.4, 0.2], [0.3, 0, 0, 0.3], [0.5, 0.3, 0, 0], [2, 0, 0, 3]]
    population = population._replace(
        means=np.array(
            [[0.1, 0, 3], [-0.3, 0.2, 2.5], [0.3, -0.2, 2.8], [0, 0, 2.6], [0, 0, 0.2], [0, 0, 3.2], [1.9, 0, 3]]
        ),
        quats=quats,
        log_scales=np.log(np.full((n, 3), 0.1)),
        vertices=np.array([*in_deviations, [0.5, -0.5, -0.5, -0.4], [-1.2, 0.0, 0, 0]], float),
        n_vertices=np.array([3, 3, 3, 2, 3, 3, 2.0]),
    )
    population.log_scales[3] = np.log([0.3, 1e-4, 1e-4])
    population.opacity_logits[4] = -1.5
    return population


def test_hard_cases():
    population, view = hard_hulls(), view_from(make_camera(48, 36, fx=60.0, fy=60.0))
    for dtype, rel in ((np.float64, 100 * PARITY_FLOAT64), (np.float32, 10 * PARITY_FLOAT32_IMAGE)):
        theirs, v_theirs = drawn(RENDERER, population, view, REFERENCE, compared_to=dtype)
        ours, v_ours = drawn(RENDERER, as_dtype(population, dtype), view, CPU)
        assert (ours.visible_ids == np.arange(7)).all()
        assert np.abs(ours.image - theirs.image).max() <= rel
        assert all(np.isfinite(field).all() for field in (*v_ours.gaussians, *v_theirs.gaussians))
    assert np.abs(v_theirs.gaussians.vertices[6]).max() > 0  # seen although its mean is not


def test_an_empty_hull_is_its_ellipse_and_a_flat_one_its_longest_line(rng):
    centers = rng.uniform(-8, 24, size=(200, 2))
    point = np.repeat(TRIANGLE[:, :1], 3, axis=1)
    for n_vertices in (2, 3):
        assert_allclose(alphas(point, n_vertices, centers), alphas(point, 1, centers), rtol=CLOSED_FORM)
    start, along = np.array([2.1, 1.3]), np.array([11.7, 3.1])
    flat = start + np.array([[[0.0], [1.0], [1 / 3]]]) * along  # whose area is a rounding error
    far = start + rng.uniform(-40, 40, size=(200, 1)) * along  # on its line
    for pixels in (centers, far):
        assert_allclose(alphas(flat, 3, pixels), alphas(flat, 2, pixels), rtol=1e3 * CLOSED_FORM)


def test_a_hull_far_below_a_pixel_is_drawn_by_its_low_pass(backend):
    """Its footprint is the low-pass, a covariance of 0.3 pixels squared whose determinant is 0.09."""
    camera = turned_camera(cx=17.5, cy=12.5)
    speck = make_ellipses(balls(in_front_of(camera, [0, 0, 5.0]), [1e-7], [0.8], [[1.0, 1.0, 1.0]]))
    speck = speck._replace(vertices=np.array([[1e-7, 0, 0, 1e-7]]), n_vertices=np.array([3.0]))
    image = RENDERER.render(Model(speck), view_from(camera), Request(backend=backend))[0].image
    assert_allclose(image[12, 17:19, 0], [0.8, 0.8 * np.exp(-0.5 / 0.3)], rtol=1e-4)


def test_a_hull_with_a_vertex_behind_the_camera_is_culled():
    population = hard_hulls()
    population.quats[5] = population.quats[2]
    population.vertices[5] = [4.0, 0.0, -4.0, 0.0]
    output, _ = drawn(RENDERER, population, view_from(make_camera()), REFERENCE)
    assert 5 not in output.visible_ids and np.isfinite(output.image).all()


# --- kinds ---


def test_near_points_of_like_colour_become_one():
    gray, red = np.full(3, 0.5), np.array([0.9, 0.1, 0.1])
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [5, 5, 6], [5, 6, 5], [20, 0, 0.0]])
    colors = np.array([gray, gray + 0.01, gray, gray, red, gray, red])
    assert groups(points, convert_to_lab(colors)).tolist() == [[0, 1, 2], [3, 5, -1], [4, -1, -1], [6, -1, -1]]


def test_of_three_points_each_two_must_be_alike():
    """Greys of L = 50, 54 and 58: neighbours differ by 4, which is less than 5, the ends by 8."""
    points = np.array([[0, 0, 0], [1, 0, 0], [2.1, 0, 0]])
    lab = np.array([[50.0, 0, 0], [54, 0, 0], [58, 0, 0]])
    assert groups(points, lab).tolist() == [[0, 1, -1], [2, -1, -1]]
    assert groups(points, lab * [0.6, 1, 1]).tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(("distance", "is_one"), [(4.9, True), (5.1, False)])
def test_colours_are_alike_below_five_in_lab(distance, is_one):
    lab = np.array([[50.0, 3, 0], [50, 3, distance]])
    assert groups(np.array([[0.0, 0, 0], [1, 0, 0]]), lab).tolist() == (
        [[0, 1, -1]] if is_one else [[0, -1, -1], [1, -1, -1]]
    )


def test_a_fourth_point_is_no_part_of_a_triangle():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1.02, 0], [2.05, 0, 0]])  # the fourth is next to the second
    assert groups(points, np.full((4, 3), 50.0)).tolist() == [[0, 1, 2], [3, -1, -1]]


@pytest.mark.parametrize(("gap", "is_one"), [(1.9, True), (2.1, False)])
def test_a_pair_is_at_most_twice_as_far_apart_as_the_nearest_of_either(gap, is_one):
    """The second point has one at 1 on its other side, which is of another colour."""
    points = np.array([[0.0, 0, 0], [gap, 0, 0], [gap + 1, 0, 0]])
    found = groups(points, np.array([[50.0, 0, 0], [50, 0, 0], [90, 0, 0]])).tolist()
    assert found == ([[0, 1, -1], [2, -1, -1]] if is_one else [[0, -1, -1], [1, -1, -1], [2, -1, -1]])


@pytest.mark.parametrize(("n_nearer", "is_one"), [(2, True), (3, False)])
def test_a_pair_is_among_three_neighbours_of_one(n_nearer, is_one):
    """Of two points 1.5 apart each has nearer ones around it, none of them like another."""
    around = np.array([[-1.0, 0, 0], [0, 1, 0], [0, -1, 0]])[:n_nearer]
    points = np.concatenate([[[0, 0, 0], [1.5, 0, 0]], around, [1.5, 0, 0] - around * [1, 1.01, 1.01]])
    lab = np.column_stack([np.arange(len(points)) * 10.0, np.zeros((len(points), 2))])
    lab[1] = lab[0]
    assert ([0, 1, -1] in groups(points, lab).tolist()) is is_one


def test_the_nearest_pairs_join_first():
    """Each of the first three distances would do; a group has three points, so the first point comes too late."""
    points = np.array([[0.0, 0, 0], [1.9, 0, 0], [2.9, 0, 0], [3.95, 0, 0]])
    assert groups(points, np.full((4, 3), 50.0)).tolist() == [[0, -1, -1], [1, 2, 3]]


def test_a_group_is_half_as_thick_as_its_points_are_on_average(rng):
    """Deviations of 1, 2, 4 and of 2, 4, 8 have the geometric mean sqrt(8)."""
    g = as_dtype(make_gaussians(rng, 2), np.float64)
    g = g._replace(
        means=np.array([[0.0, 0, 3], [1, 0, 3]]),
        sh_dc=np.zeros((2, 3)),
        log_scales=np.log([[1.0, 2, 4], [2, 4, 8]]),
    )
    assert_allclose(group_gaussians(g, rng).log_scales, np.full((1, 3), np.log(np.sqrt(8) / 2)), atol=CLOSED_FORM)


@pytest.mark.parametrize(("grey", "n"), [(0.4, 1), (0.1, 2)])
def test_colours_are_those_that_are_seen(grey, n, rng):
    """Of 0.4, and of 0.1 beside 0.4, coefficients of degree 0 are below zero."""
    g = make_gaussians(rng, 2)._replace(means=np.array([[0.0, 0, 3], [1, 0, 3]]))
    g = g._replace(sh_dc=np.repeat([[0.4 - 0.5], [grey - 0.5]], 3, axis=1) / SH_C0)
    assert len(group_gaussians(g, rng).means) == n


def test_numbers_of_vertices_are_one_to_three(rng):
    population = make_ellipses(make_gaussians(rng, 4))._replace(n_vertices=np.array([0.2, 1.6, 2.4, 3.7]))
    assert counts(population).tolist() == [1, 2, 2, 3]


def test_lab_of_known_colours():
    found = convert_to_lab(np.array([[1.0, 1, 1], [0, 0, 0], [1, 0, 0], [0, 0, 1], [0.2, 0.2, 0.2]]))
    expected = [[100, 0, 0], [0, 0, 0], [53.24, 80.09, 67.2], [32.3, 79.19, -107.86], [21.25, 0, 0]]
    assert_allclose(found, expected, atol=0.05)  # tables have two digits
    assert_allclose(convert_to_lab(np.full((1, 3), 0.02))[0, 0], 903.296 * 0.02 / 12.92, atol=1e-3)  # the straight part


def test_a_group_has_its_points_for_vertices(rng):
    colors = np.repeat(np.arange(40) % 8 == 0, 3).reshape(40, 3).astype(np.float32)
    g = as_dtype(make_gaussians(rng, 40), np.float32)._replace(sh_dc=colors)
    population = group_gaussians(g, rng)
    m = counts(population)
    assert m.sum() == 40 and set(m) == {1, 2, 3} and population.means.dtype == np.float32
    local = place_vertices(population.vertices, m)
    corners = population.means[:, None] + np.einsum(
        "nij,nkj->nki", rotation_matrices(population.quats)[:, :, :2], local
    )
    distances = np.linalg.norm(corners[:, :, None] - g.means, axis=3).min(axis=2)
    assert distances[m == 3].max() < 1e-5 and distances[m == 2, :2].max() < 1e-5


def test_hulls_that_make_no_difference_lose_vertices(rng):
    one = make_ellipses(make_gaussians(rng, 4))._replace(log_scales=np.zeros((4, 3)))
    vertices = np.array([[0.1, 0.1, -0.1, 0.0], [3.0, 0.1, -1.0, 0.0], [0.1, 0.1, 7.0, 7.0], [3, 0.0, 0.0, 3.0]])
    population = one._replace(vertices=vertices, n_vertices=np.array([3, 3, 2, 3.0]))
    after, changed = simplify_kinds(population, least=0.5, min_height=0.5)
    assert changed.tolist() == [True, True, True, False] and counts(after).tolist() == [1, 2, 1, 3]
    # The line of the longest edge, from (-2, -0.1) to (3, 0.1).
    assert_allclose(np.abs(after.vertices[1]), [2.5, 0.1, 0, 0], atol=CLOSED_FORM)
    axes = rotation_matrices(population.quats)[1]
    assert_allclose(after.means[1] - population.means[1], 0.5 * axes[:, 0], atol=CLOSED_FORM)
    assert_allclose(after.means[[0, 2, 3]], population.means[[0, 2, 3]])
    again, changed = simplify_kinds(after, least=0.5, min_height=0.5)
    assert not changed.any() and again.means.tobytes() == after.means.tobytes()


def test_needles_become_lines_and_discs_triangles_that_cover_as_much(rng):
    """Whatever the order of the axes; the image from the front stays nearly the same."""
    log_scales = np.log([[0.05, 0.8, 0.05], [0.3, 0.01, 0.35], [0.3, 0.3, 0.3], [0.01, 0.01, 0.09]])
    population = make_ellipses(make_gaussians(rng, 4))._replace(log_scales=log_scales)
    after, changed = promote_kinds(population, ratio=6.0, size_limit=0.2)
    assert changed.tolist() == [True, True, False, False] and counts(after).tolist() == [2, 3, 1, 1]
    largest_two = np.sort(log_scales, axis=1)[:2, 1:].sum(axis=1)
    covers = coverage(whiten_vertices(after), counts(after))[:2] * np.exp(after.log_scales[:2, :2].sum(axis=1))
    assert_allclose(covers, 2 * np.pi * np.exp(largest_two), rtol=CLOSED_FORM * 10)
    assert_allclose(after.log_scales[0, :2], np.log(0.05))  # all round, that of the needle's second axis
    assert_allclose(after.log_scales[1, :2], np.log(np.sqrt(0.3 * 0.35) / 2))
    R, R_before = rotation_matrices(after.quats), rotation_matrices(population.quats)
    assert_allclose(np.abs(np.sum(R[0, :, 0] * R_before[0, :, 1])), 1)  # along the needle
    assert_allclose(np.abs(np.sum(R[1, :, 2] * R_before[1, :, 1])), 1)  # in the disc's plane
    assert_allclose(after.means, population.means)


@pytest.mark.parametrize("scales", [[0.5, 0.21, 0.01], [0.25, 0.15, 0.01], [0.3, 0.29, 0.06]])
def test_what_is_no_disc_stays(scales, rng):
    """Longer than twice its width, not as wide as the limit, or not six times as thin."""
    population = make_ellipses(make_gaussians(rng, 1))._replace(log_scales=np.log([scales]))
    assert not promote_kinds(population, ratio=6.0, size_limit=0.2)[1].any()


def test_the_recipe_promotes_what_is_six_times_as_long_as_wide_and_a_hundredth_of_the_extent():
    """In a scene of extent 2 from 0.02 on. What changes its shape loses the moments of its shape, and no others."""
    widths = [[0.06, 0.0101, 0.0101], [0.0606, 0.01, 0.01], [0.019, 0.003, 0.003], [0.021, 0.003, 0.003]]
    gaussians = make_ellipses(balls(np.zeros((4, 3)), np.ones(4), np.full(4, 0.5)))
    state = state_of(gaussians._replace(log_scales=np.log(widths)))
    for moment in (state.adam.first, state.adam.second):
        for field in moment:
            field[...] = 7.0
    assert act(find_recipe("mixed"), promote, state, scene_of(extent=2.0)).startswith("2 changed")
    assert counts(state.gaussians).tolist() == [1, 2, 1, 2]
    for moment in (state.adam.first, state.adam.second):
        for name, field in moment._asdict().items():
            is_of_shape = name in ("means", "quats", "log_scales", "vertices")
            assert (field[[0, 2]] == 7).all() and (field[[1, 3]] == (0 if is_of_shape else 7)).all(), name


def test_the_recipe_simplifies_within_half_a_deviation():
    """Lines of 0.49 and of 0.51 deviations, and triangles of a base of 6 and these altitudes: (-3, 0), (3, 0), (0, h).

    The mean of a triangle's vertices is at a third of its altitude.
    """
    gaussians = make_ellipses(balls(np.zeros((4, 3)), np.full(4, 0.1), np.full(4, 0.5)))
    lines, triangles = ([[h / 2, 0, 0, 0] for h in (0.49, 0.51)], [[3, -h / 3, 0, 2 * h / 3] for h in (0.49, 0.51)])
    vertices, n_vertices = 0.1 * np.array([*lines, *triangles]), np.array([2, 2, 3, 3.0])
    state = state_of(gaussians._replace(vertices=vertices, n_vertices=n_vertices))
    act(find_recipe("mixed"), simplify_hulls, state, scene_of())
    assert counts(state.gaussians).tolist() == [1, 2, 2, 3]


# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 120, "test_every": 4}


def test_trains_evaluates_and_renders(tmp_path, capsys):
    write_scene(make_scene("room", supersampling=1, **SCENE), tmp_path / "nook", SCENE)
    run = tmp_path / "run"
    options = ["--recipe", "mixed", "--test-every", "4", "--iterations", "40", "--out", str(run)]
    assert main(["train", str(tmp_path / "nook"), *options]) == 0
    losses = [json.loads(line)["loss"] for line in (run / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < losses[0]
    population = load_ply(run / "point_cloud.ply", MixedGaussians)
    assert set(counts(population)) == {1, 2, 3} and np.abs(population.vertices).max() > 0
    assert main(["eval", str(run)]) == 0
    ply, cameras = str(run / "point_cloud.ply"), ["--cameras", str(run / "cameras.json")]
    for name, extension in (("ours", []), ("theirs", ["--extension", "core"])):
        assert main(["render", ply, *cameras, *extension, "--out", str(tmp_path / name)]) == 0
    ours, theirs = (sorted((tmp_path / name).glob("*.png")) for name in ("ours", "theirs"))
    assert all(a.read_bytes() != b.read_bytes() for a, b in zip(ours, theirs, strict=True))
    capsys.readouterr()
    plain = tmp_path / "plain"
    assert main(["train", str(tmp_path / "nook"), "--recipe", "3dgs", "--iterations", "3", "--out", str(plain)]) == 0
    capsys.readouterr()
    command = [
        "render",
        str(plain / "point_cloud.ply"),
        *cameras,
        "--extension",
        "mixed",
        "--out",
        str(tmp_path / "no"),
    ]
    assert main(command) == 2
    error = capsys.readouterr().err.strip()
    assert "vertices" in error and "\n" not in error and not (tmp_path / "no").exists()


def test_bench_times_hulls():
    """Its Gaussians have random colours: groups of them would be ellipses alone."""
    drawn_by_bench = []

    def watched(model, view, request):
        drawn_by_bench.append(np.bincount(counts(model.gaussians), minlength=4)[1:].tolist())
        return RENDERER.render(model, view, request)

    representation = MIXED_GAUSSIANS._replace(renderer=RENDERER._replace(render=watched))
    extension = load_extension("mixed")._replace(representation=representation)
    cases = extension_cases(extension, synth5k(150), 1)
    assert all(case.passed for case in cases) and {tuple(kinds) for kinds in drawn_by_bench} == {(50, 50, 50)}
