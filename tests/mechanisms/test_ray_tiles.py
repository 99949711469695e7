"""The lists of an image's tiles: bounds of ellipsoids, order, and rays by these lists against all pairs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.extensions.rays.model import Whitened, find_ellipsoids, make_image_tracer, whiten, whiten_model
from minisplat_ref.mechanisms.rays import tile_kernels
from minisplat_ref.mechanisms.rays.pixel_rays import pixel_rays
from minisplat_ref.mechanisms.rays.tile_lists import TILE, Ellipsoids, list_tiles, pixel_range, slopes
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Model
from scenes import in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import PARITY_FLOAT64

CAMERA = make_camera(29, 21)  # neither side is a multiple of a tile, or of a packet
TINY_ALPHAS = GSPLAT_MAIN._replace(alpha_min=1e-30)


def around_the_camera(rng, n, camera=CAMERA, size=0.4):
    """Gaussians at all sides of a camera and around it, thin and thick."""
    places = rng.normal(0, 1, (n, 3)) * rng.uniform(0.1, 3, (n, 1))
    scales = size * np.exp(rng.uniform(-2, 0.7, (n, 3)))
    return whiten(in_front_of(camera, places), rng.normal(size=(n, 4)), np.log(scales), rng.uniform(0.05, 0.95, n))


def both_ways(gaussians, camera=CAMERA, conventions=GSPLAT_MAIN):
    """Return hits, blended rays and gradients by kernels and by the reference, of which the hits were compared."""
    rays, rng = pixel_rays(camera, conventions), np.random.default_rng(5)
    colors, background = rng.uniform(size=(len(gaussians.means), 3)), np.array([0.1, 0.2, 0.3])
    v_blended = tuple(rng.normal(size=(len(rays.near), *shape)) for shape in ((3,), (), ()))
    results = []
    for backend in (CPU, REFERENCE):
        tracer = make_image_tracer(gaussians, camera, conventions, backend)
        blended = tracer.blend(colors, rays, background, conventions)
        v = tracer.blend_vjp(colors, rays, background, conventions, blended, v_blended)
        results.append((tracer.list_hits(rays, conventions), blended, v))
    for name in ("offsets", "ray_ids", "gaussian_ids"):
        assert_array_equal(*(getattr(hits, name) for hits, _, _ in results), name)
    for name in ("unclamped", "depths", "weights", "transmittances"):
        assert_allclose(*(getattr(hits, name) for hits, _, _ in results), rtol=PARITY_FLOAT64, err_msg=name)
    return results


def assert_agree(results):
    (_, ours, v_ours), (_, theirs, v_theirs) = results
    for name in ("image", "depths", "transmittances"):
        assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=PARITY_FLOAT64, atol=PARITY_FLOAT64)
    for name in ("n_hits", "is_seen"):
        assert_array_equal(getattr(ours, name), getattr(theirs, name), name)
    for name, expected in v_theirs._asdict().items():
        scale = np.abs(expected).max(initial=0)
        assert np.abs(getattr(v_ours, name) - expected).max(initial=0) <= PARITY_FLOAT64 * scale, name


# --- bounds ---


@pytest.mark.parametrize("z", [2.0, 1.05, 0.3, -0.3, -0.9])
def test_slopes_bound_the_points_in_front_and_no_more(z, rng):
    """Of ellipsoids before the camera, through its plane, around its axis, or mostly behind it."""
    directions = rng.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for a in (-3.0, -0.4, 0.0, 1.5):
        R, s = rotation_matrices(rng.normal(size=(1, 4)))[0], np.array([1.0, 0.5, 0.2])
        axes = R * s  # columns
        points = directions @ axes.T + [a, 0.0, z]
        seen = points[points[:, 2] > 1e-3]
        if len(seen) == 0:
            continue
        Sigma = axes @ axes.T
        low, high = slopes(a, z, Sigma[0, 0], Sigma[0, 2], Sigma[2, 2])
        u = seen[:, 0] / seen[:, 2]
        assert low <= u.min() and u.max() <= high
        if z * z > 1.1 * Sigma[2, 2]:
            assert_allclose([low, high], [u.min(), u.max()], atol=0.02)
        else:  # a bound that is infinite is approached, and the other one is met
            assert np.isfinite(low) or u.min() < -50
            assert np.isfinite(high) or u.max() > 50
            assert not np.isfinite(low) or u.min() - low < 0.05 * (1 + abs(low))
            assert not np.isfinite(high) or high - u.max() < 0.05 * (1 + abs(high))


def test_pixels_whose_centres_have_the_slopes():
    """Focal length 10, the axis at pixel 4: the centres 0.5 to 7.5 have the slopes -0.35 to 0.35."""
    assert pixel_range(-0.35, 0.35, 10.0, 4.0, 8) == (0, 8)
    assert pixel_range(-0.34, 0.34, 10.0, 4.0, 8) == (1, 7)
    assert pixel_range(0.06, 0.14, 10.0, 4.0, 8) == (5, 5)
    assert pixel_range(-np.inf, 0.0, 10.0, 4.0, 8) == (0, 4)
    assert pixel_range(0.0, np.inf, 10.0, 4.0, 8) == (4, 8)
    assert pixel_range(2.0, 3.0, 10.0, 4.0, 8) == (8, 8)


@pytest.mark.parametrize("camera", [CAMERA, turned_camera()], ids=["straight", "turned"])
def test_boxes_and_lower_bounds_hold_every_hit(camera, rng):
    gaussians = around_the_camera(rng, 300, camera)
    rays = pixel_rays(camera, GSPLAT_MAIN)
    hits = make_image_tracer(gaussians, camera, GSPLAT_MAIN, REFERENCE).list_hits(rays, GSPLAT_MAIN)
    lists = list_tiles(find_ellipsoids(gaussians, GSPLAT_MAIN), camera, GSPLAT_MAIN)
    y, x = np.divmod(hits.ray_ids, camera.width)
    x0, y0, x1, y1 = lists.boxes[hits.gaussian_ids].T
    assert len(hits.ray_ids) > 1000
    assert ((x0 <= x) & (x < x1) & (y0 <= y) & (y < y1)).all()
    assert (lists.nearest[hits.gaussian_ids] <= hits.depths).all()


def test_a_ball_has_the_box_of_its_outline():
    """Radius r at the distance z on the axis: the outline is at the slope r / sqrt(z^2 - r^2)."""
    r, z, camera = 0.5, 2.0, make_camera(64, 48, fx=40.0, fy=30.0)
    lists = list_tiles(Ellipsoids(np.array([[0, 0, z]]), r * np.eye(3)[None], np.ones(1)), camera, GSPLAT_MAIN)
    slope = r / np.sqrt(z * z - r * r)
    half_x, half_y = 40 * slope, 30 * slope  # 10.3 and 7.7 px
    assert_array_equal(lists.boxes[0], np.rint([32 - half_x, 24 - half_y, 32 + half_x, 24 + half_y]))
    assert lists.nearest[0] == pytest.approx(z - r, abs=1e-6)
    assert lists.n_pixels == 20 * 16


# --- lists ---


def test_lists_hold_each_pair_once_nearest_first(rng):
    gaussians = around_the_camera(rng, 200)
    lists = list_tiles(find_ellipsoids(gaussians, GSPLAT_MAIN), CAMERA, GSPLAT_MAIN)
    depths = gaussians.means @ CAMERA.cam_from_world_R[2] + CAMERA.cam_from_world_t[2]
    found = set()
    for tile in range(len(lists.offsets) - 1):
        rows = lists.rows[lists.offsets[tile] : lists.offsets[tile + 1]]
        assert (np.diff(depths[rows]) >= 0).all()
        found |= {(tile, n) for n in rows.tolist()}
    n_columns, expected = -(-CAMERA.width // TILE), set()
    for n, (x0, y0, x1, y1) in enumerate(lists.boxes.tolist()):
        for y in range(y0 // TILE, -(-y1 // TILE) if x1 > x0 else 0):
            expected |= {(y * n_columns + x, n) for x in range(x0 // TILE, -(-x1 // TILE))}
    assert found == expected and len(lists.rows) == len(expected) > 200
    for n in range(200):
        assert (lists.rows[lists.pairs[lists.row_offsets[n] : lists.row_offsets[n + 1]]] == n).all()


def test_what_no_ray_meets_is_in_no_list():
    """Behind the camera, beyond the far plane, beside the image, too faint, no number, no size."""
    places = np.array([[0, 0, -2.0], [0, 0, 2e10], [9, 0, 2], [0, 0, 2], [np.nan, 0, 2], [0, 0, 2], [0, 0, 2]])
    axes, reaches = np.repeat(0.1 * np.eye(3)[None], 7, axis=0), np.ones(7)
    reaches[3], axes[5] = -np.inf, np.inf
    lists = list_tiles(Ellipsoids(places, axes, reaches), CAMERA, GSPLAT_MAIN)
    assert_array_equal(np.flatnonzero(np.diff(lists.row_offsets)), [6])


# --- rays ---


@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, INRIA, TINY_ALPHAS], ids=["main", "inria", "tiny"])
@pytest.mark.parametrize("n", [0, 1, 300])
def test_kernels_and_reference_agree_around_a_camera(n, conventions, rng):
    """Also where the camera is inside many Gaussians, and where the ends of rays come early."""
    results = both_ways(around_the_camera(rng, n), conventions=conventions)
    assert n < 300 or len(results[0][0].ray_ids) > 5000
    assert_agree(results)


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (8, 8), (9, 17)])
def test_images_of_any_size(size, rng):
    camera = make_camera(*size, fx=3.0 * size[0], fy=3.0 * size[1])
    results = both_ways(whiten_model(Model(make_gaussians(rng, 40))), camera)
    assert results[0][1].n_hits.min() > 0  # also in the corners
    assert_agree(results)


@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, INRIA, TINY_ALPHAS], ids=["main", "inria", "tiny"])
def test_opaque_layers_end_a_ray_where_they_should(conventions, rng):
    """Sixty large balls, most of them opaque, in random order: their order by t differs from that by their depths."""
    n = 60
    places = np.column_stack([rng.normal(size=(n, 2)), rng.uniform(2, 5, n)])
    sizes = np.repeat(rng.uniform(0.3, 2.0, n)[:, None], 3, axis=1)
    gaussians = whiten(places, np.tile([1.0, 0, 0, 0], (n, 1)), np.log(sizes), rng.uniform(0.3, 1.0, n))
    results = both_ways(gaussians, conventions=conventions)
    assert 3 < np.diff(results[0][0].offsets).mean() < 30
    assert_agree(results)


def test_a_later_entry_of_a_list_may_be_met_first():
    """Three walls at z = 2, above the clamp, end the rays; a ball at 3 begins behind them; a needle, its centre at 4,
    leans towards the camera and is met at 1.
    """
    places = np.array([[0, 0, 2.0], [0, 0, 2.0], [0, 0, 2.0], [0, 0, 3.0], [2.0, 0, 4.0]])
    scales = np.array([[3, 3, 0.1]] * 3 + [[0.02] * 3] + [[0.1, 0.1, 3.0]])
    lean = np.arctan2(2, 3) / 2
    quats = np.array([[1.0, 0, 0, 0]] * 4 + [[np.cos(lean), 0, np.sin(lean), 0]])
    results = both_ways(whiten(places, quats, np.log(scales), np.array([0.995, 0.995, 0.995, 0.9, 0.9])))
    hits, r = results[0][0], 10 * CAMERA.width + 14  # the pixel on the axis
    assert hits.gaussian_ids[hits.offsets[r]] == 4 and hits.depths[hits.offsets[r]] == pytest.approx(1, abs=0.1)
    assert (hits.unclamped > 0.99).any()
    assert_agree(results)


def test_a_ray_has_any_number_of_hits(rng):
    """A thousand faint layers, of which no ray is stopped: every ray has all of them, in the order of t."""
    n = 1000
    places = np.column_stack([np.zeros((n, 2)), rng.permutation(np.linspace(2, 5, n))])
    gaussians = whiten(places, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), np.log(9.0)), np.full(n, 0.005))
    results = both_ways(gaussians, make_camera(5, 3))
    assert (results[0][1].n_hits == n).all()
    assert_agree(results)


def test_equal_depths_are_taken_in_the_order_of_rows(rng):
    """Copies, in two orders: of equal t the lower row comes first, wherever it is in a list."""
    gaussians = whiten_model(Model(make_gaussians(rng, 30)))
    twice = Whitened(*(np.concatenate([field, field[::-1]]) for field in gaussians))
    results = both_ways(twice, make_camera())
    hits = results[0][0]
    same = (np.diff(hits.depths) == 0) & (np.diff(hits.ray_ids) == 0)
    assert same.sum() > 500 and (np.diff(hits.gaussian_ids)[same] > 0).all()
    assert_agree(results)


def test_a_needle_in_the_line_of_sight_and_a_flat_one_edge_on(rng):
    """Rays graze both; one has no width on the image, the other no height."""
    quats = np.tile([1.0, 0, 0, 0], (2, 1))
    scales = np.array([[1e-6, 1e-6, 2.0], [0.5, 1e-7, 0.5]])
    for shift in (0.0, 1e-7, 1 / 60):
        gaussians = whiten(np.array([[shift, 0, 3.0], [0, shift, 3.0]]), quats, np.log(scales), np.full(2, 0.9))
        (_, ours, v_ours), (_, theirs, _) = both_ways(gaussians, make_camera(25, 17))
        assert ours.n_hits.sum() > 0 and np.isfinite(v_ours.shapes).all()
        assert_allclose(ours.image, theirs.image, atol=PARITY_FLOAT64)


def test_a_ray_whose_hits_find_no_room_is_traced_again(rng, monkeypatch):
    """The gradient and the list do not depend on how many hits the forward pass could keep."""
    gaussians, rays, found = around_the_camera(rng, 50), pixel_rays(CAMERA, GSPLAT_MAIN), []
    colors, ones = rng.uniform(size=(50, 3)), np.ones(len(rays.near))
    for room in (tile_kernels.HITS_KEPT_MAX, 3):
        monkeypatch.setattr(tile_kernels, "HITS_KEPT_MAX", room)
        tracer = make_image_tracer(gaussians, CAMERA, GSPLAT_MAIN, CPU)
        blended = tracer.blend(colors, rays, np.zeros(3), GSPLAT_MAIN)
        assert (blended.kept is None) == (room == 3)
        v_blended = np.ones((len(ones), 3)), ones, ones
        v = tracer.blend_vjp(colors, rays, np.zeros(3), GSPLAT_MAIN, blended, v_blended)
        found.append((*tracer.list_hits(rays, GSPLAT_MAIN), *v))
    for ours, theirs in zip(*found, strict=True):
        assert_array_equal(ours, theirs)
