"""The dense start: which photographs are compared, which points stay, and whether they lie on what is there."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.reference.pinhole import pinhole
from minisplat_ref.strategy.plane_sweep import surface_points
from minisplat_ref.training.dense_start import (
    SPACING,
    choose_neighbours,
    choose_spread,
    densify_points,
    has_company,
    is_before_sparse,
)
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.types import view_from
from scenes import make_camera


@pytest.fixture(scope="module")
def synthetic():
    """A room that has two sparse points in a hundred."""
    made = make_scene("room", n_views=14, width=96, height=72, supersampling=2, n_points=2000)
    rows = np.arange(0, 2000, 50)
    views = tuple(
        view._replace(point_ids=np.flatnonzero(np.isin(rows, view.point_ids))) for view in made.scene.train_views
    )
    scene = made.scene._replace(
        points=made.scene.points[rows], point_colors=made.scene.point_colors[rows], train_views=views
    )
    return made._replace(scene=scene)


@pytest.fixture(scope="module")
def dense(synthetic):
    return densify_points(synthetic.scene)


def distances_to_surfaces(synthetic, points):
    """Of each point to the nearest of what the pixels of all photographs show, world units; the room is 4 wide."""
    shown = []
    for view, depths in zip(synthetic.scene.train_views, synthetic.train_depths, strict=True):
        rows, columns = np.nonzero(depths > 0)
        shown.append(surface_points(view.camera, depths, rows, columns))
    return cKDTree(np.concatenate(shown)).query(points)[0]


def test_points_lie_on_surfaces(synthetic, dense):
    points, colors = dense
    new = points[40:]
    np.testing.assert_array_equal(points[:40], synthetic.scene.points)
    np.testing.assert_array_equal(colors[:40], synthetic.scene.point_colors)
    assert len(new) > 200 and colors.dtype == np.uint8 and colors.shape == points.shape
    distances = distances_to_surfaces(synthetic, new)
    shuffled = distances_to_surfaces(synthetic, np.random.default_rng(0).permuted(new, axis=0))
    assert np.median(distances) < 0.05 and np.median(shuffled) > 0.08


def test_points_have_the_colours_of_the_photographs(synthetic, dense):
    """A new point has, in the photograph that shows it best, nearly the colour that the photograph has there."""
    points, colors = (array[40:] for array in dense)
    best = np.full(len(points), np.inf)
    for view in synthetic.scene.train_views:
        camera = view.camera
        seen = points @ camera.cam_from_world_R.T + camera.cam_from_world_t
        x, y = np.floor(pinhole(seen, camera)).T
        inside = (seen[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        shown = view.image[np.where(inside, y, 0).astype(int), np.where(inside, x, 0).astype(int)].astype(float)
        best = np.where(inside, np.minimum(best, np.abs(shown - colors).max(axis=1)), best)
    assert np.median(best) < 6


def test_without_sparse_points_there_is_a_start(synthetic):
    scene = synthetic.scene
    views = tuple(view._replace(point_ids=None) for view in scene.train_views)
    bare = scene._replace(points=np.zeros((0, 3)), point_colors=np.zeros((0, 3), np.uint8), train_views=views)
    points, _ = densify_points(bare)
    assert len(points) > 500
    assert np.median(distances_to_surfaces(synthetic, points)) < 0.08


def test_masked_pixels_give_no_points(synthetic):
    """Where every photograph but a strip is masked, all points lie in strips."""
    scene, strip = synthetic.scene, np.zeros((72, 96), bool)
    strip[:, 30:70] = True
    views = tuple(view._replace(mask=strip) for view in scene.train_views[:5])
    points = densify_points(scene._replace(train_views=views))[0][len(scene.points) :]
    in_a_strip = np.zeros(len(points), bool)
    for view in views:
        x = pinhole(points @ view.camera.cam_from_world_R.T + view.camera.cam_from_world_t, view.camera)[:, 0]
        in_a_strip |= (x > 29.9) & (x < 70.1)
    assert len(points) > 20 and in_a_strip.all()


def test_points_before_sparse_ones_by_hand():
    """A camera with f = 144 and 144 pixels: at depth 1, a pixel is 1 / 144 wide."""
    camera = make_camera(144, 144, fx=144.0, fy=144.0)
    view = view_from(camera)._replace(point_ids=np.array([0]))
    sparse = np.array([[0.0, 0, 4], [0.3, 0, 4]])  # the view shows only the first
    points = np.array([[0, 0, 3.5], [0, 0, 3.7], [0.9 / 144, 0, 1], [1.1 / 144, 0, 1], [0.3 / 2, 0, 2], [0, 0, 9]])
    assert list(is_before_sparse(points, [view], sparse)) == [True, False, True, False, False, False]
    assert not is_before_sparse(points, [view._replace(point_ids=None)], sparse).any()


def test_neighbours_by_hand():
    """Points at depth 10; a camera 1 to the side sees them under 5.7 degrees, one 0.1 to the side under 0.57."""
    points = np.column_stack([np.linspace(-0.1, 0.1, 9), np.zeros(9), np.full(9, 10.0)])
    camera = make_camera()

    def view_at(x, ids):
        moved = camera._replace(cam_from_world_t=np.array([-x, 0.0, 0.0]))
        return view_from(moved)._replace(point_ids=np.array(ids))

    all_ = list(range(9))
    views = [view_at(0, all_), view_at(0.1, all_), view_at(1, all_), view_at(20, all_), view_at(1.2, [])]
    assert choose_neighbours(views, points)[0] == [4, 2, 1]  # 63 degrees are too many; no tracks: what it sees counts
    bare = [view._replace(point_ids=None) for view in views]
    assert choose_neighbours(bare, np.zeros((0, 3)))[0] == [1, 2, 4, 3]  # by distance
    back = bare[1].camera._replace(cam_from_world_R=np.diag([-1.0, 1.0, -1.0]))
    assert choose_neighbours([bare[0], bare[1]._replace(camera=back)], np.zeros((0, 3))) == [[], []]


def test_spread_by_hand():
    """On a line; one point is there already at 0.2. The second is 0.8 from it, the third 1.8; then 4 is one from 3."""
    points = np.column_stack([[0.0, 1.0, 2.0, 4.0, 3.0, 9.0], np.zeros(6), np.zeros(6)])
    spacings = np.array([1.5, 0.5, 1.5, 1.5, 1.5, 1.5])
    assert list(choose_spread(points, spacings, np.array([[0.2, 0, 0]]))) == [1, 2, 3, 5]
    assert list(choose_spread(points, np.full(6, 1.5), np.zeros((0, 3)))) == [0, 2, 3, 5]
    assert len(choose_spread(points[:0], spacings[:0], points)) == 0


def test_company_by_hand():
    """Four points of a square of side 1, and one 9 away: within 4 spacings of 0.4 a corner has all others, at 1.41."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [9, 0, 0]])
    assert list(has_company(points, np.full(5, 0.4))) == [True, True, True, True, False]
    assert not has_company(points, np.full(5, 0.35)).any()  # 1.4 is less than the diagonal
    assert has_company(points, np.array([np.inf, 0.1, 0.1, 0.1, 2.3])).tolist() == [True, False, False, False, True]
    assert has_company(points[:3], np.zeros(3)).all()


def test_new_points_keep_their_distance(synthetic, dense):
    """None is nearer to an earlier one than the spacing of a pixel of the nearest photograph."""
    points, _ = dense
    views = synthetic.scene.train_views
    nearest = min((points @ v.camera.cam_from_world_R[2] + v.camera.cam_from_world_t[2]).min() for v in views)
    focal = max(view.camera.fx for view in synthetic.scene.train_views)
    gaps = np.linalg.norm(points[40:, None] - points[None], axis=2)
    gaps[np.arange(len(points) - 40), np.arange(40, len(points))] = np.inf
    assert gaps.min() > SPACING * max(nearest, 0.1) / focal


def test_adaptive_starts_with_them(synthetic, monkeypatch):
    scene = synthetic.scene
    points = np.concatenate([scene.points, scene.points[:5] + 0.5])
    colors = np.concatenate([scene.point_colors, scene.point_colors[5:10]])
    monkeypatch.setattr("minisplat_ref.training.initial_state.densify_points", lambda given: (points, colors))
    state = initial_state(scene, ADAPTIVE, 0)
    np.testing.assert_array_equal(state.gaussians.means, points.astype(np.float32))
    np.testing.assert_array_equal(state.gaussians.sh_dc[40:], state.gaussians.sh_dc[5:10])
    sparse = initial_state(scene, ADAPTIVE._replace(starts_densely=False), 0)
    assert len(sparse.gaussians.means) == 40
    for budget, expected in ((43, [*range(40), 40, 42, 44]), (30, range(40)), (99, range(45))):
        limited = initial_state(scene, configure(ADAPTIVE, budget=budget), 0)
        np.testing.assert_array_equal(limited.gaussians.means, points[list(expected)].astype(np.float32))
