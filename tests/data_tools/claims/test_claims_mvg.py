"""MVG-Splatting: spoilt depth maps and the truth's normals by hand, and a small run."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims import mvg as claim
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.extensions.mvg import insertion
from minisplat_ref.extensions.mvg.insertion import Photographed
from minisplat_ref.mechanisms.depth_maps.reprojection import DepthView
from minisplat_ref.types import Camera
from tolerances import CLOSED_FORM


@pytest.fixture(scope="module")
def records():
    found = claim.measure("staircase", 8, 0, width=80, height=60)
    return {(r["kind"], r["share"], r["arm"]): r for r in found}


def test_the_test_leaves_few_scattered_errors(records):
    for share in claim.SHARES:
        wrong = {arm: records["scattered", share, arm]["wrong"] for arm in claim.ARMS}
        # Wrong depths are near or far more often than the others, so they are more than their share of the points.
        assert 100 * share < wrong["neither filter nor test"] < 150 * share
        assert wrong["2 views agree"] < 0.2 * wrong["neither filter nor test"]
        assert wrong["filter, 2 views agree"] < wrong["filter, 1 view agrees"] < wrong["filter"]


def test_the_claim_has_a_cell_for_every_arm(records):
    text = claim.tables([r | {"seed": 0} for r in records.values()])
    assert all(text.count(f"| {arm} ") for arm in (*claim.ARMS, *claim.EQUAL))
    assert len(claim.draw(list(records.values())).axes) == 2


def test_spoilt_shares_are_those_asked_for(rng):
    made = make_scene("staircase", n_views=4, width=40, height=30, supersampling=1, n_points=20, test_every=0)
    cameras = [view.camera for view in made.scene.train_views]
    depths = made.train_depths
    has_depth = depths > 0
    assert_allclose(np.mean((claim.scatter(depths, cameras, 0.2, rng) != depths)[has_depth]), 0.2, atol=0.03)
    balls = claim.float_balls(depths, cameras, 0.1, rng)
    assert 0.1 <= np.mean((balls != depths)[has_depth]) < 0.2 and (balls <= depths).all()


def test_a_ball_by_hand():
    """A ball of radius 0.5 at depth 4: its middle is 3.5 away; 4 pixels aside a ray passes at 4 sin(atan(0.4)) > 1."""
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 4.5, 4.5, 9, 9)
    ball = claim._ball_depth(camera, (9, 9), np.array([0, 0, 4.0]), 0.5)
    assert_allclose(ball[4, 4], 3.5, rtol=CLOSED_FORM)
    assert ball[4, 8] == 0 and ball[4, 5] > 3.5
    assert_array_equal(ball, ball.T)


def test_normals_of_the_truth_have_no_angle_on_planes():
    made = make_scene("staircase", n_views=2, width=80, height=60, supersampling=1, n_points=20, test_every=0)
    views = [
        Photographed(DepthView(depth, view.camera), view.image / 255)
        for depth, view in zip(made.train_depths, made.scene.train_views, strict=True)
    ]
    assert claim.angle(views, made) < 1e-5
    assert insertion.smooth_map(views[0]).seen.depth.shape == (60, 80)
