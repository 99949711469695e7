"""GDGS: attraction and crowding by hand, the start on planes, control by regions, the command line."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.gdgs import recipe
from minisplat_ref.extensions.gdgs.model import (
    Regions,
    Weights,
    attract,
    contract,
    densest,
    disperse,
    predict_centers,
    regions_of,
    unevenness,
)
from minisplat_ref.extensions.gdgs.recipe import control_by_region, crowding, on_planes, surface_attraction
from minisplat_ref.mechanisms.oriented.planes import LocalPlanes
from minisplat_ref.mechanisms.oriented.thin_axis import angles_between, normals_of
from minisplat_ref.rendering import Request
from minisplat_ref.training.losses import Rendered
from minisplat_ref.training.schedule import action_name
from minisplat_ref.types import Camera, Gaussians, Model, Scene, view_from
from tolerances import CLOSED_FORM

HALF = np.sqrt(0.5)


def gaussians_at(means, quats=None):
    n = len(means)
    quats = np.tile((1.0, 0, 0, 0), (n, 1)) if quats is None else np.asarray(quats, float)
    log_scales = np.tile((-1.0, -1.0, -3.0), (n, 1))
    return Gaussians(np.asarray(means, float), quats, log_scales, np.zeros(n), np.zeros((n, 3)), np.zeros((n, 0, 3)))


def ground():
    """The plane z = 0 around the origin, in world units of a scene of extent 2."""
    return LocalPlanes(np.zeros((1, 3)), np.eye(3)[None], np.ones((1, 3)))


def test_attraction_by_hand():
    """Two Gaussians 1 above and 3 below the plane, in units of 2; the second is turned by 90 degrees about x."""
    g = gaussians_at([[0.5, 0, 1.0], [0, 0, -3.0]], [[1, 0, 0, 0], [HALF, HALF, 0, 0]])
    found = attract(g, ground(), Weights(2.0, 0.5, 0.0), 0.25, 2.0)
    assert_allclose(found.value, (2 * (0.5 - 0.25) ** 2 + 2 * (-1.5 - 0.25) ** 2 + 0.5 * 1) / 2, rtol=CLOSED_FORM)
    assert_allclose(found.means, [[0, 0, 2 * 2 * 0.25 / 4], [0, 0, 2 * 2 * -1.75 / 4]], atol=1e-15)


def test_spacing_pulls_to_the_middle_of_the_neighbours():
    found = attract(gaussians_at([[0.5, 0, 1.0]]), ground(), Weights(0.0, 0.0, 3.0), 0.0, 2.0)
    assert_allclose(found.value, 3 * (0.25**2 + 0.5**2), rtol=CLOSED_FORM)
    assert_allclose(found.means, [[2 * 3 * 0.25 / 2, 0, 2 * 3 * 0.5 / 2]], rtol=CLOSED_FORM)


def test_a_turned_gaussian_turns_back():
    """A step down the gradient of the angle brings the shortest axis nearer to the normal."""
    g = gaussians_at([[0, 0, 0.0]], [[np.cos(0.2), np.sin(0.2), 0, 0]])
    found = attract(g, ground(), Weights(0.0, 1.0, 0.0), 0.0, 1.0)
    assert_allclose(found.value, 1 - np.cos(0.4), rtol=1e-12)
    after = g._replace(quats=g.quats - 0.1 * found.quats)
    z = np.array([[0, 0, 1.0]])
    assert angles_between(normals_of(after), z)[0] < angles_between(normals_of(g), z)[0] - 1


def test_the_printed_term_contracts_and_the_other_disperses():
    """By hand for two points 1 apart in a region of side 2; then what a step does to their distance."""
    means, members = np.array([[0.0, 0, 0], [1.0, 0, 0]]), [np.array([0, 1])]
    value, v = contract(means, members, 2.0)
    assert_allclose(value, 2 * (0.25 + 0.25) / 4 / 2, rtol=CLOSED_FORM)
    assert_allclose(v, [[-0.25, 0, 0], [0.25, 0, 0]], rtol=CLOSED_FORM)  # 4 (1/2 / 2) / (2 * 2)
    value, w = disperse(means, members, 0.5)
    assert_allclose(value, (np.exp(-2) - np.exp(-4.5)) / 2, rtol=CLOSED_FORM)
    assert_allclose(w, [[2 * np.exp(-2), 0, 0], [-2 * np.exp(-2), 0, 0]], rtol=CLOSED_FORM)
    distance = np.diff((means - 0.1 * v)[:, 0]), np.diff((means - 0.1 * w)[:, 0])
    assert distance[0] < 1 < distance[1]


def test_pairs_beyond_reach_do_not_count():
    value, v = disperse(np.array([[0.0, 0, 0], [1.6, 0, 0]]), [np.array([0, 1])], 0.5)
    assert value == 0 and not v.any()


def test_of_a_crowd_every_kth_stands_for_the_others(monkeypatch):
    """Ten points on a line, of which at most four are paired: every third, 3 apart, each pushed by its neighbours."""
    monkeypatch.setattr("minisplat_ref.extensions.gdgs.model.PAIRED_MAX", 4)
    means = np.zeros((10, 3))
    means[:, 0] = np.arange(10)
    value, v = disperse(means, [np.arange(10)], 2.0)
    few, v_few = disperse(means[::3], [np.arange(4)], 2.0)
    assert value == few > 0
    assert_allclose(v[::3], v_few, rtol=CLOSED_FORM)
    assert np.flatnonzero(v[:, 0]).tolist() == [0, 3, 6, 9]


def test_regions_by_hand():
    """A box of 4 x 2 x 1 with two regions along x: cubes of side 2, so one along y and z."""
    regions = regions_of(np.array([[0.0, 0, 0], [4, 2, 1]]), 2)
    assert regions.shape == (2, 1, 1) and regions.side == 2
    means = np.array([[0.5, 0.5, 0.5], [3.0, 1, 0.5], [9.0, 9, 9], [-5.0, 0, 0]])
    assert regions.ids_of(means).tolist() == [0, 1, 1, 0]
    assert [rows.tolist() for rows in densest(means, regions, 1)] == [[0, 3]]
    assert densest(means[:1], regions, 2) == []


def test_unevenness_of_one_octant_and_of_all():
    region = Regions(np.zeros(3), 2.0, (1, 1, 1))
    corners = np.array([[x, y, z] for x in (0.5, 1.5) for y in (0.5, 1.5) for z in (0.5, 1.5)])
    assert_allclose(unevenness(corners, region), [0], atol=1e-15)
    assert_allclose(unevenness(corners[:1], region), [7], rtol=CLOSED_FORM)  # mean 1/8, variance 7/64
    assert_allclose(unevenness(corners[:0], region), [0])


def test_the_predictor_smooths_points(rng):
    """On a noisy plane it stays near the points, and nearer to the plane than they are across it."""
    flat = np.column_stack([rng.uniform(-1, 1, (400, 2)), np.zeros(400)])
    noisy = flat + np.array([0, 0, 0.1]) * rng.normal(size=(400, 3))
    found = predict_centers(noisy, rng)
    assert np.abs(found[:, :2] - flat[:, :2]).max() < 0.3
    assert found[:, 2].std() < 1.02 * noisy[:, 2].std() and not np.array_equal(found, noisy)


def test_gaussians_start_flat_on_their_planes(rng):
    slope = np.array([0.6, 0.0, 0.8])
    across = np.column_stack([rng.uniform(-1, 1, (300, 2)), np.zeros(300)])
    tilted = across @ np.array([[0.8, 0, -0.6], [0, 1, 0], slope])
    start = gaussians_at(tilted)
    end = on_planes(start, np.random.default_rng(0))
    assert np.median(angles_between(normals_of(end), slope)) < 3
    assert_allclose(end.log_scales - start.log_scales, np.tile((0, 0, np.log(0.3)), (300, 1)), atol=1e-15)
    assert on_planes(gaussians_at(tilted[:2]), rng).means.tolist() == tilted[:2].tolist()


def rendered(points, gaussians, step):
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 2.0, 2.0, 4, 4)
    scene = Scene("s", (), (), points, np.zeros((len(points), 3), np.uint8), np.zeros(3), 2.0)
    return Rendered(None, {}, view_from(camera), scene, Model(gaussians), step, Request())


def test_terms_act_in_one_of_a_hundred_iterations(rng):
    points = rng.normal(size=(30, 3))
    g = gaussians_at(rng.normal(size=(50, 3)))
    term = {"weights": recipe.WEIGHTS, "offset": 0.0, "period": 100}
    values = [surface_attraction(rendered(points, g, step), **term)[0] for step in (5_000, 5_001, 5_002, 5_101)]
    assert values[0] == values[2] == 0 < values[1] == values[3]
    with pytest.raises(InputError, match="scene s has 2 points: train with --set surface_attraction=0"):
        surface_attraction(rendered(points[:2], g, 5_001), **term)
    some = {"n_cells": 2, "n_top": 20, "is_printed": True, "period": 100}
    assert crowding(rendered(points, g, 1), **some)[0] > 0 == crowding(rendered(points, g, 2), **some)[0]
    assert crowding(rendered(points[:0], g, 1), **some)[0] == 0


class State:
    def __init__(self, gaussians, gradients):
        self.gaussians, self.rng = gaussians, np.random.default_rng(0)
        self.stats = {"gradient_sum": gradients, "view_count": np.full(len(gradients), 2)}


def test_control_clones_where_gradients_are_large_and_density_is_uneven(monkeypatch, rng):
    """Of the first region all lie in one octant, of the second one in each; two Gaussians of each are pulled."""
    corners = np.array([[x, y, z] for x in (0.5, 1.5) for y in (0.5, 1.5) for z in (0.5, 1.5)])
    means = np.concatenate([np.full((8, 3), 0.4), corners + np.array([2.0, 0, 0])])
    gradients = np.where(np.arange(16) % 8 < 2, 1.0, 0.0)
    state, edits = State(gaussians_at(means), gradients), []
    monkeypatch.setattr(recipe, "apply_edit", lambda state, edit: edits.append(edit))
    iteration = rendered(np.array([[0.0, 0, 0], [4, 2, 2]]), None, 1)
    how = {"threshold": 0.5, "n_cells": 2, "min_unevenness": 1.0, "jitter": 0.1}
    assert control_by_region(state, iteration, **how) is None
    (edit,) = edits
    assert edit.parent_ids.tolist() == [*range(16), 0, 1] and edit.is_new.tolist() == [False] * 16 + [True] * 2
    moved = edit.gaussians.means[16:] - means[:2]
    assert 0 < np.abs(moved[:, :2]).max() < 0.1 * np.exp(-1) * 4 and np.abs(moved[:, 2]).max() < 0.1 * np.exp(-3) * 4
    state = State(gaussians_at(means), gradients)
    assert "no region is uneven" in control_by_region(state, iteration, **{**how, "min_unevenness": 7.5})
    assert "gradient_sum" not in state.stats


def test_clones_lie_a_tenth_of_a_deviation_away(monkeypatch):
    """Of 400 Gaussians in one octant, deviations of e^-1, e^-1 and e^-3: the mean square of what clones move."""
    state, edits = State(gaussians_at(np.full((400, 3), 0.4)), np.ones(400)), []
    monkeypatch.setattr(recipe, "apply_edit", lambda state, edit: edits.append(edit))
    iteration = rendered(np.array([[0.0, 0, 0], [2, 2, 2]]), None, 1)
    control_by_region(state, iteration, threshold=0.5, n_cells=1, min_unevenness=1.0, jitter=0.1)
    moved = edits[0].gaussians.means[400:] - 0.4
    assert_allclose(moved.std(axis=0), 0.1 * np.exp([-1, -1, -3]), rtol=0.15)  # 400 draws: 3.5 %


def test_repulsion_reaches_an_eighth_of_a_region():
    assert recipe.spacing_of(Regions(np.zeros(3), 2.0, (1, 1, 1))) == 0.25


def test_the_recipe_trains_through_the_command_line(tmp_path):
    tiny = ("--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "150")
    assert main(["synthetic", "room", "--out", str(tmp_path / "room"), *tiny]) == 0
    train = ["train", str(tmp_path / "room"), "--recipe", "gdgs", "--iterations", "10", "--out", str(tmp_path / "run")]
    assert main([*train, "--set", "period=1", "--set", "contraction=0.001"]) == 0
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["n_gaussians"] > 0
    names = {action_name(event) for event in find_recipe("gdgs").events}
    assert "control_by_region" in names
