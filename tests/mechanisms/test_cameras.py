"""Cameras as values: pixels against COLMAP's, Jacobians, inverses, folds; sigma points; affine projection."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.io.lens import COEFFICIENTS, Lens, lens_optics
from minisplat_ref.mechanisms.cameras import ray_footprints
from minisplat_ref.mechanisms.cameras.affine import (
    AffineCamera,
    downward,
    downward_vjp,
    orthographic,
    project,
    project_vjp,
    sun_slopes,
    with_affine,
)
from minisplat_ref.mechanisms.cameras.distortion import brown_limit, fisheye_limit
from minisplat_ref.mechanisms.cameras.models import (
    MODELS,
    PADDING,
    PERSPECTIVE,
    are_inside,
    check_optics,
    model_of,
    ray_table,
)
from minisplat_ref.mechanisms.cameras.models import (
    project_vjp as pixels_vjp,
)
from minisplat_ref.mechanisms.cameras.unscented import COVARIANCE_WEIGHTS, MEAN_WEIGHTS, sigma_points, unscented
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.reference.pinhole import pinhole, pinhole_jacobians, pinhole_rays
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.rendering.splatting import splat
from minisplat_ref.types import Camera, Optics, Primitives, ProjectionGradient
from scenes import ANTIALIASED, make_camera, turned_camera

PIXELS = 1e-10  # of images some hundred pixels wide: float64 and a few hundred operations
PARAMS = {
    "SIMPLE_RADIAL": (500, 320, 240, -0.1),
    "RADIAL": (500, 320, 240, -0.1, 0.02),
    "OPENCV": (500, 480, 320, 240, -0.1, 0.02, 0.003, -0.002),
    "FULL_OPENCV": (500, 480, 320, 240, -0.1, 0.02, 0.003, -0.002, 0.01, 0.02, 0.01, 0.003),
    "OPENCV_FISHEYE": (300, 290, 320, 240, 0.05, -0.02, 0.01, -0.001),
    "SIMPLE_RADIAL_FISHEYE": (300, 320, 240, 0.05),
    "RADIAL_FISHEYE": (300, 320, 240, 0.05, -0.01),
}
FOLDED = Optics("brown", (-0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def camera_of(model):
    n = COEFFICIENTS[model][1]
    fx, fy = PARAMS[model][0], PARAMS[model][n - 3]
    optics = lens_optics(Lens(model, PARAMS[model]), "a.png")
    return make_camera(640, 480, fx=fx, fy=fy)._replace(optics=optics)


def points_ahead(n=40):
    return np.random.default_rng(0).normal(size=(n, 3)) * [0.5, 0.4, 0.1] + [0, 0, 1]


def primitives(n=12):
    rng = np.random.default_rng(4)
    means = rng.uniform(-0.3, 0.3, (n, 3)) + np.array([0, 0, 3])
    return Primitives(means, rng.normal(size=(n, 4)), rng.uniform(0.03, 0.15, (n, 3)), rng.uniform(0.2, 0.9, n))


# --- lenses ---


def test_every_model_of_the_table_is_tested():
    assert set(PARAMS) == set(COEFFICIENTS)


@pytest.mark.parametrize("model", PARAMS)
def test_pixels_are_those_of_colmap_and_rays_lead_back(model):
    pycolmap, camera = pytest.importorskip("pycolmap"), camera_of(model)
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=PARAMS[model])
    x, functions = points_ahead(), model_of(camera)
    expected = np.array([theirs.img_from_cam(point[None])[0] for point in x])
    assert functions.is_seen(x, camera).all()
    assert_allclose(functions.project(x, camera), expected, atol=PIXELS)
    pixels = np.random.default_rng(1).uniform(0, 1, (60, 2)) * [640, 480]
    origins, directions = functions.rays(pixels, camera)
    assert not origins.any()
    assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=1e-14)
    assert_allclose(functions.project(directions, camera), pixels, atol=PIXELS)


@pytest.mark.parametrize(
    "camera", [camera_of("FULL_OPENCV"), camera_of("OPENCV_FISHEYE")], ids=lambda c: c.optics.model
)
def test_jacobians_are_derivatives_on_the_axis_too(camera):
    x, step = np.vstack([points_ahead(), [[0.0, 0.0, 2.0], [1e-12, 0.0, 1.0]]]), 1e-6
    functions = model_of(camera)
    numeric = [
        (functions.project(x + step * e, camera) - functions.project(x - step * e, camera)) / (2 * step)
        for e in np.eye(3)
    ]
    J = functions.jacobians(x, camera)
    assert_allclose(J, np.stack(numeric, axis=2), atol=1e-8 * np.abs(J).max())
    v = np.random.default_rng(2).normal(size=(len(x), 2))
    assert_allclose(pixels_vjp(functions, x, camera, v), np.einsum("nki,nk->ni", J, v))


def test_a_fisheye_by_hand_and_beyond_90_degrees():
    camera = make_camera(200, 200, fx=50.0, fy=50.0)._replace(optics=Optics("fisheye", (0.0, 0.0, 0.0, 0.0)))
    behind = np.array([[np.sin(2.0), 0.0, np.cos(2.0)]])  # 2 radians off the axis, z < 0
    functions = model_of(camera)
    assert_allclose(functions.project(behind, camera), [[200.0, 100.0]])
    assert_allclose(functions.rays(np.array([[200.0, 100.0]]), camera)[1], behind, atol=1e-12)
    assert functions.is_seen(behind, camera) and functions.depths(3 * behind) == pytest.approx(3)


def test_brown_by_hand():
    """At the slope (0.5, 0): s = 1/4, so x' = 0.5 (1 + 0.25 k1) + 3 p2 / 4 and y' = p1 / 4."""
    camera = make_camera(100, 100, fx=10.0, fy=20.0)._replace(
        optics=Optics("brown", (0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 0.1))
    )
    found = MODELS["brown"].project(np.array([[1.0, 0.0, 2.0]]), camera)
    assert_allclose(found, [[50 + 10 * (0.55 + 0.075), 50 + 20 * 0.05]])


def test_without_coefficients_a_lens_is_the_pinhole():
    camera, x = make_camera(64, 48), points_ahead()
    bare = camera._replace(optics=Optics("brown", (0.0,) * 8))
    limits = np.full(2, np.inf)
    assert_array_equal(model_of(bare).project(x, bare), PERSPECTIVE.project(x, camera))
    assert_allclose(PERSPECTIVE.project(x, camera), pinhole(x, camera), rtol=1e-14)
    assert_allclose(model_of(bare).jacobians(x, bare), pinhole_jacobians(x, camera, -limits, limits), atol=1e-12)
    table = ray_table(bare).reshape(48, 3, 64 + PADDING)
    xs, ys = np.arange(64) + 0.5, np.arange(48) + 0.5
    expected = pinhole_rays(xs[None], ys[:, None], camera)
    expected /= np.linalg.norm(expected, axis=2, keepdims=True)
    assert_allclose(np.moveaxis(table[:, :, :64], 1, 2), expected, atol=1e-14)
    assert_array_equal(table[:, :, 64:], np.repeat(table[:, :, 63:64], PADDING, axis=2))


def test_where_lenses_fold():
    """r (1 - r^2 / 2) grows up to r^2 = 2/3; t (1 - t^2 / 10) up to t^2 = 10/3."""
    assert brown_limit(FOLDED.coefficients) == pytest.approx(2 / 3)
    assert fisheye_limit((-0.1, 0.0, 0.0, 0.0)) == pytest.approx(np.sqrt(10 / 3))
    camera = make_camera(64, 48)._replace(optics=FOLDED)
    x = np.array([[0.81, 0.0, 1.0], [0.82, 0.0, 1.0], [0.1, 0.0, -1.0]])
    assert model_of(camera).is_seen(x, camera).tolist() == [True, False, False]
    for refuse in (check_optics, ray_table):
        with pytest.raises(InputError, match=r"folds inside the image: no ray reaches pixel"):
            refuse(camera)
    check_optics(camera._replace(fx=80.0, fy=80.0))


def test_at_its_limit_a_fisheye_of_all_coefficients_stops_growing():
    k = (0.05, -0.02, -0.01, -0.003)
    limit = fisheye_limit(k)
    camera = make_camera(200, 200, fx=50.0, fy=50.0)._replace(optics=Optics("fisheye", k))
    angles = limit + np.array([-1e-3, 0.0, 1e-3])
    radii = MODELS["fisheye"].project(np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)]), camera)[:, 0]
    assert limit < 3 and radii[1] > max(radii[0], radii[2])


def test_distances_have_the_gradient_along_the_ray():
    x, v = np.array([[1.0, -2.0, 2.0]]), np.array([6.0])
    assert_allclose(MODELS["fisheye"].depths_vjp(x, v), [[2.0, -4.0, 4.0]])
    assert_allclose(PERSPECTIVE.depths_vjp(x, v), [[0.0, 0.0, 6.0]])


def test_what_is_inside_of_an_image_by_hand():
    """An equidistant fisheye of f = 10 has 45 degrees at 7.9 pixels from the middle of 20 x 20, and 60 at 10.5.

    The pinhole has 45 degrees at 10, on the border, and 44 degrees at 9.7; both are blind behind, the fisheye from 57
    degrees on. The world is shifted by 3 along z.
    """
    angles = np.radians([0, 44, 45, 57, 58, 100, 180])
    points = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles) - 3])
    camera = Camera(np.eye(3), np.array([0, 0, 3.0]), 10, 10, 10, 10, 20, 20)
    fisheye = camera._replace(optics=Optics("fisheye", (0.0,) * 4))
    assert are_inside(points, camera).tolist() == [True, True, False, False, False, False, False]
    assert are_inside(points, fisheye).tolist() == [True, True, True, True, False, False, False]
    upright = points[:, [1, 0, 2]]
    assert_array_equal(are_inside(upright, fisheye), are_inside(points, fisheye))


def test_unknown_optics_are_refused():
    with pytest.raises(InputError, match="'sphere' are not known: choose from brown"):
        model_of(make_camera()._replace(optics=Optics("sphere")))
    with pytest.raises(InputError, match=r"a\.png: camera model FOV is not one of SIMPLE_RADIAL"):
        lens_optics(Lens("FOV", (1.0, 1.0, 0.0, 0.0, 0.5)), "a.png")


# --- the unscented transform ---


def test_sigma_points_have_the_moments_of_the_gaussian():
    p = primitives(3)
    eigenvalues, axes = np.linalg.eigh(covariances(p.quats, p.scales))
    points = sigma_points(p.means, axes * np.sqrt(eigenvalues)[:, None, :])
    assert MEAN_WEIGHTS[0] == pytest.approx(-99) and COVARIANCE_WEIGHTS[0] == pytest.approx(-96.01)
    assert MEAN_WEIGHTS.sum() == pytest.approx(1)
    assert_allclose(np.einsum("k,nki->ni", MEAN_WEIGHTS, points), p.means, atol=1e-12)
    offsets = points - p.means[:, None]
    found = np.einsum("k,nki,nkj->nij", COVARIANCE_WEIGHTS, offsets, offsets)
    assert_allclose(found, covariances(p.quats, p.scales), atol=1e-13)


def test_far_away_the_transform_is_the_first_order_expansion():
    camera = make_camera(400, 300, fx=1000.0, fy=1000.0)
    x, axes = np.array([[0.4, -0.3, 5.0]]), 1e-4 * np.linalg.qr(np.random.default_rng(0).normal(size=(1, 3, 3)))[0]
    axes[:, :, 0] *= 4
    mean, covariance, is_seen = unscented(x, axes, PERSPECTIVE, camera)
    J = PERSPECTIVE.jacobians(x, camera)
    expected = J @ axes @ np.swapaxes(axes, 1, 2) @ np.swapaxes(J, 1, 2)
    assert is_seen.all()
    assert_allclose(mean, PERSPECTIVE.project(x, camera), atol=1e-5)
    assert_allclose(covariance, expected, rtol=1e-4)
    assert not unscented(np.array([[0.0, 0.0, 0.1]]), np.eye(3)[None], PERSPECTIVE, camera)[2].any()


# --- affine cameras ---


def affine_camera():
    A = np.array([[9.0, 1.0, 0.5], [-0.5, 8.0, 2.0], [0.2, -0.1, 1.5]])
    return AffineCamera(A, np.array([12.0, 1.0, -7.0]), 24, 18)


@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, ANTIALIASED], ids=lambda c: c.name)
def test_the_affine_projection_is_exact_and_so_is_its_gradient(conventions):
    p, camera, rng = primitives(), affine_camera(), np.random.default_rng(5)
    A, b = camera.cam_from_world_R, camera.cam_from_world_t
    found = project(*p, camera, conventions)
    u = p.means @ A.T + b
    is_seen = found.radii[:, 0] > 0
    assert is_seen.sum() > 6 and (u[is_seen, 2] < 0).any()  # an altitude below zero is seen
    assert_allclose(found.depths[is_seen], u[is_seen, 2])
    Sigma = A[:2] @ covariances(p.quats, p.scales) @ A[:2].T + conventions.eps2d * np.eye(2)
    Q = np.linalg.inv(Sigma)[is_seen]
    assert_allclose(found.conics[is_seen], np.column_stack([Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 1]]), rtol=1e-11)
    v = ProjectionGradient(*(rng.normal(size=field.shape) for field in found[:4]))

    def function(means, quats, scales, opacities, A, b):
        moved = camera._replace(cam_from_world_R=A, cam_from_world_t=b)
        return project(means, quats, scales, opacities, moved, conventions)[:4]

    gradient = project_vjp(*p, camera, conventions, found, v)
    names = ("means", "quats", "scales", "opacities", "A", "b")
    check_inner_products(function, gradient, (*p, A, b), v, rng, names=names)


def test_a_pinhole_sees_what_is_in_front_however_near():
    camera = make_camera()
    assert model_of(camera).is_seen(np.array([[0, 0, 1e-6], [0, 0, 0.0], [0, 0, -1.0]]), camera).tolist() == [1, 0, 0]


def test_what_lies_behind_a_ray_or_beyond_the_fold_is_not_hit():
    """A Gaussian moved behind the camera has no alpha; one beyond the fold would have a pixel in the image."""
    camera, p = make_camera(64, 48), primitives()
    found = ray_footprints.project(p, camera, GSPLAT_MAIN)
    ids, centers = np.arange(len(p.means)), np.array([[32.5, 24.5]])
    assert ray_footprints.hit(found, ids, centers).unclamped.max() > 0.01
    behind = found._replace(positions=-found.positions)
    assert not ray_footprints.hit(behind, ids, centers).unclamped.any()
    folded = make_camera(64, 48, fx=80.0, fy=80.0)._replace(optics=FOLDED)
    wide = p._replace(means=np.tile([[3.6, 0, 3.0]], (12, 1)))  # r = 1.2, of which the pixel is that of 0.336
    assert model_of(folded).project(wide.means, folded)[0, 0] < 64
    assert not ray_footprints.project(wide, folded, GSPLAT_MAIN).radii.any()
    assert ray_footprints.project(p, folded, GSPLAT_MAIN).radii.any()


def test_planes_cull_by_parallel_rays_only_where_the_camera_has_them():
    """Behind the near plane nothing is seen; a satellite's altitudes are depths of both signs."""
    camera, p = make_camera(64, 48, fx=20.0, fy=20.0), primitives()
    behind = p._replace(means=p.means - [0, 0, 6])
    assert project(*p, orthographic(camera, GSPLAT_MAIN), GSPLAT_MAIN).radii.all()
    assert not project(*behind, orthographic(camera, GSPLAT_MAIN), GSPLAT_MAIN).radii.any()
    open_ended = orthographic(camera, GSPLAT_MAIN)._replace(near=-np.inf)
    assert project(*behind, open_ended, GSPLAT_MAIN).radii.all()


def satellite_camera():
    return turned_camera()._replace(fx=30.0, fy=20.0, optics=Optics("affine", (0.3, 48.0, 0.0, 0.0, 0.0)))


def test_affine_optics_by_hand():
    """v is sheared by 0.3 of x: of (1, 2, 5) it is 20 (2 + 0.3), and its ray has the direction of the axis."""
    camera, x = satellite_camera(), np.array([[1.0, 2.0, 5.0]])
    model, center = model_of(camera), np.array([camera.cx, camera.cy])
    pixels = model.project(x, camera)
    assert_allclose(pixels, [center + np.array([30, 20 * 2.3])], atol=1e-12)
    assert_allclose(model.jacobians(x, camera), [[[30, 0, 0], [6, 20, 0]]], atol=1e-12)
    origins, directions = model.rays(pixels, camera)
    assert_allclose(origins + 5 * directions, x, atol=1e-12)
    check_optics(camera)
    with pytest.raises(InputError, match="train with --recipe satellite"):
        ray_footprints.project(primitives(), camera, GSPLAT_MAIN)


def test_downward_has_the_pixels_of_affine_optics_and_the_altitude():
    """The altitude is that of the world, 48 m a unit, however the camera is turned and moved."""
    camera, p = satellite_camera(), primitives()
    found = downward(camera)
    u = p.means @ found.cam_from_world_R.T + found.cam_from_world_t
    x = p.means @ camera.cam_from_world_R.T + camera.cam_from_world_t
    assert_allclose(u[:, :2], model_of(camera).project(x, camera), atol=1e-12)
    assert_allclose(u[:, 2], -48 * p.means[:, 2], atol=1e-12)
    rng = np.random.default_rng(0)
    v_A, v_b, d_R, d_t = (rng.normal(size=shape) for shape in ((3, 3), 3, (3, 3), 3))
    v_R, v_t = downward_vjp(camera, v_A, v_b)
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    moved = downward(camera._replace(cam_from_world_R=R + d_R, cam_from_world_t=t + d_t))  # it is linear
    change = np.sum(v_A * (moved[0] - found[0])) + v_b @ (moved[1] - found[1])
    assert np.sum(v_R * d_R) + v_t @ d_t == pytest.approx(change, rel=1e-12)


def test_the_sun_gains_a_metre():
    """Towards (3, -4, 2), 48 m a unit: a metre up is 1.5 m and -2 m beside; without a sun nothing."""
    camera = satellite_camera()
    shining = camera._replace(optics=Optics("affine", (0.3, 48.0, 3.0, -4.0, 2.0)))
    assert_allclose(sun_slopes(shining), np.array([1.5, -2, 1]) / 48, rtol=1e-14)
    assert not sun_slopes(camera).any() and not sun_slopes(camera._replace(optics=None)).any()


def test_orthographic_is_affine_and_draws_on_every_backend():
    camera = turned_camera()
    parallel = camera._replace(optics=Optics("orthographic"))
    affine, p = orthographic(camera, GSPLAT_MAIN), primitives()
    x = p.means @ camera.cam_from_world_R.T + camera.cam_from_world_t
    u = p.means @ affine.cam_from_world_R.T + affine.cam_from_world_t
    model = model_of(parallel)
    assert_allclose(model.project(x, parallel), u[:, :2], atol=1e-12)
    assert_allclose(model.depths(x), u[:, 2], atol=1e-12)
    assert_allclose(affine.direction, camera.cam_from_world_R[2], atol=1e-12)
    origins, directions = model.rays(model.project(x, parallel), parallel)
    assert_allclose(origins + x[:, 2:] * directions, x, atol=1e-12)
    p = p._replace(means=(p.means - [0, 0, 3] + [0, 0, 2]) @ camera.cam_from_world_R)
    images = [
        splat(
            p, lambda _: np.ones((12, 3)), camera, np.zeros(3), GSPLAT_MAIN, with_affine(b, orthographic)
        ).output.image
        for b in (REFERENCE, CPU)
    ]
    assert images[0].max() > 0.1
    assert_allclose(images[1], images[0], atol=1e-9)
    with pytest.raises(InputError, match="needs an affine camera"):
        with_affine(CPU).project(*p, camera, GSPLAT_MAIN)
