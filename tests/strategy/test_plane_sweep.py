"""Plane-sweep stereo: a textured plane at a known depth, seen by cameras whose photographs are computed exactly."""

import numpy as np
import pytest

from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.strategy.plane_sweep import (
    DepthMap,
    GrayView,
    are_confirmed,
    relative_rays,
    surface_points,
    sweep_planes,
    warp,
)
from scenes import make_camera

DEPTH = 4.0
INVERSE = np.linspace(1 / 8, 1 / 2, 31)  # 1 / 4 is the eleventh: a plane of its own


def textured(x, y):
    """Brightness of the plane z = DEPTH; its shortest wave is 12 pixels long."""
    return 0.5 + 0.15 * np.sin(3 * x + 1) * np.cos(2 * y) + 0.15 * np.sin(5 * y + 2 * x) + 0.1 * np.cos(4 * x - 3 * y)


def photograph(camera, brightness=textured):
    """The plane as the camera sees it: each ray, cut with z = DEPTH in the world frame."""
    xs, ys = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    directions = pinhole_rays(xs, ys, camera) @ camera.cam_from_world_R  # world frame
    t = (DEPTH - camera.center[2]) / directions[..., 2]
    points = camera.center + t[..., None] * directions
    return GrayView(camera, brightness(points[..., 0], points[..., 1]).astype(np.float32))


@pytest.fixture(scope="module")
def cameras():
    first = make_camera(48, 36, fx=50.0, fy=50.0)
    moved = first._replace(cam_from_world_t=np.array([-0.5, 0.0, 0.0]))
    R = rotation_matrices(np.array([[1.0, 0.02, -0.06, 0.03]]))[0]
    turned = first._replace(cam_from_world_R=R, cam_from_world_t=-R @ np.array([0.1, 0.6, 0.2]))
    return first, moved, turned


def test_a_neighbour_is_warped_onto_the_plane(cameras):
    """At the depth of the plane both photographs agree, up to bilinear interpolation; at another they do not."""
    view, *others = map(photograph, cameras)
    for other in others:
        rays = relative_rays(view.camera, other.camera)
        seen, is_inside = warp(rays, other, 1 / DEPTH)
        assert 0.5 < is_inside.mean() < 1
        assert np.abs(seen - view.gray)[is_inside].max() < 0.03
        assert np.abs(warp(rays, other, 1 / 5)[0] - view.gray)[is_inside].max() > 0.1


def test_a_shift_moves_by_the_disparity(cameras):
    """A camera 0.5 to the right sees a point at depth 4 further left by f b / d = 50 x 0.5 / 4 = 6.25 pixels."""
    first, moved, _ = cameras
    ramp = GrayView(moved, np.tile(np.arange(48, dtype=np.float32), (36, 1)))
    seen, is_inside = warp(relative_rays(first, moved), ramp, 1 / DEPTH)
    np.testing.assert_allclose(seen[10, 20], 20 - 6.25, atol=1e-4)
    assert not is_inside[:, :8].any() and is_inside[2:-2, 9:-2].all()  # half a window more


def test_the_depth_of_the_plane(cameras):
    view, *others = map(photograph, cameras)
    found = sweep_planes(view, others, INVERSE)
    counts = found.depths > 0
    assert counts.mean() > 0.7
    assert (np.abs(found.depths[counts] / DEPTH - 1) < 0.02).mean() > 0.9
    assert abs(np.median(found.depths[counts]) - DEPTH) < 0.01
    assert (found.correlations[counts] > 0.95).mean() > 0.9 and (found.correlations[~counts] == 0).all()


def test_what_neighbours_confirm_is_right(cameras):
    """Where the plane leaves the neighbours' images, depths beyond it win by chance; neighbours do not have these."""
    views = [photograph(camera) for camera in cameras]
    maps = [sweep_planes(view, [v for v in views if v is not view], INVERSE) for view in views]
    is_confirmed = are_confirmed(views[0], maps[0], list(zip(views[1:], maps[1:], strict=True)))
    wrong = np.abs(maps[0].depths / DEPTH - 1) > 0.05
    assert (wrong & (maps[0].depths > 0)).sum() > 20  # there is something to find
    assert is_confirmed.mean() > 0.5 and (wrong & is_confirmed).sum() <= 0.01 * is_confirmed.sum()


def test_between_two_planes_the_parabola_decides(cameras):
    """With 9 planes the nearest are at depths 3.76 and 4.57; the vertex lies between them."""
    view, *others = map(photograph, cameras)
    inverse = np.linspace(1 / 8, 1 / 2, 9) + 0.02
    depths = sweep_planes(view, others, inverse).depths
    nearest = min(abs(1 / inverse - DEPTH))
    assert abs(np.median(depths[depths > 0]) - DEPTH) < 0.4 * nearest


def test_gain_and_offset_change_nothing(cameras):
    view, *others = map(photograph, cameras)
    changed = [other._replace(gray=0.4 * other.gray + 0.3) for other in others]
    expected, found = (sweep_planes(view, these, INVERSE) for these in (others, changed))
    np.testing.assert_allclose(found.correlations, expected.correlations, atol=2e-3)
    assert ((found.depths > 0) == (expected.depths > 0)).mean() > 0.99


def test_what_has_no_depth(cameras):
    """A uniform wall, and a plane beyond the swept depths."""
    uniform = [photograph(camera, lambda x, y: 0.5 + 0.001 * np.sin(9 * x + y)) for camera in cameras]
    assert not sweep_planes(uniform[0], uniform[1:], INVERSE).depths.any()
    view, *others = map(photograph, cameras)
    beyond = sweep_planes(view, others, np.linspace(1 / 3, 1 / 2, 15)).depths
    assert (beyond > 0).mean() < 0.05


def test_the_better_half_of_the_neighbours_decides(cameras):
    """Of three neighbours one shows something else; the mean of the two better ones does not notice."""
    view, *others = map(photograph, cameras)
    rng = np.random.default_rng(0)
    blocked = GrayView(cameras[1], rng.random((36, 48)).astype(np.float32))
    found = sweep_planes(view, [*others, blocked], INVERSE).depths
    expected = sweep_planes(view, others, INVERSE).depths  # one neighbour of two: the better
    assert (found > 0).mean() > 0.45 and (expected > 0).mean() > 0.7
    np.testing.assert_allclose(np.median(found[found > 0]), DEPTH, rtol=0.01)


def test_a_neighbour_confirms_what_it_has_itself(cameras):
    """Camera 2 is half a unit to the right: column x of camera 1 is its column x - 6.25."""
    first, moved, _ = cameras
    views = [GrayView(camera, np.zeros((36, 48), np.float32)) for camera in (first, moved)]
    own = DepthMap(np.full((36, 48), DEPTH), np.ones((36, 48)))
    there = np.zeros((36, 48))
    there[:, 10] = DEPTH * 1.01  # within two per cent
    there[:, 12] = DEPTH * 1.03  # not
    found = are_confirmed(views[0], own, [(views[1], DepthMap(there, there))])
    assert list(np.flatnonzero(found.all(axis=0))) == [16] and found.sum() == 36
    assert not are_confirmed(views[0], own, []).any()


def test_points_of_pixels(cameras):
    """Pixel (34, 8) of a camera at the origin: (34.5 - 24) / 50 x 4 = 0.84, (8.5 - 18) / 50 x 4 = -0.76."""
    depths = np.full((36, 48), DEPTH)
    [point] = surface_points(cameras[0], depths, np.array([8]), np.array([34]))
    np.testing.assert_allclose(point, [0.84, -0.76, 4.0], atol=1e-12)
    [moved] = surface_points(cameras[1], depths, np.array([8]), np.array([34]))
    np.testing.assert_allclose(moved, [1.34, -0.76, 4.0], atol=1e-12)
