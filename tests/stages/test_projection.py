import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products, check_jacobian
from minisplat_ref import constants
from minisplat_ref.constants import COMPENSATION_FLOOR, GSPLAT_MAIN, INRIA
from minisplat_ref.reference.pinhole import (
    pinhole,
    pinhole_jacobians,
    pinhole_jacobians_vjp,
    pinhole_rays,
    pinhole_vjp,
    project_into_image,
    slope_limits,
    unproject_depth,
)
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Camera, Model, ProjectionGradient, TileGrid, view_from
from scenes import (
    ALL_CONVENTIONS,
    ANTIALIASED,
    activated,
    as_dtype,
    balls,
    in_front_of,
    make_camera,
    make_gaussians,
    turned_camera,
)
from tolerances import CLOSED_FORM, GRADIENT_FLOOR, PARITY_FLOAT32_GRADIENT, PARITY_FLOAT32_PROJECTION, PARITY_FLOAT64

CAMERA = Camera(np.eye(3), np.zeros(3), 100.0, 50.0, 32.0, 24.0, 64, 48)
IDENTITY = np.array([[1.0, 0, 0, 0]])
NAMES = ["means", "quats", "scales", "opacities", "R", "t"]


def project_one(backend, mean, scales, opacity, *, camera=CAMERA, conventions=GSPLAT_MAIN, quat=IDENTITY):
    return backend.project(
        np.array([mean], dtype=float), quat, np.array([scales], dtype=float), np.array([opacity]), camera, conventions
    )


# --- closed form ---


def test_gaussian_on_the_axis(backend):
    # At z = 2, scales (0.1, 0.2) are 100 * 0.1 / 2 = 5 px and 50 * 0.2 / 2 = 5 px wide; the low-pass adds 0.3 px^2.
    projection = project_one(backend, [0, 0, 2], [0.1, 0.2, 7], 0.5)
    assert_allclose(projection.means2d, [[32, 24]], rtol=CLOSED_FORM)
    assert_allclose(projection.depths, [2], rtol=CLOSED_FORM)
    assert_allclose(projection.conics, [[1 / 25.3, 0, 1 / 25.3]], rtol=CLOSED_FORM, atol=CLOSED_FORM)
    assert_allclose(projection.opacities, [0.5], rtol=CLOSED_FORM)
    # Alpha falls from 0.5 to 1/255 at sqrt(2 ln 127.5) = 3.1139 sigmas, 15.66 px.
    assert_array_equal(projection.radii, [[16, 16]])
    assert_array_equal(projection.boxes, [[16, 8, 48, 40]])
    assert projection.radii.dtype == projection.boxes.dtype == np.int32


def test_gaussian_off_the_axis(backend):
    # At (1, 0, 2) the ray's slope is 1/2: dp_x = 50 dx - 25 dz, dp_y = 25 dy, so a ball of radius s has
    # cov = s^2 diag(50^2 + 25^2, 25^2).
    camera = CAMERA._replace(cx=5.0)
    projection = project_one(backend, [1, 0, 2], [0.1, 0.1, 0.1], 1.0, camera=camera)
    assert_allclose(projection.means2d, [[55, 24]], rtol=CLOSED_FORM)
    assert_allclose(projection.conics, [[1 / 31.55, 0, 1 / 6.55]], rtol=CLOSED_FORM, atol=CLOSED_FORM)


def test_rotated_gaussian_has_a_mixed_term(backend):
    # A rod along (1, 1, 0) / sqrt(2) with equal focal lengths: cov = 50^2 0.02 [[1, 1], [1, 1]] / 2 + 0.3 I.
    camera = CAMERA._replace(fy=100.0)
    quat = np.array([[np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]])
    projection = project_one(backend, [0, 0, 2], [np.sqrt(0.02), 0, 0], 1.0, camera=camera, quat=quat)
    expected = np.linalg.inv([[25.3, 25], [25, 25.3]])
    assert_allclose(projection.conics, [[expected[0, 0], expected[0, 1], expected[1, 1]]], rtol=1e3 * CLOSED_FORM)


def test_disc_seen_edge_on_keeps_its_precision(backend):
    # 50,000 px by 0.5 px: the inverse must not lose the small variance in the large one.
    projection = project_one(backend, [0, 0, 2], [1e3, 0.02, 1e-3], 1.0)
    assert_allclose(projection.conics, [[1 / (2.5e9 + 0.3), 0, 1 / 0.55]], rtol=CLOSED_FORM, atol=1e-16)


def test_camera_pose_moves_the_gaussian(backend):
    # x_cam = R x + t, with R a quarter turn about y: (x, y, z) -> (z, y, -x).
    R = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    camera = CAMERA._replace(cam_from_world_R=R, cam_from_world_t=np.array([0.0, 0.2, 0.5]))
    projection = project_one(backend, [-1.5, 0, 0.1], [0.1, 0.1, 0.1], 1.0, camera=camera)
    assert_allclose(projection.means2d, [[32 + 100 * 0.1 / 2, 24 + 50 * 0.2 / 2]], rtol=CLOSED_FORM)
    assert_allclose(projection.depths, [2], rtol=CLOSED_FORM)


def test_antialiasing_scales_the_opacity(backend):
    projection = project_one(backend, [0, 0, 2], [0.01, 0.02, 1], 0.8, conventions=ANTIALIASED)  # 0.5 px in x and y
    assert_allclose(projection.opacities, [0.8 * 0.25 / 0.55], rtol=CLOSED_FORM)


def test_antialiasing_has_a_floor(backend):
    projection = project_one(backend, [0, 0, 2], [1e-9, 1e-9, 1], 1.0, conventions=ANTIALIASED)
    assert_allclose(projection.opacities, [COMPENSATION_FLOOR], rtol=CLOSED_FORM)


def test_full_support_box_is_exactly_what_alpha_reaches(backend, rng):
    means, quats, scales, opacities = activated(make_gaussians(rng, 40))
    camera = make_camera(64, 48, fx=70, fy=75)
    projection = backend.project(means, quats, scales, opacities, camera, GSPLAT_MAIN)
    ys, xs = np.mgrid[:48, :64]
    n_tight = 0
    for (mx, my), (a, b, c), opacity, (x0, y0, x1, y1) in zip(*(projection[k] for k in (0, 2, 3, 5)), strict=True):
        dx, dy = xs + 0.5 - mx, ys + 0.5 - my
        is_seen = opacity * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy) >= GSPLAT_MAIN.alpha_min
        is_inside = (x0 <= xs) & (xs < x1) & (y0 <= ys) & (ys < y1)
        assert not (is_seen & ~is_inside).any()
        if (
            0 < x0 and 0 < y0 and x1 < 64 and y1 < 48
        ):  # rounded outwards twice, and the ellipse's tip may lie between two rows of pixels
            assert xs[is_seen].min() - x0 <= 3 and x1 - 1 - xs[is_seen].max() <= 3
            assert ys[is_seen].min() - y0 <= 3 and y1 - 1 - ys[is_seen].max() <= 3
            n_tight += 1
    assert n_tight > 10


def test_inria_extent_by_hand(backend):
    # A flat disc with cov = diag(28.3, 28.3). The root is floored at 0.1: r = ceil(3 sqrt(28.3 + sqrt(0.1))), above 16.
    # The centre (33, 16) is (32.5, 15.5) where pixel centres are whole numbers. Tiles in x from
    # floor((32.5 - 17) / 16) = 0 to floor((32.5 + 17 + 15) / 16) = 4, in y from -1 to floor((15.5 + 17 + 15) / 16) = 2.
    width = np.sqrt(28) * 2 / 100
    projection = project_one(backend, [0.02, -0.32, 2], [width, 2 * width, 0], 0.5, conventions=INRIA)
    assert_allclose(projection.means2d, [[33, 16]], rtol=CLOSED_FORM)
    assert_array_equal(projection.radii, [[17, 17]])
    assert_array_equal(projection.boxes, [[0, 0, 64, 32]])


def test_inria_ignores_the_principal_point(backend):
    camera = CAMERA._replace(cx=20.0, cy=30.0)
    assert_allclose(project_one(backend, [0, 0, 2], [0.1] * 3, 0.5, camera=camera).means2d, [[20, 30]])
    assert_allclose(
        project_one(backend, [0, 0, 2], [0.1] * 3, 0.5, camera=camera, conventions=INRIA).means2d, [[32, 24]]
    )


def test_jacobian_is_frozen_outside_the_field_of_view(backend):
    # tan(fov_x / 2) = 0.32. At slope 1 INRIA's clamp is 1.3 * 0.32 = 0.416; gsplat's, with cx = 20, is
    # (64 - 20) / 100 + 0.3 * 0.32 = 0.536. A ball of 50 px (z = 1, s = 0.5) has cov_xx = 50^2 (1 + slope^2) + 0.3.
    camera = CAMERA._replace(cx=20.0)
    for conventions, slope in ((INRIA, 0.416), (GSPLAT_MAIN, 0.536)):
        projection = project_one(backend, [1, 0, 1], [0.5] * 3, 1.0, camera=camera, conventions=conventions)
        assert_allclose(projection.conics[0, 0], 1 / (2500 * (1 + slope**2) + 0.3), rtol=CLOSED_FORM)
    # On the other side gsplat's is 20 / 100 + 0.096 = 0.296.
    projection = project_one(backend, [-1, 0, 1], [0.5] * 3, 1.0, camera=camera)
    assert_allclose(projection.conics[0, 0], 1 / (2500 * (1 + 0.296**2) + 0.3), rtol=CLOSED_FORM)


def test_pinhole_jacobian_is_the_derivative_of_the_pinhole(rng):
    points = rng.uniform([-1, -1, 2], [1, 1, 4], size=(3, 3))
    infinity = np.full(2, np.inf)
    J = pinhole_jacobians(points, CAMERA, -infinity, infinity)
    check_jacobian(
        lambda x: (pinhole(x, CAMERA),), lambda v: (np.einsum("nki,nk->ni", J, v),), (points,), names=["points"]
    )


def test_camera_center_is_where_the_camera_maps_to_0(rng):
    quarter_turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = CAMERA._replace(cam_from_world_R=quarter_turn, cam_from_world_t=np.array([1.0, 2, 3]))
    assert_array_equal(turned.center, [-2, 1, -3])
    assert_allclose(quarter_turn @ turned.center + turned.cam_from_world_t, 0, atol=CLOSED_FORM)
    camera = make_camera(rng=rng)
    assert camera.center.dtype == np.float64
    single = camera.astype(np.float32)
    assert single.center.dtype == single.cam_from_world_R.dtype == single.cam_from_world_t.dtype == np.float32
    assert single[2:] == camera[2:] and camera.cam_from_world_R.dtype == np.float64
    assert_array_equal(single.astype(np.float64).cam_from_world_t, camera.cam_from_world_t.astype(np.float32))


def test_pinhole_rays_are_the_inverse_of_the_pinhole(rng):
    camera = Camera(np.eye(3), np.zeros(3), 20.0, 25.0, 11.0, 6.0, 24, 14)
    assert_allclose(pinhole_rays(0.5, 13.5, camera), [-10.5 / 20, 7.5 / 25, 1], rtol=CLOSED_FORM)
    xs, ys, z = rng.uniform(-5, 30, 6), rng.uniform(-5, 20, 6), rng.uniform(0.5, 4, 6)
    assert_allclose(pinhole(z[:, None] * pinhole_rays(xs, ys, camera), camera), np.column_stack([xs, ys]), rtol=1e-12)
    grid = pinhole_rays(np.arange(24) + 0.5, np.arange(14)[:, None] + 0.5, camera)
    assert grid.shape == (14, 24, 3)
    assert_array_equal(grid[3, 7], pinhole_rays(7.5, 3.5, camera))


# --- gradient ---


def test_pinhole_gradients(rng):
    points = np.array([[0.3, -0.2, 2.0], [2.0, 0.1, 1.5], [-0.1, -2.0, 1.2]])  # in view, and beyond each clamp
    low, high = slope_limits(CAMERA, GSPLAT_MAIN, points.dtype)
    assert points[1, 0] / points[1, 2] > high[0] and points[2, 1] / points[2, 2] < low[1]
    check_jacobian(
        lambda x: (pinhole(x, CAMERA), pinhole_jacobians(x, CAMERA, low, high)),
        lambda v_p, v_J: (pinhole_vjp(points, CAMERA, v_p) + pinhole_jacobians_vjp(points, CAMERA, low, high, v_J),),
        (points,),
        names=["points"],
    )


def functions_of_arrays(backend, camera, conventions, inputs):
    """`project` and `project_vjp` over the arrays that have a gradient, pose included."""

    def function(means, quats, scales, opacities, R, t):
        view = camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        return backend.project(means, quats, scales, opacities, view, conventions)[:4]

    def vjp(*cotangents):
        projection = backend.project(*inputs[:4], camera, conventions)
        return backend.project_vjp(*inputs[:4], camera, conventions, projection, ProjectionGradient(*cotangents))

    return function, vjp


HARD_CAMERAS = {
    "centred": {},
    "off-centre": {"cx": 9.0, "cy": 13.0},
    "narrow": {"fx": 90.0, "fy": 95.0},  # most means are beyond the Jacobian's clamp
}


@pytest.mark.parametrize("conventions", ALL_CONVENTIONS, ids=lambda c: c.name)
@pytest.mark.parametrize("view", HARD_CAMERAS.values(), ids=HARD_CAMERAS.keys())
def test_project_jacobian(conventions, view, rng):
    camera = make_camera(rng=rng, **view)
    gaussians = make_gaussians(rng, 3)
    inputs = (*activated(gaussians), camera.cam_from_world_R, camera.cam_from_world_t)
    # A wide Gaussian stays in view even where the Jacobian is clamped.
    inputs = (inputs[0], inputs[1], inputs[2] * 3, np.array([0.5, 0.8, 0.9]), *inputs[4:])
    projection = REFERENCE.project(*inputs[:4], camera, conventions)
    assert (projection.radii > 0).all()
    function, vjp = functions_of_arrays(REFERENCE, camera, conventions, inputs)
    check_jacobian(function, vjp, inputs, names=NAMES)


def test_narrow_camera_really_clamps(rng):
    camera = make_camera(rng=rng, **HARD_CAMERAS["narrow"])
    means = make_gaussians(rng, 3).means @ camera.cam_from_world_R.T + camera.cam_from_world_t
    low, high = slope_limits(camera, GSPLAT_MAIN, means.dtype)
    is_clamped = (means[:, :2] / means[:, 2:] < low) | (means[:, :2] / means[:, 2:] > high)
    assert is_clamped.any(axis=0).all() and not is_clamped.all()


@pytest.mark.parametrize("conventions", ALL_CONVENTIONS, ids=lambda c: c.name)
def test_project_gradient_of_many(backend, conventions, rng):
    camera = make_camera(64, 48, fx=70, fy=75, cx=30, cy=20, rng=rng)
    inputs = (*activated(make_gaussians(rng, 100)), camera.cam_from_world_R, camera.cam_from_world_t)
    function, vjp = functions_of_arrays(backend, camera, conventions, inputs)
    cotangents = [rng.normal(size=output.shape) for output in function(*inputs)]
    # A conic of a Gaussian thinner than a pixel is near 1 / 0.3, one of a big one near 1e-3: all of them must count.
    check_inner_products(function, vjp(*cotangents), inputs, cotangents, rng, names=NAMES)


def test_floored_compensation_has_no_gradient(backend):
    inputs = (np.array([[0.1, 0.1, 2.0]]), IDENTITY, np.full((1, 3), 1e-5), np.ones(1))
    projection = backend.project(*inputs, CAMERA, ANTIALIASED)
    v = ProjectionGradient(np.zeros((1, 2)), np.zeros(1), np.zeros((1, 3)), np.ones(1))
    gradient = backend.project_vjp(*inputs, CAMERA, ANTIALIASED, projection, v)
    assert_array_equal(gradient.scales, 0)
    assert_allclose(gradient.opacities, [COMPENSATION_FLOOR], rtol=CLOSED_FORM)


# --- hard cases ---

BIG = 1e300
CULLED = {
    "behind": ([0, 0, -2], [0.1] * 3, 0.5),
    "on the near plane": ([0, 0, 0.01], [0.1] * 3, 0.5),
    "at the camera": ([0, 0, 0], [0.1] * 3, 0.5),
    "beyond the far plane": ([0, 0, 1e11], [1e9] * 3, 0.5),
    "left of the image": ([-3, 0, 2], [0.1] * 3, 0.5),
    "below the image": ([0, 3, 2], [0.1] * 3, 0.5),
    "transparent": ([0, 0, 2], [0.1] * 3, 0.0039),
    "NaN mean": ([np.nan, 0, 2], [0.1] * 3, 0.5),
    "NaN depth": ([0, 0, np.nan], [0.1] * 3, 0.5),
    "infinite mean": ([np.inf, 0, 2], [0.1] * 3, 0.5),
    "huge mean": ([BIG, -BIG, 2], [0.1] * 3, 0.5),
    "huge depth": ([0, 0, BIG], [0.1] * 3, 0.5),
    "NaN scale": ([0, 0, 2], [np.nan, 0.1, 0.1], 0.5),
    "infinite scale": ([0, 0, 2], [np.inf, 0.1, 0.1], 0.5),
    "huge scale": ([0, 0, 2], [BIG, 0.1, 0.1], 0.5),
    "NaN opacity": ([0, 0, 2], [0.1] * 3, np.nan),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, ANTIALIASED, INRIA], ids=lambda c: c.name)
def test_what_cannot_be_shown_is_culled_without_warning(backend, conventions, dtype):
    with np.errstate(over="ignore"):  # 1e300 is infinite in float32
        means = np.array([row[0] for row in CULLED.values()] + [[0.1, 0.2, 2]]).astype(dtype)
        scales = np.array([row[1] for row in CULLED.values()] + [[0.1, 0.2, 0.3]]).astype(dtype)
    opacities = np.array([row[2] for row in CULLED.values()] + [0.5], dtype=dtype)
    inputs = (means, np.repeat(IDENTITY.astype(dtype), len(means), axis=0), scales, opacities)
    projection = backend.project(*inputs, CAMERA, conventions)
    is_culled = ~projection.radii.any(axis=1)
    names = np.array([*CULLED, "visible"])
    if conventions is INRIA:  # its near plane is farther, its boxes are whole tiles
        assert set(names[is_culled]) >= set(CULLED) - {"left of the image", "below the image"}
    else:
        assert set(names[is_culled]) == set(CULLED)
    assert not is_culled[-1]
    for field in projection:
        assert not field[is_culled].any()
        assert np.isfinite(field).all()
    v = ProjectionGradient(*(np.ones_like(field) for field in projection[:4]))
    gradient = backend.project_vjp(*inputs, CAMERA, conventions, projection, v)
    for field in gradient:
        assert np.isfinite(field).all()
    for field in gradient[:4]:
        assert not field[is_culled].any()
    assert gradient.means[-1].all() and gradient.scales[-1].all()


def test_nan_quaternion_is_culled(backend):
    assert not project_one(backend, [0, 0, 2], [0.1] * 3, 0.5, quat=np.full((1, 4), np.nan)).radii.any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_quaternions_have_any_length(backend, dtype, rng):
    means, quats, scales, opacities = (array.astype(dtype) for array in activated(make_gaussians(rng, 20)))
    largest = 1e36 if dtype == np.float32 else 1e300
    found = []
    for length in (1, 1 / largest, largest):
        inputs = means, quats * dtype(length), scales, opacities, CAMERA, GSPLAT_MAIN
        projection = backend.project(*inputs)
        v = ProjectionGradient(*(np.ones_like(field) for field in projection[:4]))
        found.append((projection.conics, backend.project_vjp(*inputs, projection, v).quats * dtype(length)))
    tolerance = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_PROJECTION
    for conics, v_quats in found[1:]:
        assert_allclose(conics, found[0][0], rtol=tolerance, atol=tolerance * np.abs(conics).max())
        assert_allclose(v_quats, found[0][1], rtol=0, atol=tolerance * np.abs(v_quats).max())


def test_huge_gaussian_covers_the_image(backend):
    projection = project_one(backend, [0, 0, 2], [1e20, 1e20, 1e-3], 0.5)
    assert_array_equal(projection.boxes, [[0, 0, 64, 48]])
    assert (projection.radii > 64).all()


@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, INRIA], ids=lambda c: c.name)
@pytest.mark.parametrize("place", [1e3, 1e12])
def test_what_covers_the_image_from_far_beside_is_seen(backend, conventions, place):
    """A footprint whose radius no int32 holds: it is clamped when it is stored, and not before its box is made."""
    camera = Camera(np.eye(3), np.zeros(3), 400.0, 400.0, 16.0, 16.0, 32, 32)
    projection = project_one(backend, [place, 0, 0.25], [place] * 3, 0.9, camera=camera, conventions=conventions)
    assert (projection.means2d[0, 0] > constants.RADIUS_MAX) == (place > 1e6)
    assert_array_equal(projection.boxes, [[0, 0, 32, 32]])
    assert (projection.radii > 1e6).all() and (projection.radii <= constants.RADIUS_MAX).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_gaussian_at_alpha_min_reaches_no_pixel(backend, dtype):
    """At alpha_min its extent is nothing; one digit above, it is one pixel and is seen."""
    least = dtype(GSPLAT_MAIN.alpha_min)
    opacities = np.array([np.nextafter(least, dtype(0)), least, np.nextafter(least, dtype(1))])
    inputs = np.tile([0.103, 0.107, 2.0], (3, 1)), np.repeat(IDENTITY, 3, axis=0), np.full((3, 3), 0.1), opacities
    projection = backend.project(*(array.astype(dtype) for array in inputs), CAMERA, GSPLAT_MAIN)
    assert_array_equal(projection.radii, [[0, 0], [0, 0], [1, 1]])
    for field in projection:
        assert not field[:2].any() and field[2].any()
    grid = TileGrid(CAMERA.width, CAMERA.height, backend.tile_width, backend.tile_height)
    assert set(backend.bin_gaussians(projection, grid, GSPLAT_MAIN).gaussian_ids) == {2}


def test_gaussian_at_the_corner_keeps_its_part_inside(backend):
    projection = project_one(backend, [-0.7, -1.05, 2], [0.1, 0.2, 0.1], 0.5)  # centre at (-3, -2.25)
    x0, y0, x1, y1 = projection.boxes[0]
    assert (x0, y0) == (0, 0) and 0 < x1 < 20 and 0 < y1 < 20


def test_no_gaussians(backend):
    inputs = (np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0))
    projection = backend.project(*inputs, CAMERA, GSPLAT_MAIN)
    assert [field.shape for field in projection] == [(0, 2), (0,), (0, 3), (0,), (0, 2), (0, 4)]
    gradient = backend.project_vjp(*inputs, CAMERA, GSPLAT_MAIN, projection, ProjectionGradient(*projection[:4]))
    assert not gradient.cam_from_world_R.any() and not gradient.cam_from_world_t.any()


# --- parity ---


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("conventions", ALL_CONVENTIONS, ids=lambda c: c.name)
def test_backends_agree(fast_backend, conventions, dtype, rng):
    camera = make_camera(64, 48, fx=70, fy=75, cx=30, cy=20, rng=rng)
    gaussians = make_gaussians(rng, 200, depth=1.0)
    gaussians.means[:, :2] *= 2  # so that some are clamped and some are culled
    inputs = activated(gaussians)
    expected = REFERENCE.project(*inputs, camera, conventions)
    v = ProjectionGradient(*(rng.normal(size=field.shape) for field in expected[:4]))
    v_expected = REFERENCE.project_vjp(*inputs, camera, conventions, expected, v)
    is_visible = expected.radii[:, 0] > 0
    assert 100 < is_visible.sum() < 200
    slopes = (inputs[0] @ camera.cam_from_world_R.T + camera.cam_from_world_t)[is_visible]
    low, high = slope_limits(camera, conventions, slopes.dtype)
    is_clamped = (slopes[:, :2] / slopes[:, 2:] < low) | (slopes[:, :2] / slopes[:, 2:] > high)
    assert is_clamped.any(axis=0).all()

    cast = tuple(array.astype(dtype) for array in inputs)
    actual = fast_backend.project(*cast, camera, conventions)
    v_actual = fast_backend.project_vjp(*cast, camera, conventions, actual, as_dtype(v, dtype))
    if dtype == np.float64:
        assert_array_equal(actual.radii, expected.radii)
        assert_array_equal(actual.boxes, expected.boxes)
    forward = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_PROJECTION
    backward = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_GRADIENT
    for tolerance, pairs in (
        (forward, zip(actual[:4], expected[:4], strict=True)),
        (backward, zip(v_actual, v_expected, strict=True)),
    ):
        for a, e in pairs:
            assert a.dtype == (np.float64 if a is actual.conics else dtype)
            assert np.abs(e).max() > GRADIENT_FLOOR
            assert_allclose(a, e, rtol=0, atol=tolerance * np.abs(e).max())


# --- scales whose squares no float32 holds ---


@pytest.mark.parametrize("log_scale", [20.0, 43.0, 88.0, 200.0])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_enormous_gaussian_covers_everything(backend, dtype, log_scale):
    """With opacity 1/2 it is 1/2 everywhere. Its gradients are finite, that of the logit is 1/4 for each pixel."""
    camera = turned_camera()
    ball = balls(in_front_of(camera, [0.0, 0.0, 3.0]), [1.0], [0.5])
    model = Model(as_dtype(ball._replace(log_scales=np.full((1, 3), log_scale)), dtype))
    output, tape = SPLATTING.render(model, view_from(camera), Request(backend=backend))
    assert_allclose(output.alpha, 0.5, rtol=1e-6)
    v = SPLATTING.render_vjp(tape, np.zeros_like(output.image), np.ones_like(output.alpha)).gaussians
    assert all(np.isfinite(field).all() for field in v)
    assert_allclose(v.opacity_logits, 0.25 * 40 * 28, rtol=1e-5)


@pytest.mark.parametrize("exponent", [1, 7, 40])
def test_dividing_by_powers_of_two_changes_no_bit(exponent, rng):
    """The scene twice as large seen from twice as far has the same footprints, without the low-pass."""
    camera, gaussians = make_camera(rng=rng), make_gaussians(rng, 30, sh_degree=0, size=0.6)
    conventions = GSPLAT_MAIN._replace(eps2d=0.0, near_plane=1e-12, far_plane=np.inf)
    means, quats, scales, opacities = activated(gaussians)
    expected = REFERENCE.project(means, quats, scales, opacities, camera, conventions)
    factor = 2.0**exponent
    larger = camera._replace(cam_from_world_t=factor * camera.cam_from_world_t)
    found = REFERENCE.project(factor * means, quats, factor * scales, opacities, larger, conventions)
    assert np.count_nonzero(expected.radii[:, 0]) > 20
    for name in ("means2d", "conics", "opacities", "radii", "boxes"):
        assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    v = ProjectionGradient(rng.normal(size=(30, 2)), np.zeros(30), rng.normal(size=(30, 3)), rng.normal(size=30))
    v_expected = REFERENCE.project_vjp(means, quats, scales, opacities, camera, conventions, expected, v)
    v_found = REFERENCE.project_vjp(factor * means, quats, factor * scales, opacities, larger, conventions, found, v)
    for name in ("means", "scales"):
        assert_array_equal(factor * getattr(v_found, name), getattr(v_expected, name), err_msg=name)
    for name in ("quats", "opacities"):
        assert_array_equal(getattr(v_found, name), getattr(v_expected, name), err_msg=name)


def test_points_of_depths_are_seen_where_they_came_from():
    """The forward map, which shares no line, returns pixels and depths; a pixel without a depth has no point."""
    camera = turned_camera()
    depth = 2 + np.random.default_rng(0).uniform(size=(camera.height, camera.width))
    depth[3, 5] = 0
    points = unproject_depth(depth, camera)
    rows, xy, z = project_into_image(points, camera)
    y, x = np.nonzero(depth)
    assert len(rows) == len(points) == camera.height * camera.width - 1
    assert_allclose(xy, np.column_stack([x, y]) + 0.5, atol=1e-9)  # pixels; 1e-14 of focal lengths and rotations
    assert_allclose(z, depth[depth != 0], rtol=CLOSED_FORM)
