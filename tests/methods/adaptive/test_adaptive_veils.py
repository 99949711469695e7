"""Veils: Gaussians before the sparse points of a photograph go, and those beside a camera; nothing else does."""

import numpy as np
import pytest

from minisplat_ref.methods.adaptive import veils
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.line_of_sight import SightLines
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.recipe_settings import settings_of
from minisplat_ref.training.schedule import does
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Gaussians, Scene, view_from
from scenes import make_camera

CAMERA = make_camera(33, 33, fx=30.0, fy=30.0)
POINTS = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0]])
SETTINGS = {"max_share_before": 0.5, "min_weight_before": 0.1, "clearance": 0.5, "min_share_counted": 0.5, "start": 500}


def gaussians(means, opacities, scale=0.1):
    o, n = np.array(opacities, np.float64), len(means)
    return Gaussians(
        np.array(means, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.broadcast_to(np.log(scale), (n, 3)).astype(np.float32),
        np.log(o / (1 - o)).astype(np.float32),
        np.zeros((n, 3), np.float32),
        np.zeros((n, 0, 3), np.float32),
    )


def setting(model, n_views=1, step=600):
    views = tuple(
        view_from(CAMERA)._replace(point_ids=np.array([0, 1]), name=str(i), view_id=i) for i in range(n_views)
    )
    scene = Scene("hand", views, (), POINTS, np.zeros((2, 3), np.uint8), np.zeros(3), 1.0)
    state = TrainState(
        model, zero_moments(model), step=step, view_order=[], rng=np.random.default_rng(0), stats={}, shared={},
        shared_adam=zero_moments({}),
    )  # fmt: skip
    return state, Iteration(scene, views[0], None, None, None, RenderSettings(), step=step)


def test_a_veil_goes_and_surfaces_stay():
    """On the rays of two points: a veil before the first, surfaces at both, and a Gaussian on no ray."""
    model = gaussians([[0, 0, 2], [0, 0, 5], [1, 0, 5], [-1, 0, 2]], [0.4, 0.9, 0.9, 0.9])
    state, iteration = setting(model)
    before, all_ = veils.weigh_sight_lines(state, iteration)
    np.testing.assert_allclose(before, [0.4, 0, 0, 0], rtol=1e-5)
    np.testing.assert_allclose(all_, [0.4, 0.54, 0.9, 0], rtol=1e-4)
    note = veils.remove_veils(state, iteration, **SETTINGS)
    assert note == "1 stood before points that photographs show, 0 beside cameras"
    np.testing.assert_array_equal(state.gaussians.means, model.means[1:])
    assert len(state.adam.first.means) == 3


@pytest.mark.parametrize(
    ("opacity", "changes"),
    [(0.4, {"start": 600}), (0.09, {}), (0.4, {"min_weight_before": 0.5}), (0.4, {"max_share_before": 1.0})],
)
def test_what_stays(opacity, changes):
    """Before its time; below the least weight, the default one or another; and if all shares are allowed."""
    state, iteration = setting(gaussians([[0, 0, 2], [0, 0, 5]], [opacity, 0.9]))
    veils.remove_veils(state, iteration, **(SETTINGS | changes))
    assert len(state.gaussians.means) == 2


def test_a_surface_that_covers_two_rays_is_weighed_on_both():
    """A Gaussian at 4 lies before the point at 5 and behind the one at 3.5: half of its weight is before."""
    model = gaussians([[0.4, 0, 4.0]], [0.8], scale=2.0)
    points = np.array([[0.0, 0, 5], [0.56, 0, 3.5]])  # both 0.8 from the axis of the Gaussian's image, one on each side
    state, iteration = setting(model)
    iteration = iteration._replace(scene=iteration.scene._replace(points=points))
    before, all_ = veils.weigh_sight_lines(state, iteration)
    assert before[0] == pytest.approx(all_[0] / 2, rel=0.02)
    veils.remove_veils(state, iteration, **(SETTINGS | {"max_share_before": 0.55}))
    assert len(state.gaussians.means) == 1
    veils.remove_veils(state, iteration, **(SETTINGS | {"max_share_before": 0.45}))
    assert len(state.gaussians.means) == 0


def test_views_without_tracks_say_nothing():
    state, iteration = setting(gaussians([[0, 0, 2]], [0.9]))
    blind = tuple(view._replace(point_ids=None) for view in iteration.scene.train_views)
    veils.remove_veils(state, iteration._replace(scene=iteration.scene._replace(train_views=blind)), **SETTINGS)
    assert len(state.gaussians.means) == 1


def test_of_many_views_others_are_looked_at_each_time(monkeypatch):
    monkeypatch.setattr(veils, "VEIL_VIEWS_MAX", 2)
    seen = []
    real = veils.trace_sight_lines
    monkeypatch.setattr(veils, "trace_sight_lines", lambda m, view, *a: seen.append(view.name) or real(m, view, *a))
    for step in (600, 700, 800):
        veils.weigh_sight_lines(*setting(gaussians([[0, 0, 2]], [0.4]), n_views=5, step=step))
    assert seen == ["0", "3", "1", "4", "2"]  # every third, from 600 / 100 modulo 3 on


def test_adaptive_does_it_every_hundred_iterations():
    [event] = [event for event in ADAPTIVE.events if does(event, veils.remove_veils)]
    assert [step for step in range(1, 401) if event.is_due(step)] == [200, 300, 400]
    settings = settings_of(ADAPTIVE)
    assert {name: settings[name] for name in SETTINGS} == SETTINGS


def test_more_than_half_of_the_weight_and_a_tenth_of_a_pixel(monkeypatch):
    """Of all weight 1 / 2 stays and 0.51 goes; of what is wholly before points 0.1 goes and 0.099 stays."""
    model = gaussians([[i, 0, 9] for i in range(6)], [0.5] * 6)
    before, all_ = np.array([0.5, 0.51, 0.099, 0.1, 0.0, 3.0]), np.array([1.0, 1.0, 0.099, 0.1, 0.0, 6.1])
    monkeypatch.setattr(veils, "weigh_sight_lines", lambda *_: (before, all_))
    state, iteration = setting(model)
    assert veils.remove_veils(state, iteration, **SETTINGS).startswith("2 stood")
    assert list(state.gaussians.means[:, 0]) == [0, 2, 4, 5]


@pytest.mark.parametrize(("step", "n_left"), [(499, 2), (500, 2), (501, 1)])
def test_nothing_goes_until_the_start(step, n_left):
    state, iteration = setting(gaussians([[0, 0, 2], [0, 0, 5]], [0.4, 0.9]), step=step)
    veils.remove_veils(state, iteration, **SETTINGS)
    assert len(state.gaussians.means) == n_left


@pytest.mark.parametrize(("depth", "is_before"), [(4.49, True), (4.51, False)])
def test_a_tenth_of_the_depth_belongs_to_the_surface(depth, is_before):
    """The point is at depth 5."""
    before, all_ = veils.weigh_sight_lines(*setting(gaussians([[0, 0, depth]], [0.4])))
    assert all_[0] == pytest.approx(0.4, rel=1e-4)
    assert before[0] == (all_[0] if is_before else 0)


def test_weights_add_up_over_rays_and_views(monkeypatch):
    """Two views with the same lines: twice 0.25 + 0.5 of Gaussian 0, of which 0.5 is before, and twice 1 of 2."""
    lines = SightLines(
        np.array([0, 0, 2]), np.array([0, 1, 1]), np.array([0.25, 0.5, 1.0]), np.array([False, True, False]), None
    )
    monkeypatch.setattr(veils, "trace_sight_lines", lambda *_: lines)
    before, all_ = veils.weigh_sight_lines(*setting(gaussians([[0, 0, 9]] * 4, [0.4] * 4), n_views=2))
    np.testing.assert_array_equal(before, [1.0, 0, 0, 0])
    np.testing.assert_array_equal(all_, [1.5, 0, 2.0, 0])


@pytest.mark.parametrize(
    ("n", "step", "expected"),
    [
        (8, 700, range(8)),
        (9, 600, range(0, 9, 2)),
        (9, 700, range(1, 9, 2)),
        (16, 799, range(1, 16, 2)),
        (17, 800, range(2, 17, 3)),
        (17, 900, range(0, 17, 3)),
    ],
)
def test_eight_views_at_most_evenly_spread(monkeypatch, n, step, expected):
    """Of 9 every second, of 17 every third; which is the first changes every 100 iterations, and begins again.

    Views without tracks, of which there is one before each other, do not count.
    """
    lines = SightLines(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0, bool), np.zeros(0))
    seen = []
    monkeypatch.setattr(veils, "trace_sight_lines", lambda _, view, *__: seen.append(int(view.name)) or lines)
    state, iteration = setting(gaussians([[0, 0, 9]], [0.4]), n_views=n, step=step)
    untracked = view_from(CAMERA, name="-1")
    views = [view for tracked in iteration.scene.train_views for view in (untracked, tracked)]
    veils.weigh_sight_lines(state, iteration._replace(scene=iteration.scene._replace(train_views=views)))
    assert seen == list(expected)


@pytest.mark.parametrize(
    ("n", "step", "expected"),
    [(256, 700, range(256)), (257, 700, range(1, 257, 2)), (513, 800, range(2, 513, 3)), (513, 900, range(0, 513, 3))],
)
def test_256_rays_of_a_view_at_most_evenly_spread(monkeypatch, n, step, expected):
    lines = SightLines(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0, bool), np.zeros(0))
    seen = []
    monkeypatch.setattr(veils, "trace_sight_lines", lambda _, view, *__: seen.extend(view.point_ids) or lines)
    state, iteration = setting(gaussians([[0, 0, 9]], [0.4]), step=step)
    views = [iteration.scene.train_views[0]._replace(point_ids=np.arange(n))]
    veils.weigh_sight_lines(state, iteration._replace(scene=iteration.scene._replace(train_views=views)))
    assert seen == list(expected)


# --- beside cameras ---

AROUND = np.concatenate([POINTS, [[-1.0, 0.0, 5.0]]])  # the third nearest point is at sqrt(26): the ball has 2.55


def setting_with_a_ball(model, step=600):
    state, iteration = setting(model, step=step)
    return state, iteration._replace(scene=iteration.scene._replace(points=AROUND))


@pytest.mark.parametrize(("x", "scale", "n_left"), [(-2.5, 1e-3, 1), (-2.6, 1e-3, 2), (-2.6, 0.5, 2), (-2.6, 0.6, 1)])
def test_a_gaussian_beside_a_camera_goes(x, scale, n_left):
    """Outside its image, on no line of sight: 2.55^2 = 6.5 is above 2.5^2 = 6.25, 2.6^2 = 6.76 above 6.5 + 0.5^2."""
    state, iteration = setting_with_a_ball(gaussians([[x, 0, 0], [0, 0, 5]], [0.9, 0.9], scale=[[scale], [0.1]]))
    before, all_ = veils.weigh_sight_lines(state, iteration)
    assert before[0] == all_[0] == 0
    note = veils.remove_veils(state, iteration, **SETTINGS)
    assert note == f"0 stood before points that photographs show, {2 - n_left} beside cameras"
    assert len(state.gaussians.means) == len(state.adam.first.means) == n_left


@pytest.mark.parametrize(("changes", "n_left"), [({}, 1), ({"clearance": 0.0}, 2), ({"start": 600}, 2)])
def test_what_stays_beside_a_camera(changes, n_left):
    state, iteration = setting_with_a_ball(gaussians([[-1, 0, 0], [0, 0, 5]], [0.9, 0.9]))
    veils.remove_veils(state, iteration, **(SETTINGS | changes))
    assert len(state.gaussians.means) == n_left


def test_a_veil_beside_a_camera_is_counted_once():
    state, iteration = setting_with_a_ball(gaussians([[0, 0, 2], [-1, 0, 0], [0, 0, 5]], [0.4, 0.4, 0.9]))
    note = veils.remove_veils(state, iteration, **SETTINGS)
    assert note == "1 stood before points that photographs show, 1 beside cameras"
    assert len(state.gaussians.means) == 1


@pytest.mark.parametrize(("spacing", "stays"), [(2.3, True), (2.7, False)])
def test_a_wall_with_few_points_beside_a_camera(spacing, stays):
    """A wall at 1 with points on a square grid: the nearest are at sqrt(1 + s^2 / 2), which is 2 with s = 2.45."""
    x, y = spacing * (np.mgrid[-4:4, -4:4] + 0.5)
    points = np.column_stack([x.ravel(), np.full(64, -1.0), y.ravel()])
    wall = gaussians([[0, -1, 0], [0.5, -1, 3]], [0.9, 0.9], scale=np.array([[0.5, 1e-3, 0.5]] * 2))
    state, iteration = setting(wall)
    veils.remove_veils(state, iteration._replace(scene=iteration.scene._replace(points=points)), **SETTINGS)
    assert (len(state.gaussians.means) == 2) == stays


def masked(iteration, *masks):
    """Return the iteration with a mask, or None, for each of its views, and no tracks."""
    views = zip(iteration.scene.train_views, masks, strict=True)
    views = tuple(v._replace(mask=mask, image=np.zeros((33, 33, 3), np.uint8), point_ids=None) for v, mask in views)
    return iteration._replace(scene=iteration.scene._replace(train_views=views))


LEFT = np.broadcast_to(np.arange(33) < 17, (33, 33))
SIDES = [[-1.0, 0, 5], [1.0, 0, 5]]  # in the images, 6 pixels to the left and to the right of the middle


def test_what_masks_leave_out_goes():
    """Of two Gaussians, the one on the right is where nothing counts; with the least share 0 both stay."""
    state, iteration = setting(gaussians(SIDES, [0.9, 0.9]))
    iteration = masked(iteration, LEFT)
    note = veils.remove_veils(state, iteration, **(SETTINGS | {"min_share_counted": 0.0}))
    assert note == "0 stood before points that photographs show, 0 beside cameras"
    note = veils.remove_veils(state, iteration, **SETTINGS)
    assert note == "0 stood before points that photographs show, 0 beside cameras, 1 outside the masks"
    np.testing.assert_array_equal(state.gaussians.means, np.float32(SIDES[:1]))


@pytest.mark.parametrize(("masks", "n_left"), [((~LEFT, LEFT, LEFT), 1), ((LEFT, ~LEFT, None), 2), ((None,) * 3, 2)])
def test_what_most_photographs_count_stays(masks, n_left):
    """Someone who stands before a wall in one photograph of three does not take the wall away; two of three do."""
    state, iteration = setting(gaussians(SIDES, [0.9, 0.9]), n_views=3)
    veils.remove_veils(state, masked(iteration, *masks), **SETTINGS)
    assert len(state.gaussians.means) == n_left


@pytest.mark.parametrize(("inside", "is_out"), [(0.5, False), (0.49, True)])
def test_half_of_the_weight_and_a_tenth_of_a_pixel_outside_masks(monkeypatch, inside, is_out):
    weights = np.array([inside, 0.0, 0.0]), np.array([1.0, 0.1, 0.099])
    monkeypatch.setattr(veils, "collect_mask_weights", lambda *_: weights)
    state, iteration = setting(gaussians([[0, 0, 9]] * 3, [0.5] * 3))
    found = veils.are_outside_masks(state, masked(iteration, LEFT), 0.5, 0.1)
    np.testing.assert_array_equal(found, [is_out, True, False])


def test_of_many_masks_others_are_looked_at_each_time(monkeypatch):
    monkeypatch.setattr(veils, "MASK_VIEWS_MAX", 2)
    seen = []
    monkeypatch.setattr(
        veils, "collect_mask_weights", lambda m, views, s: seen.extend(v.name for v in views) or (np.zeros(1),) * 2
    )
    for step in (600, 700):
        state, iteration = setting(gaussians([[0, 0, 9]], [0.5]), n_views=5, step=step)
        veils.are_outside_masks(state, masked(iteration, *[LEFT] * 5), 0.5, 0.1)
    assert seen == ["0", "3", "1", "4"]
