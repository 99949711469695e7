"""Exposures from tracks: planted gains return, outliers and saturation do not count, equal exposures stay equal."""

import numpy as np
import pytest

from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.strategy.track_gains import (
    OBSERVATIONS_MIN,
    Observations,
    TrackGains,
    cross_validate,
    estimate_gains,
    fit_gain_of_view,
    fit_gains,
    observe_points,
)
from minisplat_ref.types import Optics, view_from
from scenes import make_camera

CAMERA = make_camera(33, 33, fx=30.0, fy=30.0)  # pixel (16, 16) has its centre on the axis
AXIS = np.array([[0.0, 0.0, 5.0]])


def observe_all(g, a):
    """Every one of V photographs sees every one of Q points, without noise."""
    view, point = (index.ravel() for index in np.indices((len(g), len(a))))
    return Observations(view, point, (g[view] + a[point])[:, None])


@pytest.fixture(scope="module")
def room():
    return make_scene("room", n_views=10, width=160, height=120, n_points=3000).scene


def plant(scene, log_gains):
    """Multiply photographs by gains, and round."""
    images = [np.clip(np.rint(v.image * np.exp(g)), 0, 255) for v, g in zip(scene.train_views, log_gains, strict=True)]
    views = [v._replace(image=image.astype(np.uint8)) for v, image in zip(scene.train_views, images, strict=True)]
    return scene._replace(train_views=tuple(views))


def test_gains_without_noise_are_exact(rng):
    """g = (0.3, -0.1, -0.2) has zero mean, and returns whatever the points' colours are."""
    found = fit_gains(observe_all(np.array([0.3, -0.1, -0.2]), rng.normal(size=50)), 3)
    np.testing.assert_allclose(found[:, 0], [0.3, -0.1, -0.2], atol=1e-12)


def test_two_photographs_share_their_difference():
    """One point, 0.4 brighter in the second photograph: gains of -0.2 and 0.2. A third, without points, has 0."""
    observed = Observations(np.array([0, 1]), np.array([7, 7]), np.array([[-1.0], [-0.6]]))
    np.testing.assert_allclose(fit_gains(observed, 3)[:, 0], [-0.2, 0.2, 0.0], atol=1e-12)


def test_photographs_without_common_points_have_no_gain_between_them(rng):
    """Two pairs of photographs see different points: each pair has zero mean, of least norm."""
    first, second = (
        observe_all(np.array([0.1, -0.1]), rng.normal(size=9)),
        observe_all(np.array([0.3, 0.5]), np.ones(9)),
    )
    both = Observations(
        *(np.concatenate(p) for p in zip(first, (second[0] + 2, second[1] + 9, second[2]), strict=True))
    )
    np.testing.assert_allclose(fit_gains(both, 4)[:, 0], [0.1, -0.1, -0.1, 0.1], atol=1e-12)


def test_two_halves_judge_each_other():
    """Even points are 0.4 brighter in the second photograph, odd ones 0.2: gains of 0.2 and 0.1 to both sides.

    Their difference of 0.1 is two errors. Around the mean of two, a point's colours are off by 0.2 or 0.1 without
    gains, and by 0.1 with those of the other half; each times sqrt(2), for the mean, and 1.4826, for the median.
    """
    view, point = (index.ravel() for index in np.indices((2, 6)))
    log_colors = np.where(view == 1, np.where(point % 2 == 0, 0.4, 0.2), 0.0)[:, None] * np.ones(3)
    found = cross_validate(Observations(view, point, log_colors), 2)
    sigma = 1.4826 * np.sqrt(2)
    np.testing.assert_allclose(found, [0.05, sigma * 0.15, sigma * 0.1], rtol=1e-9)


def test_outliers_do_not_count(rng):
    """A fifth of the observations of one photograph are twice as bright; least squares alone would be off by 0.09."""
    g, a = np.array([0.2, 0.0, -0.2]), rng.normal(size=400)
    observed = observe_all(g, a)
    log_colors = observed.log_colors + rng.normal(0, 0.01, (1200, 1))
    log_colors[:80] += np.log(2.0)
    np.testing.assert_allclose(fit_gains(observed._replace(log_colors=log_colors), 3)[:, 0], g, atol=0.003)


def test_the_colour_around_a_point_is_observed():
    """The mean of 3 x 3 pixels, eight of 100 and one of 190: 110 of 255. The point projects to pixel (16, 16)."""
    image = np.full((33, 33, 3), 100, np.uint8)
    image[16, 17] = 190
    view = view_from(CAMERA)._replace(image=image, point_ids=np.array([0]))
    found = observe_points([view_from(CAMERA), view], AXIS)
    assert list(found.view_ids) == [1] and list(found.point_ids) == [0]
    np.testing.assert_allclose(found.log_colors, np.log(np.full((1, 3), 110 / 255)), rtol=1e-12)


@pytest.mark.parametrize("fault", ["dark", "bright", "masked", "lens", "border"])
def test_what_does_not_show_a_gain_is_left_out(fault):
    image, mask, camera = np.full((33, 33, 3), 100, np.uint8), np.ones((33, 33), bool), CAMERA
    if fault == "dark":
        image[15, 15, 2] = 7
    if fault == "bright":
        image[17, 17, 0] = 248
    if fault == "masked":
        mask[16, 16] = False
    if fault == "lens":
        camera = camera._replace(optics=Optics("fisheye", (0.0, 0.0, 0.0, 0.0)))
    if fault == "border":
        camera = camera._replace(cx=0.5)  # pixel (0, 16) has no neighbour on its left
    view = view_from(camera)._replace(image=image, mask=mask, point_ids=np.array([0]))
    assert len(observe_points([view], AXIS).view_ids) == 0
    sound = view._replace(camera=CAMERA, image=np.full((33, 33, 3), 100, np.uint8), mask=None)
    assert len(observe_points([sound], AXIS).view_ids) == 1


def test_planted_gains_return(room, rng):
    """Gains of 10 %, each channel its own: off by less than 1 % of the colour, and said to be needed."""
    planted = rng.normal(-0.1, 0.1, (len(room.train_views), 3))
    found = estimate_gains(plant(room, planted))
    np.testing.assert_allclose(found.log_gains, planted - planted.mean(axis=0), atol=0.03)
    assert np.std(found.log_gains - (planted - planted.mean(axis=0))) < 0.012
    assert found.are_needed and found.is_known.all()
    assert (
        found.residual_with_gains < 0.96 * found.residual
    )  # sqrt(1 - 0.058^2 / 0.117^2) is 0.87 where all residuals are normal


def test_equal_exposures_are_not_needed(room):
    found = estimate_gains(room)
    assert not found.are_needed and found.spread < 0.02
    assert found.residual > 0.03  # there is something that gains could have explained


def test_a_held_out_photograph_has_the_gain_of_its_own_tracks(room, rng):
    """Gains of the others are fitted without it; what it has is measured against the points' colours."""
    planted = np.zeros(len(room.train_views))
    planted[3] = 0.25
    darker = plant(room, planted - 0.3)
    held_out = darker.train_views[3]
    others = darker._replace(train_views=darker.train_views[:3] + darker.train_views[4:])
    gains = estimate_gains(others)
    gain = fit_gain_of_view(held_out, gains, room.points)
    assert gain is not None
    np.testing.assert_allclose(gain, 0.25, atol=0.03)
    few = held_out._replace(point_ids=held_out.point_ids[: OBSERVATIONS_MIN - 1])
    assert fit_gain_of_view(few, gains, room.points) is None


def test_outliers_of_a_held_out_photograph_do_not_count():
    """It sees 30 points 3 pixels apart, 20 of them at half of their colour and 10 at full brightness: ln 0.5."""
    row, column = (3 * index.ravel() + 1 for index in np.indices((3, 10)))
    points = np.column_stack([(column - 16) / 6, (row - 16) / 6, np.full(30, 5.0)])
    image = np.full((33, 33, 3), 100, np.uint8)
    image[:3] = 240
    view = view_from(CAMERA)._replace(image=image, point_ids=np.arange(30))
    gains = TrackGains(np.zeros((0, 3)), np.zeros(0, bool), np.log(np.full((30, 3), 200 / 255)), 0.0, 0.0, 0.0)
    np.testing.assert_allclose(fit_gain_of_view(view, gains, points), np.log([0.5] * 3), rtol=1e-12)


def test_without_tracks_no_gain_is_known(room):
    untracked = room._replace(train_views=tuple(view._replace(point_ids=None) for view in room.train_views))
    found = estimate_gains(untracked)
    assert not found.is_known.any() and not found.are_needed
    assert not found.log_gains.any() and np.isnan(found.log_colors).all()


def test_a_photograph_with_few_points_keeps_its_exposure(room):
    views = list(room.train_views)
    views[0] = views[0]._replace(point_ids=views[0].point_ids[: OBSERVATIONS_MIN - 1])
    found = estimate_gains(room._replace(train_views=tuple(views)))
    assert list(np.flatnonzero(~found.is_known)) == [0]
    assert not found.log_gains[0].any()


def test_photographs_far_from_the_others_are_named():
    """Gains of 0, 0.01, -0.01, 0.02, -0.02 and 0.1: the median is 0.005, the median distance 0.015, 3 sigma 0.067."""
    log_gains = np.array([0.0, 0.01, -0.01, 0.02, -0.02, 0.1, 0.9])[:, None] * np.ones(3)
    is_known = np.array([True] * 6 + [False])
    gains = TrackGains(log_gains, is_known, np.zeros((0, 3)), 0.0, 0.0, 0.0)
    assert list(gains.outliers) == [5]
    nothing = gains._replace(is_known=np.zeros(7, bool))
    assert len(nothing.outliers) == 0 and "not known" in nothing.describe()


@pytest.mark.parametrize(
    ("spread", "error", "with_gains", "expected"),
    [
        (0.03, 0.005, 0.09, True),
        (0.019, 0.005, 0.09, False),  # too small to matter
        (0.03, 0.011, 0.09, False),  # within three errors
        (0.03, 0.005, 0.0995, False),  # explains half a percent of other points
    ],
)
def test_the_rule(spread, error, with_gains, expected):
    log_gains = spread * np.array([[1.0] * 3, [-1.0] * 3])
    gains = TrackGains(log_gains, np.ones(2, bool), np.zeros((0, 3)), error, 0.1, with_gains)
    assert gains.spread == pytest.approx(spread)
    assert gains.are_needed is expected
