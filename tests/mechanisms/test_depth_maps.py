"""Depth maps: bilateral filter, reprojection there and back, agreement; against closed forms and traced truth."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_jacobian
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.mechanisms.depth_maps.bilateral import (
    BilateralWidths,
    joint_bilateral_depth,
    joint_bilateral_depth_vjp,
)
from minisplat_ref.mechanisms.depth_maps.normals import central_normals
from minisplat_ref.mechanisms.depth_maps.reprojection import (
    DepthView,
    Tolerances,
    agree,
    nearest_views,
    round_trip,
    sample_depth,
    unproject,
)
from minisplat_ref.mechanisms.oriented.thin_axis import angles_between
from minisplat_ref.reference.pinhole import pinhole, pinhole_rays
from minisplat_ref.types import Camera
from tolerances import CLOSED_FORM

REACH = 1e-9  # pixels: unprojecting and projecting a point 3 units away, a few dozen roundings times f


def camera_at(x, width=24, height=18):
    return Camera(np.eye(3), np.array([-x, 0.0, 0.0]), 20.0, 22.0, 12.0, 9.0, width, height)


def plane_depth(camera, normal, offset):
    """Camera z of the plane ``n . X = c`` at pixel centres."""
    rays = pinhole_rays(np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5, camera)
    normal = np.array(normal)
    return (offset - normal @ camera.center) / (rays @ normal)


SLANTED = ([0.2, -0.1, 1.0], 3.0)


# --- bilateral ---


def test_the_filter_by_hand():
    """Two grey pixels and a white one in a row, radius 1: the first is a mean of two, the third stays."""
    depth = np.array([[1.0, 2.0, 4.0]])
    image = np.array([[[0.0] * 3, [0.1] * 3, [1.0] * 3]])
    found = joint_bilateral_depth(depth, image, BilateralWidths(1, 1.0, 0.2))
    w = np.exp(-0.5) * np.exp(-0.03 / 0.08)
    far = np.exp(-0.5) * np.exp(-3 * 0.81 / 0.08)
    assert_allclose(found[0, 0], (1 + 2 * w) / (1 + w), rtol=CLOSED_FORM)
    assert_allclose(found[0, 1], (2 + w + 4 * far) / (1 + w + far), rtol=CLOSED_FORM)


def test_a_missing_depth_stays_missing_and_adds_nothing():
    depth = np.full((5, 6), 2.0)
    depth[2, 3] = 0
    found = joint_bilateral_depth(depth, np.zeros((5, 6, 3)))
    assert found[2, 3] == 0
    assert_allclose(found[depth > 0], 2.0, rtol=CLOSED_FORM)


def test_an_edge_of_the_photograph_keeps_the_depth_apart(rng):
    depth, image = np.ones((8, 8)), np.zeros((8, 8, 3))
    depth[:, 4:], image[:, 4:] = 2.0, 1.0
    noisy = depth * (1 + 0.01 * rng.standard_normal(depth.shape))
    kept = joint_bilateral_depth(noisy, image)
    blurred = joint_bilateral_depth(noisy, np.zeros_like(image))
    assert np.abs(kept - depth).max() < 0.02
    assert np.abs(kept - depth).std() < 0.5 * np.abs(noisy - depth).std()
    assert np.abs(blurred - depth).max() > 0.3


def test_the_filter_visits_every_pair_of_the_window(rng):
    """Against the sum as it is written, with a hole, and a window that is larger than the image in height."""
    depth, image = rng.uniform(1, 2, (4, 9)), rng.uniform(size=(4, 9, 3))
    depth[1, 2] = 0
    widths = BilateralWidths(4, 2.0, 0.5)
    ys, xs = np.indices(depth.shape)
    for y, x in ((0, 0), (1, 3), (3, 8)):
        is_near = (np.abs(ys - y) <= 4) & (np.abs(xs - x) <= 4) & (depth > 0)
        exponents = ((ys - y) ** 2 + (xs - x) ** 2) / 8 + np.sum((image - image[y, x]) ** 2, axis=2) / 0.5
        w = np.exp(-exponents) * is_near
        found = joint_bilateral_depth(depth, image, widths)[y, x]
        assert_allclose(found, np.sum(w * depth) / w.sum(), rtol=CLOSED_FORM)


def test_the_gradient_of_the_filter(rng):
    """It is linear where the holes stay, and the hole itself has no gradient."""
    depth, image = rng.uniform(1, 2, (4, 5)), rng.uniform(size=(4, 5, 3))
    depth[1, 2] = 0
    widths, has_depth = BilateralWidths(2, 1.0, 0.5), depth > 0

    def filtered(some):
        whole = depth.copy()
        whole[has_depth] = some
        return (joint_bilateral_depth(whole, image, widths),)

    def vjp(v):
        return (joint_bilateral_depth_vjp(depth, image, v, widths)[has_depth],)

    check_jacobian(filtered, vjp, (depth[has_depth],), names=("depth",))
    assert joint_bilateral_depth_vjp(depth, image, np.ones((4, 5)), widths)[1, 2] == 0


# --- reprojection ---


def test_points_of_a_plane_are_on_it():
    camera = camera_at(0.4)
    points = unproject(DepthView(plane_depth(camera, *SLANTED), camera))
    assert_allclose(points @ SLANTED[0], SLANTED[1], rtol=CLOSED_FORM)


def test_between_pixels_the_depth_of_a_plane_is_exact(rng):
    camera = camera_at(0.0)
    pixels = rng.uniform([0.6, 0.6], [23.4, 17.4], (50, 2))
    truth = 3.0 / (pinhole_rays(*pixels.T, camera) @ np.array(SLANTED[0]))
    assert_allclose(sample_depth(plane_depth(camera, *SLANTED), pixels), truth, rtol=10 * CLOSED_FORM)


@pytest.mark.parametrize("pixel", [(0.4, 5.0), (23.6, 5.0), (5.0, 0.4), (5.0, 17.6), (np.nan, 5.0), (3.9, 4.2)])
def test_nothing_is_known_outside_or_beside_a_hole(pixel):
    depth = plane_depth(camera_at(0.0), *SLANTED)
    depth[4, 4] = 0
    assert sample_depth(depth, np.array([pixel])) == 0


def test_there_and_back_on_a_plane():
    """Every pixel that the source sees returns to itself; it sees those that by hand fall between its pixels."""
    cameras = camera_at(0.0), camera_at(0.5)
    views = [DepthView(plane_depth(camera, *SLANTED), camera) for camera in cameras]
    trip = round_trip(*views)
    x, y = pinhole(unproject(views[0]).reshape(-1, 3) + cameras[1].cam_from_world_t, cameras[1]).T
    seen = ((x >= 0.5) & (x < 23.5) & (y >= 0.5) & (y < 17.5)).reshape(18, 24)
    away = np.minimum(np.abs(y - 0.5), np.abs(y - 17.5)).reshape(18, 24) > REACH  # rows fall on the border itself
    assert_array_equal(trip.is_seen[away], seen[away])
    assert 0.5 < trip.is_seen.mean() < 0.95
    assert trip.pixel_error[trip.is_seen].max() < REACH
    assert_allclose(trip.depth[trip.is_seen], views[0].depth[trip.is_seen], rtol=1e-11)
    assert np.all(np.isinf(trip.depth_error[~trip.is_seen]))


def test_a_wrong_depth_of_the_source_shows_as_much():
    """A source that shows a plane at 1.1 times its distance z says 1.1 z, moved by 0.05 parallax f / z."""
    cameras = camera_at(0.0), camera_at(0.5)
    views = DepthView(np.full((18, 24), 2.0), cameras[0]), DepthView(np.full((18, 24), 2.2), cameras[1])
    trip = round_trip(*views)
    assert_allclose(trip.depth_error[trip.is_seen], 0.1, rtol=1e-10)
    assert_allclose(trip.pixel_error[trip.is_seen], 20 * 0.5 * (1 / 2 - 1 / 2.2), rtol=1e-10)
    for pixels, agrees in ((0.44, False), (0.46, True)):  # 0.4545
        found = agree(views[0], views[1:], Tolerances(pixels=pixels, depth=1.0, n_views=1))
        assert found.n_agreeing.any() == agrees


def test_a_point_behind_the_reference_is_not_seen():
    """A source 3 units behind says that the surface is 1 before itself, which is 2 behind the reference."""
    behind = camera_at(0.0)._replace(cam_from_world_t=np.array([0.0, 0, 3]))
    reference, source = DepthView(np.full((18, 24), 2.0), camera_at(0.0)), DepthView(np.full((18, 24), 1.0), behind)
    assert not round_trip(reference, source).is_seen.any()
    assert round_trip(reference, source._replace(depth=np.full((18, 24), 5.0))).is_seen.any()


def test_what_views_agree_on():
    cameras = [camera_at(x) for x in (0.0, 0.3, -0.3, 0.1)]
    views = [DepthView(plane_depth(camera, *SLANTED), camera) for camera in cameras]
    wrong = views[3]._replace(depth=1.05 * views[3].depth)
    right = agree(views[0], [*views[1:3], wrong])
    assert right.n_agreeing.max() == 2
    kept = right.depth > 0
    assert 0.2 < kept.mean() < 0.9
    assert_array_equal(kept, right.n_agreeing == 2)
    assert_allclose(right.depth[kept], views[0].depth[kept], rtol=1e-11)
    moved = agree(views[0], [views[1]._replace(depth=1.004 * views[1].depth)], Tolerances(n_views=1))
    assert_allclose(np.median((moved.depth / views[0].depth)[moved.depth > 0]), 1.002, atol=1e-4)  # the mean of both
    assert agree(views[0], []).depth.max() == 0


@pytest.mark.parametrize(("factor", "agrees"), [(1.009, True), (0.991, True), (1.012, False), (0.985, False)])
def test_depths_agree_within_one_percent(factor, agrees):
    """Of the same camera, so that the pixel is right: a hundredth of the depth is the limit."""
    view = DepthView(np.full((18, 24), 4.0), camera_at(0.0))
    found = agree(view, [view._replace(depth=factor * view.depth)], Tolerances(n_views=1))
    assert (found.n_agreeing[5:-5, 5:-5] == agrees).all()


def test_outliers_do_not_agree_and_the_truth_does():
    made = make_scene("staircase", n_views=12, width=64, height=48, supersampling=1, n_points=50, test_every=0)
    rng = np.random.default_rng(0)
    views = [
        DepthView(np.where(rng.random(depth.shape) < 0.1, depth * rng.uniform(1.1, 1.5, depth.shape), depth), v.camera)
        for v, depth in zip(made.scene.train_views, made.train_depths, strict=True)
    ]
    near = nearest_views([view.camera for view in views], 4)
    kept, wrong = [], []
    for view, truth, sources in zip(views, made.train_depths, near, strict=True):
        is_kept = agree(view, [views[k] for k in sources], Tolerances()).depth > 0
        kept.append(is_kept[truth > 0])
        wrong.append((np.abs(view.depth - truth) > 0.05 * truth)[truth > 0])
    kept, wrong = np.concatenate(kept), np.concatenate(wrong)
    assert wrong.mean() > 0.08
    assert kept[~wrong].mean() > 0.25  # what other views see at all
    assert kept[wrong].mean() < 0.01


def test_the_nearest_views_look_the_same_way():
    turned = Camera(np.diag([-1.0, 1, -1]), np.zeros(3), 20, 20, 12, 9, 24, 18)
    cameras = [camera_at(0.0), camera_at(3.0), camera_at(1.0), turned]
    assert nearest_views(cameras, 2) == [[2, 1], [2, 0], [0, 1], []]


# --- normals ---


def test_normals_of_traced_depth_are_the_traced_normals():
    made = make_scene("facing-spheres", n_views=2, width=96, height=72, supersampling=1, n_points=50, test_every=0)
    view = made.scene.train_views[0]
    normals = central_normals(made.train_depths[0], view.camera) @ view.camera.cam_from_world_R
    ids = made.train_ids[0]
    same = (ids[1:-1, 1:-1] == ids[2:, 1:-1]) & (ids[1:-1, 1:-1] == ids[:-2, 1:-1])
    same &= (ids[1:-1, 1:-1] == ids[1:-1, 2:]) & (ids[1:-1, 1:-1] == ids[1:-1, :-2]) & (ids[1:-1, 1:-1] >= 0)
    angles = angles_between(normals[1:-1, 1:-1], made.train_normals[0][1:-1, 1:-1])[same]
    assert same.mean() > 0.4
    assert np.median(angles) < 0.2
    signed = np.sum(normals[1:-1, 1:-1] * made.train_normals[0][1:-1, 1:-1], axis=2)[same]
    assert np.median(signed) > 0.99  # towards the camera, both
